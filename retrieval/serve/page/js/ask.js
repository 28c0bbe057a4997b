// Asking: gel images in, an answer out.

import * as api from "./api.js";
import { announce, h, problemCard } from "./dom.js";
import { answerPanel } from "./answer.js";
import { livePanel } from "./live.js";
import { Tray, chooser, finger, trayCards } from "./tray.js";
import { count, verdict } from "./words.js";

const DEFAULTS = { top: 12, candidates: null, none_prior: 0.5 };

/** The view that asks. */
export function askView(index) {
  const tray = new Tray(index.fingers);
  const options = { ...DEFAULTS };
  let held = null; // what the simulated jaws closed on
  let asking = null;
  const subtracts = index.background !== "none"; // the model takes the untouched gels away from the touch

  const title = h("h1", { tabindex: "-1" }, "Which object is in the hand?");
  const lead = h("p", { class: "lead" }, leadText(index));
  const cards = h("div", { class: "cards" });
  const refused = h("div", { class: "refused", role: "alert" });
  const askButton = h("button", { type: "button", class: "primary", onclick: () => ask() }, "Ask");
  const clearButton = h("button", { type: "button", class: "quiet", onclick: () => start() }, "Start again");
  const live = livePanel(index, tray);
  const again = h("button", { type: "button", class: "quiet", onclick: () => graspSomething(held) }, "Grasp it again");
  const graspButton = h(
    "button",
    { type: "button", class: "quiet", onclick: () => graspSomething() },
    "Grasp something",
  );
  const sources = h(
    "div",
    { class: "sources" },
    chooser("Choose gel images", (files) => take(files), { class: "quiet choose" }),
    index.can_grasp && graspButton,
    index.can_grasp && again,
    live.buttons,
  );
  const drop = h(
    "div",
    { class: "drop" },
    h("p", { class: "drop-words" }, h("strong", {}, "Drop gel images here"), h("span", {}, dropText(index.fingers))),
    sources,
  );
  const side = h(
    "section",
    { class: "side", "aria-label": "Touch" },
    cards,
    refused,
    drop,
    live.element,
    optionsPanel(index, tray, options),
    h("div", { class: "go" }, askButton, clearButton),
  );
  const result = h("section", { class: "result", "aria-label": "Answer" });
  const element = h("div", { class: "ask" }, h("div", { class: "intro" }, title, lead), side, result);

  function take(files) {
    held = null;
    tray.addFiles(files);
    if (tray.complete) askButton.focus();
  }

  function start() {
    asking?.abort();
    held = null;
    tray.clear();
    location.hash = "#/";
    title.focus();
  }

  function update() {
    cards.replaceChildren(...trayCards(tray));
    refused.replaceChildren(...tray.refused.map((text) => h("p", { class: "notice" }, text)));
    const some = tray.grasps.length > 0;
    element.classList.toggle("busy-tray", some);
    askButton.disabled = !tray.complete;
    askButton.parentElement.hidden = !some;
    again.hidden = !held;
    if (!result.hasAttribute("aria-busy")) result.replaceChildren(some ? waiting(tray) : "");
  }

  async function graspSomething(objectId = null) {
    graspButton.disabled = again.disabled = true;
    announce("The jaws close.");
    refused.replaceChildren();
    try {
      const felt = await api.grasp(objectId);
      if (!objectId) tray.clear();
      held = felt.objectId;
      tray.addGrasp(felt.touches);
      if (subtracts) felt.background?.forEach((blob, place) => tray.putBackground(place, blob));
      await ask();
    } catch (error) {
      refused.replaceChildren(problemCard(error, () => graspSomething(objectId)));
    } finally {
      graspButton.disabled = again.disabled = false;
    }
  }

  async function ask() {
    if (!tray.complete) return;
    asking?.abort();
    const own = (asking = new AbortController());
    const touches = tray.grasps.map((grasp) => [...grasp]);
    const background = tray.untouched;
    askButton.disabled = true;
    result.setAttribute("aria-busy", "true");
    result.replaceChildren(
      h(
        "p",
        { class: "wait" },
        h("span", { class: "spinner", "aria-hidden": "true" }),
        `Comparing with ${count(index.photos, "photo")} ...`,
      ),
    );
    try {
      const { answer, id } = await api.query(touches, background, options);
      if (own.signal.aborted) return;
      tray.marks = answer.query.grasps;
      cards.replaceChildren(...trayCards(tray));
      const asked = { touches, background, options: { ...options }, held };
      result.replaceChildren(answerPanel({ index, answer, id, asked }));
      const said = verdict(answer);
      announce(`${said.above}: ${said.claim}. ${said.below}`);
      const { top } = result.getBoundingClientRect();
      if (top < 0 || top > innerHeight / 2) result.scrollIntoView();
    } catch (error) {
      if (!own.signal.aborted) result.replaceChildren(problemCard(error, ask));
    } finally {
      result.removeAttribute("aria-busy");
      askButton.disabled = !tray.complete;
    }
  }

  async function showKept(id) {
    result.setAttribute("aria-busy", "true");
    try {
      const kept = await api.entry(id);
      const touches = await Promise.all(kept.touches.map((grasp) => Promise.all(grasp.map(api.blob))));
      const background = subtracts ? await api.untouched(id, touches[0].map((_, place) => finger(place))) : null;
      tray.clear();
      held = null;
      touches.forEach((grasp) => tray.addGrasp(grasp));
      background?.forEach((blob, place) => tray.putBackground(place, blob));
      tray.marks = kept.answer.query.grasps;
      cards.replaceChildren(...trayCards(tray));
      const none_prior = kept.answer.posterior?.none_prior ?? options.none_prior;
      result.replaceChildren(
        answerPanel({
          index,
          answer: kept.answer,
          id,
          asked: { touches, background, options: { ...options, none_prior }, held: null },
          kept,
        }),
      );
    } catch (error) {
      result.replaceChildren(problemCard(error, () => showKept(id)));
    } finally {
      result.removeAttribute("aria-busy");
    }
  }

  tray.addEventListener("change", update);
  dropAnywhere(element, take);
  update();
  return { element, show: (id) => id && showKept(id), hide: live.stop };
}

