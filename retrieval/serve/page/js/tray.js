// The gel images of the next query: grasps, each with a picture for each finger.

import { h, picture } from "./dom.js";

export const MAX_GRASPS = 32;
const MAX_BYTES = 20_000_000;
const LETTERS = "abcdefgh";
const natural = new Intl.Collator("en", { numeric: true });
const FINGER = /^(?:(.*?)[^a-z0-9]+|.*?\d|)(a|b|1|2|left|right)(\d*)$/i;

/** The finger's letter, from 0. */
export const finger = (place) => LETTERS[place];

/** Group files by grasp: by finger names such as mug_a.png and mug_b.png if all files have them, else by name order. */
export function groupByGrasp(files, fingers) {
  const sorted = [...files].sort((one, other) => natural.compare(one.name, other.name));
  if (fingers === 2 && files.length > 1) {
    const groups = new Map();
    for (const file of sorted) {
      const stem = file.name.replace(/\.[^.]*$/, "");
      const found = FINGER.exec(stem);
      if (!found) break;
      const key = stem.slice(0, stem.length - found[2].length - found[3].length) + found[3];
      const place = ["a", "1", "left"].includes(found[2].toLowerCase()) ? 0 : 1;
      const group = groups.get(key) ?? groups.set(key, [null, null]).get(key);
      if (group[place]) break;
      group[place] = file;
    }
    const paired = [...groups.values()];
    if (paired.flat().filter(Boolean).length === files.length && paired.every((group) => group.every(Boolean)))
      return paired;
  }
  const grasps = [];
  for (let start = 0; start < sorted.length; start += fingers) grasps.push(sorted.slice(start, start + fingers));
  return grasps;
}

/** A problem that is visible without reading the file, or null. */
function fileProblem(file) {
  if (file.type && !file.type.startsWith("image/")) return `${file.name} is not a picture.`;
  if (file.size > MAX_BYTES) return `${file.name} has ${(file.size / 1e6).toFixed(1)} MB; the limit is 20 MB.`;
  return null;
}

export class Tray extends EventTarget {
  constructor(fingers) {
    super();
    this.fingers = fingers;
    this.background = Array(fingers).fill(null);
    this.grasps = [];
    this.openings = []; // of the jaws in mm, null where it is not known
    this.marks = [];
    this.rejected = [];
  }

  /** Whether every grasp has all its pictures. */
  get complete() {
    return this.grasps.length > 0 && this.grasps.every((grasp) => grasp.every(Boolean));
  }

  /** The no-contact frames; null unless there is one for each finger. */
  get noContactFrames() {
    return this.background.every(Boolean) ? this.background : null;
  }

  /** Add files: one file replaces a missing picture, others become new grasps. */
  addFiles(files) {
    this.rejected = [...files].map(fileProblem).filter(Boolean);
    const good = [...files].filter((file) => !fileProblem(file));
    const last = this.grasps.at(-1);
    const missing = last?.indexOf(null) ?? -1;
    if (missing >= 0 && good.length === 1) last[missing] = good[0];
    else groupByGrasp(good, this.fingers).forEach((grasp) => this._append(grasp));
    this._changed();
  }

  /** Add a grasp; missing pictures can follow. */
  addGrasp(pictures, opening_mm = null) {
    this.rejected = [];
    this._append(pictures, opening_mm);
    this._changed();
  }

  _append(pictures, opening_mm = null) {
    if (this.grasps.length === MAX_GRASPS) {
      this.rejected.push(`A query can have at most ${MAX_GRASPS} grasps.`);
      return;
    }
    this.grasps.push(Array.from({ length: this.fingers }, (_, place) => pictures[place] ?? null));
    this.openings.push(opening_mm);
  }

  put(grasp, place, blob) {
    this.rejected = [fileProblem(blob)].filter(Boolean);
    if (!this.rejected.length) this.grasps[grasp][place] = blob;
    this._changed();
  }

