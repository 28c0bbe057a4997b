// An answer: the verdict, the bar of probabilities, and the photos.

import { thumbnailURL } from "./api.js";
import { h, picture } from "./dom.js";
import { openDetail } from "./detail.js";
import { feedbackPanel } from "./feedback.js";
import { rememberPanel } from "./remember.js";
import { count, nearness, percent, verdict } from "./wording.js";

const MIN_SHOWN = 0.0005;

/** The whole panel of an answer. */
export function answerPanel({ index, answer, id, query, stored = null }) {
  const parts = probabilityParts(answer);
  const open = ({ photo, object_id: objectId, reference = null }) =>
    openDetail({ index, photo, objectId, query, reference });
  return h(
    "div",
    { class: "answer" },
    verdictBlock(answer, query.graspedObject),
    index.stores_history && id && feedbackPanel(answer, id, stored),
    index.can_enrol && answer.results.length > 0 && rememberPanel(answer, query),
    parts.length > 0 && answer.none_probability !== null && strip(parts),
    parts.length > 0 &&
      h(
        "ol",
        { class: "photos", "aria-label": "Objects, most likely first" },
        parts.map((part) => card(part, answer, open)),
      ),
    searchDetails(answer),
  );
}

/** The parts of the total probability, most likely first: shown objects, none of these, and all other objects. */
function probabilityParts(answer) {
  const objects = answer.results.map((match) => ({ kind: "object", match, p: match.probability }));
  if (!objects.length || answer.none_probability === null) return objects;
  const none = { kind: "none", p: answer.none_probability };
  const shown = [...objects, none].sort((one, other) => other.p - one.p);
  const others = (answer.posterior?.objects ?? 0) - objects.length;
  if (others > 0) shown.push({ kind: "rest", p: answer.unlisted_probability, others });
  return shown;
}

function verdictBlock(answer, graspedObject) {
  const text = verdict(answer);
  const place = graspedObject ? answer.results.findIndex((match) => match.object_id === graspedObject) : -1;
  const where =
    place === 0
      ? "first in the ranking"
      : place > 0
        ? `number ${place + 1} in the ranking`
        : "not among the shown objects";
  return h(
    "div",
    { class: `verdict ${answer.verdict.replaceAll(" ", "-")}` },
    h("p", { class: "above" }, text.above),
    h("h2", { class: "claim" }, text.claim),
    h("p", { class: "below" }, text.below),
    answer.advice && h("p", { class: "advice" }, answer.advice),
    graspedObject &&
      h("p", { class: "grasped-object" }, "Grasped object: ", h("strong", {}, graspedObject), `, ${where}.`),
  );
}

function name(part) {
  if (part.kind === "none") return "None of these";
  if (part.kind === "rest") return count(part.others, "other object");
  return part.match.object_id;
}

/** One bar, divided by probability; the cards show the numbers. */
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
    kind === "object" && p === null && h("span", { class: "p muted" }, `match logit ${match.logit.toFixed(2)}`),
  ];
  const attributes = { class: `photo ${kind}${chosen ? " first" : ""}${p !== null && p < MIN_SHOWN ? " unlikely" : ""}` };
  if (kind !== "object") {
    return h(
      "li",
      attributes,
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
    attributes,
    h(
      "button",
      { type: "button", class: "tile", onclick: () => open(match) },
      image,
      match.reference?.adds != null && nearestTouchThumbnail(match.reference),
      text,
      h("span", { class: "visually-hidden" }, ", details"),
    ),
  );
}

/** Thumbnails of the nearest reference touch, in a corner of the photo. */
function nearestTouchThumbnail(reference) {
  const alt = `, its nearest reference touch: ${nearness(reference)}`;
  return h(
    "span",
    { class: "reference", title: nearness(reference) },
    reference.touch.map((path) => picture(thumbnailURL(path, 160), "", { loading: "lazy" })),
    h("span", { class: "visually-hidden" }, alt),
  );
}

/** Details of the search, folded. */
function searchDetails(answer) {
  const rows = [
    ["Index", `${answer.index.generation}, kind ${answer.index.kind}`],
    ["Model", `${answer.index.model.split("/").at(-1)}, trained on: ${answer.index.trained_on}`],
    ["Scored", `${answer.index.scored} of ${count(answer.index.photos, "photo")} by the fusion head`],
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
      "Prior",
      `none of these ${percent(posterior.none_prior)}; the rest equally for each of ${count(posterior.objects, "object")}`,
    ]);
    const { references } = posterior;
    if (references)
      rows.push([
        "Reference touches",
        `${references.touches.toLocaleString("en")} of ${count(references.objects, "object")}; calibrated ` +
          `on ${count(references.calibration.touches, "touch")} of ${count(references.calibration.objects, "object")} ` +
          `(${references.by})`,
      ]);
    const unscored = posterior.objects - posterior.scored_objects;
    if (unscored)
      rows.push([
        "Not scored",
        `${count(unscored, "object")}, with a total probability of ${percent(posterior.unscored_probability)}`,
      ]);
  }
  return h(
    "details",
    { class: "search-details" },
    h("summary", {}, "How this was found"),
    h(
      "dl",
      {},
      rows.map(([term, text]) => [h("dt", {}, term), h("dd", {}, text)]),
    ),
    posterior &&
      h(
        "p",
        { class: "muted" },
        "The probabilities of all objects of the catalogue and of none of these add up to 1. ",
        "\u201cIf present\u201d: the probability given that the catalogue contains the object.",
      ),
  );
}
