// An answer: the verdict in words, what adds up to 1, and the photos.

import { thumbnailURL } from "./api.js";
import { h, picture } from "./dom.js";
import { openDetail } from "./detail.js";
import { feedbackPanel } from "./feedback.js";
import { growingPanel } from "./growing.js";
import { anotherGrasp } from "./information.js";
import { count, nearness, percent, verdict } from "./words.js";

const LEAST_SHOWN = 0.0005;

/** The whole panel of an answer. */
export function answerPanel({ index, answer, id, asked, kept = null }) {
  const parts = shares(answer);
  const open = ({ photo, object_id: objectId, reference = null }) =>
    openDetail({ index, photo, objectId, asked, reference });
  return h(
    "div",
    { class: "answer" },
    verdictBlock(answer, asked.held),
    index.keeps && id && feedbackPanel(answer, id, kept),
    parts.length > 0 && answer.none_probability !== null && strip(parts),
    parts.length > 0 &&
      h(
        "ol",
        { class: "photos", "aria-label": "Objects, most likely first" },
        parts.map((part) => card(part, answer, open)),
      ),
    parts.length > 0 && asked.touches.length > 1 && answer.none_probability !== null && growingPanel(asked),
    parts.length > 0 && answer.information && anotherGrasp(answer),
    found(answer),
  );
}

/** What the probability is shared among: objects shown, none of these, all the others; most likely first. */
function shares(answer) {
  const objects = answer.results.map((match) => ({ kind: "object", match, p: match.probability }));
  if (!objects.length || answer.none_probability === null) return objects;
  const none = { kind: "none", p: answer.none_probability };
  const shown = [...objects, none].sort((one, other) => other.p - one.p);
  const others = (answer.posterior?.objects ?? 0) - objects.length;
  const rest = answer.unlisted_probability; // absent in answers that a history keeps from before
  if (others > 0 && rest !== undefined) shown.push({ kind: "rest", p: rest, others });
  return shown;
}

function verdictBlock(answer, held) {
  const said = verdict(answer);
  const place = held ? answer.results.findIndex((match) => match.object_id === held) : -1;
  const where =
    place === 0
      ? "the first of the ranking"
      : place > 0
        ? `number ${place + 1} of the ranking`
        : "not among those shown";
  return h(
    "div",
    { class: `verdict ${answer.verdict.replaceAll(" ", "-")}` },
    h("p", { class: "above" }, said.above),
    h("h2", { class: "claim" }, said.claim),
    h("p", { class: "below" }, said.below),
    answer.advice && h("p", { class: "advice" }, answer.advice),
    held && h("p", { class: "held" }, "The jaws closed on ", h("strong", {}, held), `: ${where}.`),
  );
}

function name(part) {
  if (part.kind === "none") return "None of these";
  if (part.kind === "rest") return count(part.others, "other object");
  return part.match.object_id;
}

/** One bar of the width 1, divided; the numbers stand in the cards. */
function strip(parts) {
  return h(
    "div",
    { class: "strip", "aria-hidden": "true" },
    parts.map((part) =>
      h("span", {
        class: part.kind,
        style: { "flex-grow": String(part.p) },
        title: `${name(part)}: ${percent(part.p)}`,
      }),
    ),
  );
}

function card(part, answer, open) {
  const { kind, match, p } = part;
  const first = kind === "object" && match.rank === 1 && ["match", "uncalibrated"].includes(answer.verdict);
  const chosen = first || (kind === "none" && answer.verdict === "none of these");
  const text = [
    h("span", { class: "name" }, name(part)),
    p !== null &&
      h(
        "span",
        { class: "meter", "data-p": String(p), "aria-hidden": "true" },
        h("span", { style: { width: `${100 * p}%` } }),
      ),
    p !== null && h("span", { class: "p" }, percent(p)),
    match?.probability_if_present != null &&
      h("span", { class: "if-present" }, `${percent(match.probability_if_present)} if present`),
    kind === "object" && p === null && h("span", { class: "p faint" }, `match logit ${match.logit.toFixed(2)}`),
  ];
  const given = { class: `photo ${kind}${chosen ? " first" : ""}${p !== null && p < LEAST_SHOWN ? " unlikely" : ""}` };
  if (kind !== "object") {
    return h(
      "li",
      given,
      h(
        "div",
        { class: "tile" },
        h("div", { class: "blank", "aria-hidden": "true" }, kind === "none" ? "?" : `+${part.others}`),
        text,
      ),
    );
  }
  const image = picture(thumbnailURL(match.photo), "", { loading: "lazy" });
  return h(
    "li",
    given,
    h(
      "button",
      { type: "button", class: "tile", onclick: () => open(match) },
      image,
      match.reference?.adds != null && nearestTouch(match.reference),
      text,
      h("span", { class: "unseen" }, ", details"),
    ),
  );
}

/** The gel images of the nearest reference touch, small in a corner of the photo. */
function nearestTouch(reference) {
  const alt = `, its nearest reference touch: ${nearness(reference)}`;
  return h(
    "span",
    { class: "reference", title: nearness(reference) },
    reference.touch.map((path) => picture(thumbnailURL(path, 160), "", { loading: "lazy" })),
    h("span", { class: "unseen" }, alt),
  );
}

/** How it was found, for those who ask. */
function found(answer) {
  const rows = [
    ["Index", `${answer.index.generation}, kind ${answer.index.kind}`],
    ["Model", `${answer.index.model.split("/").at(-1)}, trained on: ${answer.index.trained_on}`],
    ["ShardResult", `${answer.index.scored} of ${count(answer.index.photos, "photo")} by the full classifier`],
    [
      "Time",
      Object.entries(answer.timing_ms)
        .map(([stage, ms]) => `${stage} ${ms.toFixed(1)} ms`)
        .join(", "),
    ],
  ];
  const { posterior } = answer;
  if (posterior) {
    rows.push([
      "Before",
      `none of these ${percent(posterior.none_prior)}; each of ${count(posterior.objects, "object")} alike`,
    ]);
    const { references } = posterior;
    if (references)
      rows.push([
        "Reference touches",
        `${references.touches.toLocaleString("en")} of ${count(references.objects, "object")}; what they are worth was ` +
          `fitted on ${count(references.worth.touches, "touch")} of ${count(references.worth.objects, "object")} ` +
          `(${references.by})`,
      ]);
    const left = posterior.objects - posterior.scored_objects;
    if (left)
      rows.push(["Not judged", `${count(left, "object")}, which share ${percent(posterior.unscored_probability)}`]);
  }
  return h(
    "details",
    { class: "found" },
    h("summary", {}, "How this was found"),
    h(
      "dl",
      {},
      rows.map(([term, text]) => [h("dt", {}, term), h("dd", {}, text)]),
    ),
    posterior &&
      h(
        "p",
        { class: "faint" },
        "The probabilities of all objects of the catalogue and of none of these add up to 1. ",
        "\u201cIf present\u201d: the probability given that the catalogue has the object.",
      ),
  );
}
