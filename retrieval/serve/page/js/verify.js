// Verification: the field of the expected object, and the decision whether the hand holds it.

import * as api from "./api.js";
import { debounce, h } from "./dom.js";
import { logRatio, percent, verificationVerdict } from "./wording.js";

/** The text field of the expected object; empty for a search. */
export function expectedField(onChange) {
  const { element, field } = objectField("expected-object", "Expected object (empty: search the catalogue)");
  field.addEventListener("input", onChange);
  return { element, value: () => field.value.trim() };
}

/** A text field with its label that suggests objects of the catalogue. */
export function objectField(id, text, value = "") {
  const suggestions = h("datalist", { id: `${id}-names` });
  const field = h("input", { type: "text", id, value, list: suggestions.id, autocomplete: "off", maxlength: "1000" });
  async function suggest() {
    const words = field.value.trim();
    const found = await api.catalogue({ search: words, limit: 200 }).catch(() => ({ items: [] }));
    const names = [...new Set(found.items.map((item) => item.object_id))];
    if (field.value.trim() === words) suggestions.replaceChildren(...names.map((name) => h("option", { value: name })));
  }
  field.addEventListener("focus", suggest);
  field.addEventListener("input", debounce(suggest));
  return { element: h("div", { class: "field expected" }, h("label", { for: id }, text), field, suggestions), field };
}

/** The panel of a verification: the decision, and its error rates. */
export function verificationPanel(found, graspedObject) {
  const text = verificationVerdict(found);
  return h(
    "div",
    { class: "answer" },
    h(
      "div",
      { class: `verdict ${found.decision.replaceAll(" ", "-")}` },
      h("p", { class: "above" }, text.above),
      h("h2", { class: "claim" }, text.claim),
      h("p", { class: "below" }, text.below),
      graspedObject && h("p", { class: "grasped-object" }, "Grasped object: ", h("strong", {}, graspedObject), "."),
    ),
    found.bounds && errorRates(found),
  );
}

function errorRates({ bounds, log_ratios: ratios }) {
  const rate = ({ value, low, high }) => `${percent(value)} [${percent(low)}, ${percent(high)}]`;
  const rows = [
    ["False-accept rate", rate(bounds.false_accepts)],
    ["Same, most similar object", rate(bounds.similar_false_accepts)],
    ["False-reject rate", rate(bounds.false_rejects)],
    ["Right objects accepted", bounds.accepted.map((part, place) => `${percent(part)} by grasp ${place + 1}`).join(", ")],
    ["Log likelihood ratio", ratios.map((ratio, place) => `${logRatio(ratio)} after grasp ${place + 1}`).join(", ")],
    ["Bounds", `accept from ${logRatio(bounds.accept)}, reject up to ${logRatio(bounds.reject)}`],
  ];
  return h(
    "section",
    { class: "error-rates", "aria-label": "Error rates" },
    h("h3", {}, "Error rates on validation objects"),
    h(
      "dl",
      {},
      rows.map(([term, text]) => [h("dt", {}, term), h("dd", {}, text)]),
    ),
  );
}
