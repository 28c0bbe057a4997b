// What a person says of an answer: it was right, it was another object, or none of the catalogue.

import * as api from "./api.js";
import { announce, h, problemCard, settled } from "./dom.js";
import { saidWords } from "./words.js";

const MOST_NAMES = 30;

/** The row of buttons under a verdict; what was said already is shown instead. */
export function feedbackPanel(answer, id, kept) {
  const element = h("section", { class: "feedback", "aria-label": "Was this right?" });
  if (kept?.said) {
    element.append(thanks(kept.said, kept.object_id, null));
    return element;
  }
  const sure = ["match", "uncalibrated", "none of these"].includes(answer.verdict);
  const problems = h("div", {});
  const other = otherObject(answer, (name) => say("object", name));
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
      sure && h("button", { type: "button", class: "quiet", onclick: () => say("right") }, "Right"),
      toggle,
      answer.verdict !== "none of these" &&
        h("button", { type: "button", class: "quiet", onclick: () => say("none") }, "None of the catalogue"),
    ),
    other.element,
    problems,
  );
  return element;

  async function say(said, name = null) {
    element.querySelectorAll("button").forEach((button) => (button.disabled = true));
    try {
      const told = await api.feedback(id, said, name);
      element.replaceChildren(thanks(told.said, told.object_id, told.recorded));
      announce("What you said is kept.");
    } catch (error) {
      problems.replaceChildren(problemCard(error));
      element.querySelectorAll("button").forEach((button) => (button.disabled = false));
    }
  }
}

function thanks(said, objectId, recorded) {
  const more = recorded ? "The grasps are in the recording that `retrieve train` reads." : "";
  return h("p", { class: "said" }, h("strong", {}, `${saidWords(said, objectId)}.`), " ", more);
}

/** A list of objects that shrinks as a name is typed. */
function otherObject(answer, chosen) {
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
            .slice(0, MOST_NAMES)
            .map((name) =>
              h("li", {}, h("button", { type: "button", class: "quiet", onclick: () => chosen(name) }, name)),
            )
        : [h("li", { class: "faint" }, "The catalogue has no such object.")]),
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
  field.addEventListener("input", settled(search));
  const open = () => {
    search();
    field.focus();
  };
  return { element, open };
}
