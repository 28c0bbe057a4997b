// The human baseline: the user sees a touch and ten photos, and chooses the photo of the touched object.

import * as api from "./api.js";
import { announce, h, picture, problemCard } from "./dom.js";
import { count } from "./wording.js";

const wholePercent = (fraction) => `${Math.round(100 * fraction)}\u00a0%`;

export function trialsView() {
  const element = h("div", { class: "trials" });
  let participant = "";
  let choose = () => {};

  async function show(name) {
    choose = () => {};
    participant = name;
    try {
      const known = await api.trials();
      const before = known.participants.find((person) => person.participant === participant);
      if (participant) ask(await api.trial(before ? before.next : 1));
      else overview(known);
    } catch (error) {
      element.replaceChildren(
        h("h1", { tabindex: "-1" }, "Test yourself"),
        problemCard(error, () => show(name)),
      );
    }
  }

  function overview(known) {
    const name = h("input", { type: "text", id: "trial-participant", maxlength: "200", autocomplete: "name", required: true });
    const form = h(
      "form",
      { class: "begin" },
      h("div", { class: "field" }, h("label", { for: "trial-participant" }, "Your name"), name),
      h("button", { class: "primary" }, "Begin"),
    );
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      location.hash = `#/test/${encodeURIComponent(name.value)}`;
    });
    const enough = known.objects >= known.choices;
    element.replaceChildren(
      h("h1", { tabindex: "-1" }, "Are you better than the model?"),
      h(
        "p",
        { class: "lead" },
        `You see the gel images of one grasp and ${known.choices} photos. One photo shows the touched object. `,
        `The model does the same trials, with ${count(known.objects, "object")} of ${known.recording} that it was not trained on.`,
      ),
      enough
        ? form
        : h(
            "p",
            { class: "notice" },
            `A trial requires ${known.choices} objects that the model was not trained on; this recording has ${known.objects}.`,
          ),
      ...(known.participants.length ? [h("h2", {}, "Results so far")] : []),
      h(
        "ul",
        { class: "series" },
        known.participants.map((person) => personCard(person, known.chance)),
      ),
    );
  }

  function ask(trial) {
    const fingers = trial.touches.map((path, place) =>
      h("figure", { class: "slot" }, picture(path, `Gel image of finger ${place + 1}`)),
    );
    const buttons = trial.photos.map((path, place) =>
      h(
        "button",
        { type: "button", class: "tile", onclick: () => choose(place + 1) },
        picture(path, ""),
        h("span", { class: "name" }, `Photo ${place + 1}`),
      ),
    );
    const trialResult = h("div", { class: "trial-result" });
    choose = async (chosen) => {
      choose = () => {};
      buttons.forEach((button) => (button.disabled = true));
      try {
        const done = await api.choose(trial.number, participant, chosen);
        const known = await api.trials();
        const person = known.participants.find((one) => one.participant === participant);
        reveal(done, scores(person, known.chance), buttons, trialResult);
      } catch (error) {
        trialResult.replaceChildren(problemCard(error, () => show(participant)));
      }
    };
    element.replaceChildren(
      h(
        "div",
        { class: "view-head" },
        h("h1", { tabindex: "-1" }, "Which object was touched?"),
        h("a", { href: "#/test", class: "link" }, "All results"),
      ),
      h(
        "p",
        { class: "muted" },
        `Trial ${trial.number}. Choose a photo, or press its number (0 for the tenth).`,
      ),
      h(
        "div",
        { class: "trial" },
        h("section", { class: "touched", "aria-label": "The touch" }, fingers, trialResult),
        h(
          "ol",
          { class: "choices-grid", "aria-label": "Photos to choose from" },
          buttons.map((button) => h("li", {}, button)),
        ),
      ),
    );
    element.querySelector("h1").focus({ preventScroll: true });
  }

  function reveal(done, results, buttons, trialResult) {
    const right = done.choice === done.truth;
    const modelChoice = `the model chose photo ${done.model}`;
    const modelRight = done.model === done.truth;
    const text = right
      ? `Right; ${modelRight ? "the model was right too" : modelChoice}.`
      : `Wrong, it was photo ${done.truth}; ${modelRight ? "the model was right" : modelChoice}.`;
    buttons.forEach((button, place) => {
      const number = place + 1;
      const marks = [
        number === done.truth && "the object",
        number === done.choice && "you",
        number === done.model && "the model",
      ].filter(Boolean);
      if (marks.length) button.append(h("span", { class: "p" }, marks.join(", ")));
      button.classList.toggle("truth", number === done.truth);
      button.classList.toggle("dim", !marks.length);
    });
    const next = h(
      "button",
      { type: "button", class: "primary", onclick: () => show(participant) },
      "Next",
    );
    trialResult.replaceChildren(h("p", { class: "verdict-line" }, text), next, results);
    announce(text);
    next.focus({ preventScroll: true });
    if (next.getBoundingClientRect().bottom > innerHeight || next.getBoundingClientRect().top < 0)
      next.scrollIntoView({ block: "center" });
  }

  addEventListener("keydown", (event) => {
    if (
      element.hidden ||
      event.ctrlKey ||
      event.metaKey ||
      event.altKey ||
      /^(input|select)$/i.test(event.target.tagName)
    )
      return;
    if (/^\d$/.test(event.key)) choose(Number(event.key) || 10);
  });
  return { element, show };
}

function personCard(person, chance) {
  return h(
    "li",
    {},
    h(
      "div",
      { class: "view-head" },
      h("strong", {}, person.participant),
      h("a", { href: `#/test/${encodeURIComponent(person.participant)}` }, "Continue"),
    ),
    scores(person, chance),
  );
}

/** Accuracy of the person and of the model with 95 % intervals, and chance. */
function scores({ human_baseline: human, model }, chance) {
  const row = (name, result) =>
    h(
      "div",
      { class: `score ${name === "You" ? "you" : ""}` },
      h("span", { class: "row-label" }, name),
      h(
        "span",
        { class: "track", "aria-hidden": "true" },
        h("span", {
          class: "range",
          style: { left: `${100 * result.low}%`, width: `${100 * (result.high - result.low)}%` },
        }),
        h("span", { class: "dot", style: { left: `${100 * result.accuracy}%` } }),
        h("span", { class: "chance", style: { left: `${100 * chance}%` } }),
      ),
      h(
        "span",
        { class: "p" },
        `${result.right} of ${result.trials}, ${wholePercent(result.accuracy)} [${wholePercent(result.low)}, ${wholePercent(result.high)}]`,
      ),
    );
  return h(
    "div",
    { class: "scores" },
    row("You", human),
    row("Model", model),
    h("p", { class: "muted" }, `95 % intervals; the line is chance, ${wholePercent(chance)}.`),
  );
}
