// The human baseline: the user sees a touch and ten photos, and chooses the photo of the touched object.

import * as api from "./api.js";
import { announce, h, picture, problemCard } from "./dom.js";
import { count } from "./wording.js";

const wholePercent = (fraction) => `${Math.round(100 * fraction)}\u00a0%`;

export function trialsView() {
  const element = h("div", { class: "trials" });
  let state = null; // the current series
  let choose = () => {};

  async function show(id) {
    try {
      if (id) await openSeries(id);
      else overview(await api.trials());
    } catch (error) {
      element.replaceChildren(
        h("h1", { tabindex: "-1" }, "Test yourself"),
        problemCard(error, () => show(id)),
      );
    }
  }

  function overview(known) {
    choose = () => {};
    const number = h("input", {
      type: "number",
      id: "trial-count",
      min: "1",
      max: "10000",
      value: "20",
      required: true,
    });
    const participant = h("input", { type: "text", id: "trial-participant", maxlength: "200", autocomplete: "name" });
    const problems = h("div", {});
    const form = h(
      "form",
      { class: "begin" },
      h("div", { class: "field" }, h("label", { for: "trial-count" }, "Trials"), number),
      h("div", { class: "field" }, h("label", { for: "trial-participant" }, "Your name (optional)"), participant),
      h("button", { class: "primary" }, "Begin"),
    );
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      try {
        const series = await api.beginTrials(Number(number.value), participant.value);
        location.hash = `#/test/${series.id}`;
      } catch (error) {
        problems.replaceChildren(problemCard(error));
      }
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
      problems,
      ...(known.runs.length ? [h("h2", {}, "Series so far")] : []),
      h("ul", { class: "series" }, known.runs.map(seriesCard)),
    );
  }

  async function openSeries(id) {
    state = await api.series(id);
    if (state.next === null) showResult();
    else ask(await api.trial(id, state.next));
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
        const done = await api.choose(state.id, trial.number, chosen);
        state = await api.series(state.id);
        reveal(done, buttons, trialResult);
      } catch (error) {
        trialResult.replaceChildren(problemCard(error, () => show(state.id)));
      }
    };
    element.replaceChildren(
      h(
        "div",
        { class: "view-head" },
        h("h1", { tabindex: "-1" }, "Which object was touched?"),
        h("a", { href: "#/test", class: "link" }, "All series"),
      ),
      h(
        "p",
        { class: "muted" },
        `Trial ${trial.number} of ${state.count}. Choose a photo, or press its number (0 for the tenth).`,
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

  function reveal(done, buttons, trialResult) {
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
      { type: "button", class: "primary", onclick: () => show(state.id) },
      state.next === null ? "Result" : "Next",
    );
    trialResult.replaceChildren(h("p", { class: "verdict-line" }, text), next, scores(state));
    announce(text);
    next.focus({ preventScroll: true });
    if (next.getBoundingClientRect().bottom > innerHeight || next.getBoundingClientRect().top < 0)
      next.scrollIntoView({ block: "center" });
  }

  function showResult() {
    choose = () => {};
    element.replaceChildren(
      h("h1", { tabindex: "-1" }, "Result"),
      h("p", { class: "lead" }, sentence(state)),
      scores(state),
      h("p", {}, h("a", { href: "#/test" }, "All series")),
    );
    element.querySelector("h1").focus({ preventScroll: true });
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

function sentence({ human_baseline: human, model, count: trials }) {
  const differ = human.low > model.high || model.low > human.high;
  const better =
    human.right === model.right
      ? "You and the model were right equally often"
      : human.right > model.right
        ? "You were right more often than the model"
        : "The model was right more often than you";
  return `${better}: you ${human.right}, the model ${model.right} of ${count(trials, "trial")}.${differ ? "" : " The intervals overlap: this may be chance."}`;
}

function seriesCard(run) {
  const done = run.next === null ? "done" : `${run.completed} of ${run.count} done`;
  return h(
    "li",
    {},
    h(
      "div",
      { class: "view-head" },
      h("strong", {}, run.participant || "Anonymous"),
      h("a", { href: `#/test/${run.id}` }, run.next === null ? "Result" : "Continue"),
    ),
    h("p", { class: "muted" }, `${count(run.count, "trial")}, ${done}`),
    run.completed > 0 && scores(run),
  );
}

/** Accuracy of the person and of the model with 95 % intervals, and chance. */
function scores({ human_baseline: human, model, chance }) {
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
  if (!human.trials) return h("p", {});
  return h(
    "div",
    { class: "scores" },
    row("You", human),
    row("Model", model),
    h("p", { class: "muted" }, `95 % intervals; the line is chance, ${wholePercent(chance)}.`),
  );
}
