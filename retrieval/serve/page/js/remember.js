// Enrolment: remember the touch of an answer as one of an object, and undo it.

import * as api from "./api.js";
import { announce, h, problemCard } from "./dom.js";
import { objectField } from "./verify.js";
import { count } from "./wording.js";

/** The form under an answer. It offers the best match as the name; the user can give any other. */
export function rememberPanel(answer, query) {
  const kept = answer.query.grasps.flatMap((check, place) => (check === "contact" ? [place] : []));
  const these = kept.length > 1 ? "these touches" : "this touch";
  const best = answer.verdict === "none of these" ? "" : answer.results[0].object_id;
  const { element: name, field } = objectField("remember-object", `Remember ${these} as`, best);
  field.required = true;
  const button = h("button", { class: "quiet" }, "Remember");
  const form = h("form", { class: "remember-form" }, name, button);
  const problems = h("div", {});
  const element = h("section", { class: "remember", "aria-label": `Remember ${these}` }, form, problems);

  /** Run a request; show its problem, if any. */
  async function act(source, request) {
    source.disabled = true;
    problems.replaceChildren();
    try {
      await request();
    } catch (error) {
      problems.replaceChildren(problemCard(error));
    }
    source.disabled = false;
  }

  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const pick = (all) => kept.map((place) => all[place]);
    act(button, async () => {
      const done = await api.enrol(field.value.trim(), pick(query.touches), query.background, pick(query.openings));
      const text = `${done.object_id} now has ${count(done.touches, "enrolled touch")}.`;
      const undo = h("button", { type: "button", class: "quiet" }, "Undo");
      undo.addEventListener("click", () =>
        act(undo, async () => {
          await api.forget(done.object_id, done.added);
          dispatchEvent(new Event("enrolment"));
          form.hidden = false;
          note.remove();
          field.focus();
          announce("Undone.");
        }),
      );
      const note = h("p", { class: "remember-note" }, h("strong", {}, "Remembered. "), text, " ", undo);
      dispatchEvent(new Event("enrolment"));
      form.hidden = true;
      form.after(note);
      undo.focus();
      announce(`Remembered. ${text}`);
    });
  });
  return element;
}
