// The cumulative query: how the answer changes grasp by grasp, with a line for each object and for none of these.

import * as api from "./api.js";
import { h, problemCard, svg } from "./dom.js";
import { count, percent } from "./wording.js";

const MAX_LINES = 5;
const [HEIGHT, LEFT, RIGHT, TOP, BOTTOM] = [250, 46, 16, 14, 30];

/** The section, which requests its answers itself. */
export function cumulativePanel(query) {
  const element = h(
    "section",
    { class: "cumulative", "aria-label": "Grasp by grasp" },
    h("h3", {}, "Grasp by grasp"),
    h("p", { class: "muted" }, "Computing ..."),
  );
  load();
  return element;

  async function load() {
    try {
      const options = { ...query.options, top: 100 };
      const { answers, per_grasp: perGrasp } = await api.cumulative(query.touches, query.background, options);
      element.replaceChildren(h("h3", {}, "Grasp by grasp"), ...content(answers, perGrasp));
    } catch (error) {
      element.replaceChildren(h("h3", {}, "Grasp by grasp"), problemCard(error, load));
    }
  }
}

function content(answers, perGrasp) {
  if (answers.filter((answer) => answer.none_probability !== null).length < 2)
    return [h("p", { class: "muted" }, "Fewer than two grasps have contact, so there is nothing to compare.")];
  const lines = linesOf(answers);
  const gainedBits = perGrasp.map((answer) => answer.information?.gained_bits ?? 0); // null: no contact
  return [
    h("p", { class: "summary-line" }, turningPoint(answers, lines)),
    h("p", { class: "summary-line" }, mostInformativeGrasp(perGrasp, gainedBits)),
    plot(answers, lines),
    legend(lines),
    numbers(answers, lines, gainedBits),
  ];
}

/** Names, and probabilities after each grasp, of the most likely objects of the last answer and of none of these. */
function linesOf(answers) {
  const last = answers
    .at(-1)
    .results.slice(0, MAX_LINES)
    .map((match) => match.object_id);
  const of = (name) =>
    answers.map((answer) =>
      answer.none_probability === null
        ? null
        : (answer.results.find((match) => match.object_id === name)?.probability ?? 0),
    );
  const objects = last.map((name, place) => ({ name, kind: place === 0 ? "best" : "other", values: of(name) }));
  return [
    ...objects,
    { name: "None of these", kind: "none", values: answers.map((answer) => answer.none_probability) },
  ];
}

/** A sentence on the single grasp that gives the most information. */
function mostInformativeGrasp(perGrasp, gainedBits) {
  const best = gainedBits.indexOf(Math.max(...gainedBits));
  const possible = perGrasp[best].information.possible_bits;
  return `Queried separately, grasp ${best + 1} gives the most information: ${gainedBits[best].toFixed(1)} of the ${possible.toFixed(1)} bits that identify an object with certainty.`;
}

/** A sentence on the grasp after which the probabilities changed most. */
function turningPoint(answers, lines) {
  let [largest, where] = [-1, 1];
  for (let step = 1; step < answers.length; step += 1) {
    const moved =
      lines.reduce((sum, { values }) => sum + Math.abs((values[step] ?? 0) - (values[step - 1] ?? 0)), 0) / 2;
    if (moved > largest) [largest, where] = [moved, step];
  }
  const { name, values } = lines[0];
  const text = (value) => (value === null ? "no answer" : percent(value));
  return `After the first grasp, grasp ${where + 1} changed the answer most: ${name} went from ${text(values[where - 1])} to ${text(values[where])}.`;
}

function plot(answers, lines) {
  const width = matchMedia("(max-width: 560px)").matches ? 320 : 720; // keeps the size of the letters
  const x = (step) => LEFT + (step * (width - LEFT - RIGHT)) / Math.max(1, answers.length - 1);
  const y = (p) => HEIGHT - BOTTOM - p * (HEIGHT - TOP - BOTTOM);
  const grid = [0, 0.5, 1].map((p) => [
    svg("line", { x1: LEFT, x2: width - RIGHT, y1: y(p), y2: y(p), class: "rule" }),
    svg("text", { x: LEFT - 8, y: y(p) + 4, "text-anchor": "end" }, `${100 * p} %`),
  ]);
  const steps = answers.map((_, step) => {
    const anchor = step === 0 ? "start" : step === answers.length - 1 ? "end" : "middle";
    return svg("text", { x: x(step), y: HEIGHT - 8, "text-anchor": anchor }, step === 0 ? "1 grasp" : `${step + 1}`);
  });
  const groups = [...lines].reverse().map(({ name, kind, values }) => {
    const points = values.flatMap((p, step) => (p === null ? [] : [[x(step), y(p)]]));
    return svg(
      "g",
      { class: kind },
      svg("title", {}, name),
      svg("polyline", { points: points.map((point) => point.join(",")).join(" ") }),
      points.map(([cx, cy]) => svg("circle", { cx, cy, r: 4 })),
    );
  });
  return svg(
    "svg",
    { viewBox: `0 0 ${width} ${HEIGHT}`, "aria-hidden": "true", class: "plot" },
    grid.flat(),
    steps,
    groups,
  );
}

/** The legend; all other objects share one entry; only the table of numbers distinguishes them. */
function legend(lines) {
  const following = lines.filter(({ kind }) => kind === "other").length;
  const keys = lines.filter(({ kind }) => kind !== "other").map(({ name, kind }) => h("li", { class: kind }, name));
  if (following) keys.splice(1, 0, h("li", { class: "other" }, count(following, "other object")));
  return h("ul", { class: "keys", "aria-hidden": "true" }, keys);
}

/** The plot as a table of numbers, which screen readers can read. */
function numbers(answers, lines, gainedBits) {
  const head = h(
    "tr",
    {},
    h("th", { scope: "col" }, "Object"),
    answers.map((_, step) => h("th", { scope: "col" }, `Grasp ${step + 1}`)),
  );
  const rows = lines.map(({ name, values }) =>
    h(
      "tr",
      {},
      h("th", { scope: "row" }, name),
      values.map((p) => h("td", {}, p === null ? "-" : percent(p))),
    ),
  );
  const bits = gainedBits.map((one) => h("td", {}, `${one.toFixed(2)} bits`));
  rows.push(h("tr", {}, h("th", { scope: "row" }, "Information of each single grasp"), bits));
  return h(
    "details",
    {},
    h("summary", {}, "As numbers"),
    h(
      "div",
      { class: "wide", tabindex: "0", role: "region", "aria-label": "Probabilities after each grasp" },
      h("table", {}, h("thead", {}, head), h("tbody", {}, rows)),
    ),
  );
}