  putBackground(place, blob) {
    this.background[place] = blob;
    this._changed();
  }

  /** Remove a picture, and the grasp if it was the last one. */
  remove(grasp, place) {
    this.grasps[grasp][place] = null;
    if (this.grasps[grasp].some(Boolean)) this._changed();
    else this.removeGrasp(grasp);
  }

  removeGrasp(grasp) {
    this.grasps.splice(grasp, 1);
    this.openings.splice(grasp, 1);
    this._changed();
  }

  /** Swap the fingers of a grasp. */
  swapFingers(grasp) {
    this.grasps[grasp].push(this.grasps[grasp].shift());
    this._changed();
  }

  clear() {
    this.grasps = [];
    this.openings = [];
    this.background = Array(this.fingers).fill(null);
    this.rejected = [];
    this._changed();
  }

  _changed() {
    this.marks = [];
    this.dispatchEvent(new Event("change"));
  }
}

const urls = new WeakMap();

/** The URL of a picture in this browser; the same for the same picture. */
export function blobURL(blob) {
  if (!urls.has(blob)) urls.set(blob, URL.createObjectURL(blob));
  return urls.get(blob);
}

/** A button that chooses files. */
export function chooser(text, onFiles, attributes = {}, multiple = true) {
  const input = h("input", {
    type: "file",
    accept: "image/*,.heic,.heif,.avif",
    multiple,
    class: "visually-hidden",
    tabindex: "-1",
    "aria-hidden": "true",
  });
  input.addEventListener("change", () => {
    if (input.files.length) onFiles([...input.files]);
    input.value = "";
  });
  return h(
    "span",
    { class: "chooser" },
    h("button", { type: "button", ...attributes, onclick: () => input.click() }, text),
    input,
  );
}

/** The grasps as cards; `readOnly` omits the tools. */
export function trayCards(tray, readOnly = false) {
  return tray.grasps.map((pictures, number) => {
    const mark = tray.marks[number];
    const marked = mark && mark !== "contact" && `${mark}, not scored`;
    return h(
      "fieldset",
      { class: `grasp${marked ? " marked" : ""}` },
      h("legend", {}, `Grasp ${number + 1}`),
      h(
        "div",
        { class: "grasp-tools" },
        marked && h("strong", { class: "mark" }, marked),
        !readOnly &&
          tray.fingers > 1 &&
          pictures.every(Boolean) &&
          h(
            "button",
            { type: "button", class: "link", onclick: () => tray.swapFingers(number) },
            "Swap fingers",
            h("span", { class: "visually-hidden" }, ` of grasp ${number + 1}`),
          ),
        !readOnly &&
          h(
            "button",
            { type: "button", class: "link", onclick: () => tray.removeGrasp(number) },
            "Remove",
            h("span", { class: "visually-hidden" }, ` grasp ${number + 1}`),
          ),
      ),
      h(
        "div",
        { class: "fingers" },
        pictures.map((blob, place) => slot(tray, number, place, blob, readOnly)),
      ),
    );
  });
}

function slot(tray, number, place, blob, readOnly) {
  const name = tray.fingers > 1 ? `finger ${finger(place)}` : "the finger";
  if (!blob) {
    return h(
      "div",
      { class: "slot empty" },
      chooser(`Choose ${name}`, ([file]) => tray.put(number, place, file), { class: "slot-choose" }, false),
    );
  }
  const remove = () => tray.remove(number, place);
  return h(
    "figure",
    { class: "slot" },
    picture(blobURL(blob), `Gel image, grasp ${number + 1}, ${name}`),
    h("figcaption", {}, tray.fingers > 1 ? `Finger ${finger(place)}` : (blob.name ?? "")),
    !readOnly &&
      h(
        "button",
        { type: "button", class: "close-button", "aria-label": `Remove ${name} of grasp ${number + 1}`, onclick: remove },
        "×",
      ),
  );
}
