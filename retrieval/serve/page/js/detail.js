// Details of an object: large photos next to the touch, and metadata.

import * as api from "./api.js";
import { announce, h, picture, problemCard } from "./dom.js";
import { blobURL, finger } from "./tray.js";
import { count, nearness } from "./wording.js";

const MAX_PHOTOS = 500;

/** Open the dialog on a photo. `query` contains the touches of the query, null in the catalogue view; `reference` is
 *  the object's nearest reference touch, null if it has none. */
export function openDetail({ index, photo, objectId, query = null, reference = null }) {
  const dialog = h("dialog", { class: "detail", "aria-labelledby": "detail-title" });
  const close = () => dialog.close();
  const title = h("h2", { id: "detail-title", tabindex: "-1" });
  const body = h("div", { class: "detail-body" });
  const head = h(
    "div",
    { class: "detail-head" },
    title,
    h("button", { type: "button", class: "close-button", "aria-label": "Close", onclick: close }, "×"),
  );
  dialog.append(head, body);
  dialog.addEventListener("close", () => dialog.remove());
  dialog.addEventListener("click", (event) => event.target === dialog && close());
  document.body.append(dialog);
  dialog.showModal();
  showObject();
  title.focus();

  async function showObject() {
    title.textContent = objectId;
    const stage = photoStage(index, query, reference);
    const strip = h("ul", { class: "film", "aria-label": "Photos of this object" });
    const facts = h("div", { class: "facts" });
    body.replaceChildren(stage.element, strip, facts);
    const select = (each, button) => {
      stage.show(each.id);
      strip.querySelectorAll("button").forEach((other) => other.setAttribute("aria-pressed", String(other === button)));
      facts.replaceChildren(metadata(each));
    };
    stage.show(photo);
    try {
      const found = await api.catalogue({ object: objectId, limit: MAX_PHOTOS });
      const buttons = found.items.map((each, place) => {
        const button = h(
          "button",
          { type: "button", "aria-pressed": "false", "aria-label": `Photo ${place + 1} of ${found.items.length}` },
          picture(api.thumbnailURL(each.id, 160), "", { loading: "lazy" }),
        );
        button.addEventListener("click", () => select(each, button));
        return h("li", {}, button);
      });
      strip.replaceChildren(...buttons);
      const place = Math.max(
        0,
        found.items.findIndex((each) => each.id === photo),
      );
      if (found.items.length) select(found.items[place], buttons[place].firstChild);
      announce(`${objectId}, ${count(found.total, "photo")}`);
    } catch (error) {
      strip.replaceWith(problemCard(error));
    }
  }
}

/** The photo next to the nearest reference touch and the touch; a click enlarges each. */
function photoStage(index, query, reference) {
  const photos = h("div", { class: "frame" });
  const photoFigure = h("figure", { class: "pane" }, photos);
  const element = h("div", { class: "stage" }, photoFigure);
  const touchOnly = reference !== null && reference.adds === null; // the shown picture is a gel image, not a photo
  const caption = h("figcaption", {});
  photoFigure.append(caption);
  if (reference) element.append(gelPane("the reference touch", referenceGels(index, reference), element));
  if (query) element.append(gelPane("the touch", queryGels(index, query), element));

  function show(id) {
    const image = picture(api.photoURL(id), touchOnly ? `Gel image ${id}` : `Photo ${id}`);
    photos.replaceChildren(enlarger(image, "the photo", element, photoFigure));
    caption.replaceChildren(h("span", { class: "muted" }, id));
  }
  return { element, show };
}

/** A picture as a button that toggles its full size. */
function enlarger(image, name, stage, pane) {
  const label = () => `${pane.classList.contains("large") ? "Show smaller" : "Enlarge"} ${name}`;
  const button = h(
    "button",
    { type: "button", class: "enlarge", "aria-pressed": "false", "aria-label": label() },
    image,
  );
  button.addEventListener("click", () => {
    const large = pane.classList.toggle("large");
    stage.classList.toggle("one", large);
    button.setAttribute("aria-pressed", String(large));
    button.setAttribute("aria-label", label());
  });
  return button;
}

const ofFinger = (index, place) => (index.fingers > 1 ? `, finger ${finger(place)}` : "");

function queryGels(index, query) {
  const gels = query.touches.flatMap((grasp, number) =>
    grasp.map((blob, place) => ({ src: blobURL(blob), name: `Grasp ${number + 1}${ofFinger(index, place)}` })),
  );
  return { gels, choice: "Touch next to the photo", note: null };
}

function referenceGels(index, reference) {
  const gels = reference.touch.map((path, place) => ({
    src: api.photoURL(path),
    name: `Nearest reference touch${ofFinger(index, place)}`,
  }));
  return { gels, choice: "Reference touch next to the photo", note: nearness(reference) };
}

/** A pane that shows one of several gel images. */
function gelPane(title, { gels, choice, note }, stage) {
  const frame = h("div", { class: "frame" });
  const pane = h("figure", { class: "pane" }, frame);
  const show = ({ src, name }) =>
    frame.replaceChildren(enlarger(picture(src, `Gel image: ${name}`), title, stage, pane));
  const choose = h(
    "select",
    { "aria-label": choice },
    gels.map(({ name }, place) => h("option", { value: String(place) }, name)),
  );
  choose.addEventListener("change", () => show(gels[Number(choose.value)]));
  show(gels[0]);
  pane.append(
    h("figcaption", {}, gels.length > 1 ? choose : gels[0].name, note && h("span", { class: "muted" }, note)),
  );
  return pane;
}

function metadata(photo) {
  const rows = Object.entries(photo.metadata);
  if (!rows.length) return h("p", { class: "muted" }, "The catalogue has no metadata for this photo.");
  const text = (value) => (typeof value === "object" ? JSON.stringify(value) : String(value));
  return h(
    "dl",
    {},
    rows.map(([term, value]) => [h("dt", {}, term), h("dd", {}, text(value))]),
  );
}
