// The query view: gel images in, an answer out.

import * as api from "./api.js";
import { announce, h, problemCard } from "./dom.js";
import { answerPanel } from "./answer.js";
import { livePanel } from "./live.js";
import { Tray, chooser, finger, trayCards } from "./tray.js";
import { expectedField, verificationPanel } from "./verify.js";
import { count, verdict, verificationVerdict } from "./wording.js";

const DEFAULTS = { top: 12, candidates: null, none_prior: 0.5, far: 0.01 };

/** The query view. */
export function askView(index) {
  const tray = new Tray(index.fingers);
  const options = { ...DEFAULTS };
  let graspedObject = null; // the object that the simulated rig grasped
  let asking = null;
  const subtracts = index.background !== "none"; // the model subtracts no-contact frames

  const title = h("h1", { tabindex: "-1" }, "Which object is in the hand?");
  const lead = h("p", { class: "lead" }, leadText(index));
  const cards = h("div", { class: "cards" });
  const rejected = h("div", { class: "rejected-files", role: "alert" });
  const askButton = h("button", { type: "button", class: "primary", onclick: () => ask() }, "Ask");
  const clearButton = h("button", { type: "button", class: "quiet", onclick: () => start() }, "Start again");
  const live = livePanel(index, tray);
  const expected = expectedField(update);
  const again = h(
    "button",
    { type: "button", class: "quiet", onclick: () => graspSomething(graspedObject) },
    "Grasp it again",
  );
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
    rejected,
    drop,
    live.element,
    index.can_verify && expected.element,
    optionsPanel(index, tray, options),
    h("div", { class: "actions" }, askButton, clearButton),
  );
  const result = h("section", { class: "result", "aria-label": "Answer" });
  const element = h("div", { class: "ask" }, h("div", { class: "intro" }, title, lead), side, result);

  function take(files) {
    graspedObject = null;
    tray.addFiles(files);
    if (tray.complete) askButton.focus();
  }

  function start() {
    asking?.abort();
    graspedObject = null;
    tray.clear();
    location.hash = "#/";
    title.focus();
  }

  function update() {
    cards.replaceChildren(...trayCards(tray));
    rejected.replaceChildren(...tray.rejected.map((text) => h("p", { class: "notice" }, text)));
    const hasTouches = tray.grasps.length > 0;
    element.classList.toggle("has-touches", hasTouches);
    askButton.disabled = !tray.complete;
    askButton.textContent = expected.value() ? "Verify" : "Ask";
    askButton.parentElement.hidden = !hasTouches;
    again.hidden = !graspedObject;
    if (!result.hasAttribute("aria-busy")) result.replaceChildren(hasTouches ? waiting(tray, expected.value()) : "");
  }

  async function graspSomething(objectId = null) {
    graspButton.disabled = again.disabled = true;
    announce("Grasping ...");
    rejected.replaceChildren();
    try {
      const grasp = await api.grasp(objectId);
      if (!objectId) tray.clear();
      graspedObject = grasp.objectId;
      tray.addGrasp(grasp.touches, grasp.opening_mm);
      if (subtracts) grasp.background?.forEach((blob, place) => tray.putBackground(place, blob));
      await ask();
    } catch (error) {
      rejected.replaceChildren(problemCard(error, () => graspSomething(objectId)));
    } finally {
      graspButton.disabled = again.disabled = false;
    }
  }

  async function ask() {
    if (!tray.complete) return;
    asking?.abort();
    const own = (asking = new AbortController());
    const touches = tray.grasps.map((grasp) => [...grasp]);
    const openings = [...tray.openings];
    const background = tray.noContactFrames;
    const object = expected.value();
    askButton.disabled = true;
    result.setAttribute("aria-busy", "true");
    result.replaceChildren(
      h(
        "p",
        { class: "wait" },
        h("span", { class: "spinner", "aria-hidden": "true" }),
        `Comparing with ${object || count(index.photos, "photo")} ...`,
      ),
    );
    try {
      const asked = object ? verify(object, touches, background) : search(touches, background, openings);
      const { grasps, panel, text } = await asked;
      if (own.signal.aborted) return;
      tray.marks = grasps;
      cards.replaceChildren(...trayCards(tray));
      result.replaceChildren(panel());
      announce(`${text.above}: ${text.claim}. ${text.below}`);
      const { top } = result.getBoundingClientRect();
      if (top < 0 || top > innerHeight / 2) result.scrollIntoView();
    } catch (error) {
      if (!own.signal.aborted) result.replaceChildren(problemCard(error, ask));
    } finally {
      result.removeAttribute("aria-busy");
      askButton.disabled = !tray.complete;
    }
  }

  async function search(touches, background, openings) {
    const { far, ...searchOptions } = options;
    const { answer, id } = await api.query(touches, background, openings, searchOptions);
    const query = { touches, background, openings, options: searchOptions, graspedObject };
    return { grasps: answer.query.grasps, panel: () => answerPanel({ index, answer, id, query }), text: verdict(answer) };
  }

  async function verify(object, touches, background) {
    const found = await api.verify(object, touches, background, options.far);
    const panel = () => verificationPanel(found, graspedObject);
    return { grasps: found.grasps, panel, text: verificationVerdict(found) };
  }

  async function showStored(id) {
    result.setAttribute("aria-busy", "true");
    try {
      const stored = await api.entry(id);
      const touches = await Promise.all(stored.touches.map((grasp) => Promise.all(grasp.map(api.blob))));
      const background = subtracts ? await api.noContactFrames(id, touches[0].map((_, place) => finger(place))) : null;
      tray.clear();
      graspedObject = null;
      const openings = stored.answer.query.opening_mm ?? touches.map(() => null);
      touches.forEach((grasp, place) => tray.addGrasp(grasp, openings[place]));
      background?.forEach((blob, place) => tray.putBackground(place, blob));
      tray.marks = stored.answer.query.grasps;
      cards.replaceChildren(...trayCards(tray));
      const none_prior = stored.answer.posterior?.none_prior ?? options.none_prior;
      result.replaceChildren(
        answerPanel({
          index,
          answer: stored.answer,
          id,
          query: { touches, background, openings, options: { ...options, none_prior }, graspedObject: null },
          stored,
        }),
      );
    } catch (error) {
      result.replaceChildren(problemCard(error, () => showStored(id)));
    } finally {
      result.removeAttribute("aria-busy");
    }
  }

  tray.addEventListener("change", update);
  acceptDrops(element, take);
  update();
  return { element, show: (id) => id && showStored(id), hide: live.stop };
}

