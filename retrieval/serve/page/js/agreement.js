// Occlusion map of a photo: bright parts lower the match if they are hidden, dark parts do not matter.

import * as api from "./api.js";
import { announce, h } from "./dom.js";

const SHADE = 0.82;
const LEGEND = "Bright: hiding this part lowers the match. Dark: this part does not matter.";
const LABEL = "Show agreement with the touch";

/** A tool for photos shown with the same touches; each map is requested once. */
export function agreementTool(query) {
  const known = new Map();
  return {
    of(id, image, frame) {
      const legend = h("span", { class: "legend", hidden: true }, LEGEND);
      const button = h("button", { type: "button", class: "link", "aria-pressed": "false" }, LABEL);
      let canvas = null;
      button.addEventListener("click", async () => {
        if (canvas) {
          canvas.remove();
          canvas = null;
        } else {
          button.disabled = true;
          button.textContent = "Computing ...";
          try {
            if (!known.has(id)) known.set(id, await api.agreement(id, query.touches, query.background));
            canvas = shade(known.get(id), image);
            frame.append(canvas);
            announce("The dark parts of the photo do not matter to the match.");
          } catch (error) {
            legend.textContent = error.detail ?? String(error);
            legend.hidden = false;
          }
          button.disabled = false;
          button.textContent = LABEL;
        }
        button.setAttribute("aria-pressed", String(canvas !== null));
        if (canvas) legend.textContent = LEGEND;
        if (canvas || known.has(id)) legend.hidden = !canvas;
      });
      return h("span", { class: "agreement" }, button, legend);
    },
  };
}

/** Draw the map as a shade over the photo, interpolated between the centres of its squares. */
function shade(map, image) {
  const largest = Math.max(...map.falls.flat(), 1e-9);
  const small = h("canvas", { width: map.columns, height: map.rows });
  const pixels = new ImageData(map.columns, map.rows);
  map.falls.flat().forEach((fall, place) => {
    pixels.data[4 * place + 3] = Math.round(255 * SHADE * (1 - Math.sqrt(Math.max(0, fall) / largest)));
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