function leadText(index) {
  const seen = `${count(index.photos, "photo")} of ${count(index.objects, "object")}`;
  return `Give the gel images of a grasp; the ${seen} are searched for the one that was felt.`;
}

function dropText(fingers) {
  return fingers > 1
    ? `${fingers} for each grasp, one of each finger; several grasps tell more`
    : "One for each grasp; several grasps tell more";
}

function waiting(tray) {
  const text = tray.complete
    ? "Ask, and the catalogue is ranked."
    : "A picture is missing: each grasp takes one of each finger.";
  return h("p", { class: "wait" }, text);
}

/** What an expert may say beside the touches. */
function optionsPanel(index, tray, options) {
  const number = (name, text, given, read) => {
    const id = `option-${name}`;
    const input = h("input", {
      id,
      type: "number",
      value: options[name] === null ? "" : String(options[name]),
      ...given,
    });
    input.addEventListener("change", () => {
      if (!input.checkValidity()) {
        input.reportValidity();
        return;
      }
      options[name] = input.value === "" ? DEFAULTS[name] : read(input.value);
    });
    return h("div", { class: "option" }, h("label", { for: id }, text), input);
  };
  const frames = h("div", { class: "fingers small" });
  const showFrames = () =>
    frames.replaceChildren(
      ...tray.background.map((blob, place) => {
        const text = index.fingers > 1 ? `Finger ${finger(place)}` : "The finger";
        return chooser(
          blob ? `${text}: ${blob.name ?? "taken"}` : text,
          ([file]) => tray.putBackground(place, file),
          { class: "quiet" },
          false,
        );
      }),
    );
  tray.addEventListener("change", showFrames);
  showFrames();
  return h(
    "details",
    { class: "options" },
    h("summary", {}, "Options"),
    h("p", { class: "faint" }, "No-contact frames: pictures of the untouched gels."),
    frames,
    number("top", "Objects to show", { min: "1", max: "100", step: "1" }, Number),
    number("candidates", "Photos to judge (empty: as the index needs)", { min: "1", step: "1" }, Number),
    number(
      "none_prior",
      "Chance, before anything is felt, that the catalogue lacks it",
      { min: "0.001", max: "0.999", step: "any" },
      Number,
    ),
  );
}

/** Files may be dropped anywhere on the view. */
function dropAnywhere(element, taken) {
  const carriesFiles = (event) => event.dataTransfer?.types.includes("Files") && !element.hidden;
  addEventListener("dragover", (event) => {
    if (!carriesFiles(event)) return;
    event.preventDefault();
    element.classList.add("over");
  });
  addEventListener("dragleave", (event) => !event.relatedTarget && element.classList.remove("over"));
  addEventListener("drop", (event) => {
    if (!carriesFiles(event)) return;
    event.preventDefault();
    element.classList.remove("over");
    taken([...event.dataTransfer.files]);
  });
}