function leadText(index) {
  const photos = `${count(index.photos, "photo")} of ${count(index.objects, "object")}`;
  return `Add the gel images of a grasp to find the touched object among ${photos}.`;
}

function dropText(fingers) {
  return fingers > 1
    ? `${fingers} for each grasp, one of each finger; several grasps improve the answer`
    : "One for each grasp; several grasps improve the answer";
}

function waiting(tray, object) {
  const text = tray.complete
    ? object
      ? `Press \u201cVerify\u201d to compare with ${object}.`
      : "Press \u201cAsk\u201d to rank the catalogue."
    : "A picture is missing: each grasp needs one of each finger.";
  return h("p", { class: "wait" }, text);
}

/** Options for experts. */
function optionsPanel(index, tray, options) {
  const number = (name, text, attributes, read) => {
    const id = `option-${name}`;
    const input = h("input", {
      id,
      type: "number",
      value: options[name] === null ? "" : String(options[name]),
      ...attributes,
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
  const openings = h("div", { class: "openings" });
  const showOpenings = () =>
    openings.replaceChildren(
      ...tray.openings.map((opening, place) => {
        const id = `opening-${place + 1}`;
        const input = h("input", { id, type: "number", min: "0.01", step: "any", value: opening?.toFixed(2) ?? "" });
        input.addEventListener("change", () => {
          if (input.reportValidity()) tray.openings[place] = input.value === "" ? null : Number(input.value);
        });
        return h("div", { class: "option" }, h("label", { for: id }, `Opening of the jaws in mm, grasp ${place + 1}`), input);
      }),
    );
  const show = () => (showFrames(), showOpenings());
  tray.addEventListener("change", show);
  show();
  return h(
    "details",
    { class: "options" },
    h("summary", {}, "Options"),
    h("p", { class: "muted" }, "No-contact frames: pictures of the gels before contact."),
    frames,
    openings,
    number("top", "Objects to show", { min: "1", max: "100", step: "1" }, Number),
    number("candidates", "Photos to score (empty: the index's own number)", { min: "1", step: "1" }, Number),
    number(
      "none_prior",
      "Prior probability that the catalogue lacks the object",
      { min: "0.001", max: "0.999", step: "any" },
      Number,
    ),
    index.can_verify &&
      number("far", "False-accept rate of a verification", { min: "0.00001", max: "0.5", step: "any" }, Number),
  );
}

/** Accept files that are dropped anywhere on the view. */
function acceptDrops(element, onFiles) {
  const carriesFiles = (event) => event.dataTransfer?.types.includes("Files") && !element.hidden;
  addEventListener("dragover", (event) => {
    if (!carriesFiles(event)) return;
    event.preventDefault();
    element.classList.add("drag-over");
  });
  addEventListener("dragleave", (event) => !event.relatedTarget && element.classList.remove("drag-over"));
  addEventListener("drop", (event) => {
    if (!carriesFiles(event)) return;
    event.preventDefault();
    element.classList.remove("drag-over");
    onFiles([...event.dataTransfer.files]);
  });
}
