// How the answer changed grasp by grasp: a line for each object, and one for none of these.

import * as api from "./api.js";
import { h, problemCard, svg } from "./dom.js";
import { count, percent } from "./words.js";

const MOST_LINES = 5;
const [HEIGHT, LEFT, RIGHT, TOP, BOTTOM] = [250, 46, 16, 14, 30];

/** The section; it asks for the answers itself. */
export function growingPanel(asked) {
  const element = h(
    "section",
    { class: "growing", "aria-label": "Grasp by grasp" },
    h("h3", {}, "Grasp by grasp"),
    h("p", { class: "faint" }, "Looking ..."),
  );
  load();
  return element;

  async function load() {
    try {
      const { answers, alone } = await api.growing(asked.touches, asked.background, { ...asked.options, top: 100 });
      element.replaceChildren(h("h3", {}, "Grasp by grasp"), ...content(answers, alone));
    } catch (error) {
      element.replaceChildren(h("h3", {}, "Grasp by grasp"), problemCard(error, load));
    }
  }
}

function content(answers, alone) {
  if (answers.filter((answer) => answer.none_probability !== null).length < 2)
    return [h("p", { class: "faint" }, "Fewer than two grasps felt something; there is nothing to compare.")];
  const lines = linesOf(answers);
  const told = alone.map((answer) => answer.information?.gained_bits ?? 0); // null: nothing was felt
  return [
    h("p", { class: "turn" }, turningPoint(answers, lines)),
    h("p", { class: "turn" }, mostByItself(alone, told)),
    plot(answers, lines),
    legend(lines),
    numbers(answers, lines, told),
  ];
}

/** The likeliest objects of the last answer and none of these: name and a probability after each grasp. */
function linesOf(answers) {
  const last = answers
    .at(-1)
    .results.slice(0, MOST_LINES)
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

/** Which grasp would tell most, were it the only one. */
function mostByItself(alone, told) {
  const most = told.indexOf(Math.max(...told));
  const all = alone[most].information.possible_bits;
  return `By itself, grasp ${most + 1} would tell most: ${told[most].toFixed(1)} of the ${all.toFixed(1)} bits that name an object for certain.`;
}

/** After which grasp the probabilities moved furthest. */
function turningPoint(answers, lines) {
  let [most, where] = [-1, 1];
  for (let step = 1; step < answers.length; step += 1) {
    const moved =
      lines.reduce((sum, { values }) => sum + Math.abs((values[step] ?? 0) - (values[step - 1] ?? 0)), 0) / 2;
    if (moved > most) [most, where] = [moved, step];
  }
  const { name, values } = lines[0];
  const say = (value) => (value === null ? "nothing said" : percent(value));
  return `After the first grasp, grasp ${where + 1} changed the answer most: ${name} went from ${say(values[where - 1])} to ${say(values[where])}.`;
}

function plot(answers, lines) {
  const width = matchMedia("(max-width: 560px)").matches ? 320 : 720; // letters are as large on either
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
  const drawn = [...lines].reverse().map(({ name, kind, values }) => {
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
    drawn,
  );
}

/** The lines by their looks; those of the other objects are told apart as numbers. */
function legend(lines) {
  const following = lines.filter(({ kind }) => kind === "other").length;
  const keys = lines.filter(({ kind }) => kind !== "other").map(({ name, kind }) => h("li", { class: kind }, name));
  if (following) keys.splice(1, 0, h("li", { class: "other" }, count(following, "other object")));
  return h("ul", { class: "keys", "aria-hidden": "true" }, keys);
}

/** The same as numbers, for those who want them or cannot see the plot. */
function numbers(answers, lines, told) {
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
  const bits = told.map((one) => h("td", {}, `${one.toFixed(2)} bits`));
  rows.push(h("tr", {}, h("th", { scope: "row" }, "The grasp by itself tells"), bits));
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
