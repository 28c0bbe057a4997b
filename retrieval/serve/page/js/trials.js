// The human test: a touch is shown, and ten photos; which of them shows the object that was touched?

import * as api from "./api.js";
import { announce, h, picture, problemCard } from "./dom.js";
import { count } from "./words.js";

const whole = (share) => `${Math.round(100 * share)}\u00a0%`;

export function trialsView() {
  const element = h("div", { class: "trials" });
  let state = null; // the series that is done
  let choose = () => {};

  async function show(id) {
    try {
      if (id) await go(id);
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
    const who = h("input", { type: "text", id: "trial-who", maxlength: "200", autocomplete: "name" });
    const problems = h("div", {});
    const form = h(
      "form",
      { class: "begin" },
      h("div", { class: "field" }, h("label", { for: "trial-count" }, "Trials"), number),
      h("div", { class: "field" }, h("label", { for: "trial-who" }, "Your name, if you like"), who),
      h("button", { class: "primary" }, "Begin"),
    );
    form.addEventListener("submit", async (event) => {
      event.preventDefault();
      try {
        const series = await api.beginTrials(Number(number.value), who.value);
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
        `The gels of one grasp are shown, and ${known.choices} photos. One of them shows the object that was touched. `,
        `The model is asked the same; ${count(known.objects, "object")} of ${known.recording} were never shown to it.`,
      ),
      enough
        ? form
        : h(
            "p",
            { class: "notice" },
            `A trial takes ${known.choices} objects that the model was not trained on; this recording has ${known.objects}.`,
          ),
      problems,
      ...(known.runs.length ? [h("h2", {}, "Series so far")] : []),
      h("ul", { class: "series" }, known.runs.map(seriesCard)),
    );
  }

  async function go(id) {
    state = await api.series(id);
    if (state.next === null) finished();
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
    const told = h("div", { class: "told" });
    choose = async (chosen) => {
      choose = () => {};
      buttons.forEach((button) => (button.disabled = true));
      try {
        const done = await api.choose(state.id, trial.number, chosen);
        state = await api.series(state.id);
        reveal(done, buttons, told);
      } catch (error) {
        told.replaceChildren(problemCard(error, () => show(state.id)));
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
        { class: "faint" },
        `Trial ${trial.number} of ${state.count}. Choose a photo, or press its number (0 for the tenth).`,
      ),
      h(
        "div",
        { class: "trial" },
        h("section", { class: "touched", "aria-label": "The touch" }, fingers, told),
        h(
          "ol",
          { class: "choices-grid", "aria-label": "Photos to choose from" },
          buttons.map((button) => h("li", {}, button)),
        ),
      ),
    );
    element.querySelector("h1").focus({ preventScroll: true });
  }

  function reveal(done, buttons, told) {
    const right = done.choice === done.truth;
    const chose = `the model chose photo ${done.model}`;
    const knew = done.model === done.truth;
    const text = right
      ? `Right; ${knew ? "the model too" : chose}.`
      : `No, it was photo ${done.truth}; ${knew ? "the model knew" : chose}.`;
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
      state.next === null ? "The result" : "Next",
    );
    told.replaceChildren(h("p", { class: "verdict-line" }, text), next, scores(state));
    announce(text);
    next.focus({ preventScroll: true });
    if (next.getBoundingClientRect().bottom > innerHeight || next.getBoundingClientRect().top < 0)
      next.scrollIntoView({ block: "center" });
  }

  function finished() {
    choose = () => {};
    element.replaceChildren(
      h("h1", { tabindex: "-1" }, "The result"),
      h("p", { class: "lead" }, sentence(state)),
      scores(state),
      h("p", {}, h("a", { href: "#/test" }, "All series, and another one")),
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

function sentence({ human, model, count: trials }) {
  const apart = human.low > model.high || model.low > human.high;
  const better =
    human.right === model.right
      ? "You and the model were right equally often"
      : human.right > model.right
        ? "You were right more often than the model"
        : "The model was right more often than you";
  return `${better}: you ${human.right}, the model ${model.right} of ${count(trials, "trial")}.${apart ? "" : " The intervals overlap: this may be chance."}`;
}

function seriesCard(run) {
  const done = run.next === null ? "done" : `${run.answered} of ${run.count} done`;
  return h(
    "li",
    {},
    h(
      "div",
      { class: "view-head" },
      h("strong", {}, run.who || "Nameless"),
      h("a", { href: `#/test/${run.id}` }, run.next === null ? "The result" : "Go on"),
    ),
    h("p", { class: "faint" }, `${count(run.count, "trial")}, ${done}`),
    run.answered > 0 && scores(run),
  );
}

/** Shares of right answers with their intervals of 95 %: the person's, the model's, and chance. */
function scores({ human, model, chance }) {
  const row = (name, share) =>
    h(
      "div",
      { class: `score ${name === "You" ? "you" : ""}` },
      h("span", { class: "who" }, name),
      h(
        "span",
        { class: "track", "aria-hidden": "true" },
        h("span", {
          class: "range",
          style: { left: `${100 * share.low}%`, width: `${100 * (share.high - share.low)}%` },
        }),
        h("span", { class: "dot", style: { left: `${100 * share.share}%` } }),
        h("span", { class: "chance", style: { left: `${100 * chance}%` } }),
      ),
      h(
        "span",
        { class: "p" },
        `${share.right} of ${share.trials}, ${whole(share.share)} [${whole(share.low)}, ${whole(share.high)}]`,
      ),
    );
  if (!human.trials) return h("p", {});
  return h(
    "div",
    { class: "scores" },
    row("You", human),
    row("Model", model),
    h("p", { class: "faint" }, `Intervals of 95 %; the line is chance, ${whole(chance)}.`),
  );
}
