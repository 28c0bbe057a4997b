// Where a photo agrees with the touch: bright where hiding it lowers the match, dark where it does not matter.

import * as api from "./api.js";
import { announce, h } from "./dom.js";

const SHADE = 0.82;

/** A tool for photos beside the same touches; a map is asked for once. */
export function agreementTool(asked) {
  const known = new Map();
  return {
    of(id, image, frame) {
      const legend = h(
        "span",
        { class: "legend", hidden: true },
        "Bright: hiding it lowers the match. Dark: it does not matter.",
      );
      const button = h(
        "button",
        { type: "button", class: "link", "aria-pressed": "false" },
        "Where it agrees with the touch",
      );
      let canvas = null;
      button.addEventListener("click", async () => {
        if (canvas) {
          canvas.remove();
          canvas = null;
        } else {
          button.disabled = true;
          button.textContent = "Looking ...";
          try {
            if (!known.has(id)) known.set(id, await api.agreement(id, asked.touches, asked.background));
            canvas = shade(known.get(id), image);
            frame.append(canvas);
            announce("The photo is dark where it does not matter to the match.");
          } catch (error) {
            legend.textContent = error.detail ?? String(error);
            legend.hidden = false;
          }
          button.disabled = false;
          button.textContent = "Where it agrees with the touch";
        }
        button.setAttribute("aria-pressed", String(canvas !== null));
        if (canvas) legend.textContent = "Bright: hiding it lowers the match. Dark: it does not matter.";
        if (canvas || known.has(id)) legend.hidden = !canvas;
      });
      return h("span", { class: "agree" }, button, legend);
    },
  };
}

/** The map as a shade over the photo, smooth between the middles of its squares. */
function shade(map, image) {
  const most = Math.max(...map.falls.flat(), 1e-9);
  const small = h("canvas", { width: map.columns, height: map.rows });
  const pixels = new ImageData(map.columns, map.rows);
  map.falls.flat().forEach((fall, place) => {
    pixels.data[4 * place + 3] = Math.round(255 * SHADE * (1 - Math.sqrt(Math.max(0, fall) / most)));
  });
  small.getContext("2d").putImageData(pixels, 0, 0);
  const width = image.naturalWidth || 640;
  const height = image.naturalHeight || 640;
  const canvas = h("canvas", { class: "map", width, height, "aria-hidden": "true" });
  canvas.dataset.squares = String(map.falls.flat().length);
  const context = canvas.getContext("2d");
  context.imageSmoothingQuality = "high";
  context.drawImage(small, 0, 0, width, height);
  return canvas;
}
