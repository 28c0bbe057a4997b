// Feedback on an answer: it is right, it is another object, or the object is not in the catalogue.

import * as api from "./api.js";
import { announce, h, problemCard, debounce } from "./dom.js";
import { feedbackText } from "./wording.js";

const MAX_NAMES = 30;

/** The row of feedback buttons under a verdict, or the stored feedback. */
export function feedbackPanel(answer, id, stored) {
  const element = h("section", { class: "feedback", "aria-label": "Was this right?" });
  if (stored?.feedback) {
    element.append(thanks(stored.feedback, stored.object_id, null));
    return element;
  }
  const hasClaim = ["match", "uncalibrated", "none of these"].includes(answer.verdict);
  const problems = h("div", {});
  const other = otherObject(answer, (name) => sendFeedback("object", name));
  const toggle = h("button", { type: "button", class: "quiet", "aria-expanded": "false" }, "It was another object");
  toggle.addEventListener("click", () => {
    other.element.hidden = !other.element.hidden;
    toggle.setAttribute("aria-expanded", String(!other.element.hidden));
    if (!other.element.hidden) other.open();
  });
  element.append(
    h(
      "div",
      { class: "choices" },
      h("span", { class: "question" }, "Was this right?"),
      hasClaim && h("button", { type: "button", class: "quiet", onclick: () => sendFeedback("right") }, "Right"),
      toggle,
      answer.verdict !== "none of these" &&
        h("button", { type: "button", class: "quiet", onclick: () => sendFeedback("none") }, "Not in the catalogue"),
    ),
    other.element,
    problems,
  );
  return element;

  async function sendFeedback(feedback, name = null) {
    element.querySelectorAll("button").forEach((button) => (button.disabled = true));
    try {
      const result = await api.feedback(id, feedback, name);
      element.replaceChildren(thanks(result.feedback, result.object_id, result.recorded));
      announce("Feedback stored.");
    } catch (error) {
      problems.replaceChildren(problemCard(error));
      element.querySelectorAll("button").forEach((button) => (button.disabled = false));
    }
  }
}

function thanks(feedback, objectId, recorded) {
  const more = recorded ? "The recording for `retrieve train` contains these grasps." : "";
  return h("p", { class: "feedback-text" }, h("strong", {}, `${feedbackText(feedback, objectId)}.`), " ", more);
}

/** A list of objects, filtered by the typed name. */
function otherObject(answer, onChoice) {
  const field = h("input", {
    type: "search",
    id: "other-object",
    autocomplete: "off",
    placeholder: "Name of the object",
  });
  const list = h("ul", { class: "names", "aria-label": "Objects" });
  const element = h(
    "div",
    { class: "other", hidden: true },
    h("label", { for: "other-object" }, "Which object was it?"),
    field,
    list,
  );

  function show(names) {
    list.replaceChildren(
      ...(names.length
        ? names
            .slice(0, MAX_NAMES)
            .map((name) =>
              h("li", {}, h("button", { type: "button", class: "quiet", onclick: () => onChoice(name) }, name)),
            )
        : [h("li", { class: "muted" }, "The catalogue has no such object.")]),
    );
  }

  async function search() {
    const words = field.value.trim();
    if (!words) {
      show(answer.results.map((match) => match.object_id));
      return;
    }
    try {
      const found = await api.catalogue({ search: words, limit: 200 });
      if (field.value.trim() === words) show([...new Set(found.items.map((item) => item.object_id))]);
    } catch (error) {
      list.replaceChildren(h("li", {}, problemCard(error)));
    }
  }
  field.addEventListener("input", debounce(search));
  const open = () => {
    search();
    field.focus();
  };
  return { element, open };
}
