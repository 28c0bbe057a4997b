// An object in detail: its photos large, the touch beside them, what is known of it, and what looks like it.

import * as api from "./api.js";
import { announce, h, picture, problemCard } from "./dom.js";
import { agreementTool } from "./agreement.js";
import { blobURL, finger } from "./tray.js";
import { count, nearness } from "./words.js";

const MOST_PHOTOS = 500;

/** Open the dialog on a photo; `asked` holds the touches that were asked about, null in the catalogue; `reference` is
 *  the object's reference touch that is nearest to them, where it has any. */
export function openDetail({ index, photo, objectId, asked = null, reference = null }) {
  const dialog = h("dialog", { class: "detail", "aria-labelledby": "detail-title" });
  const close = () => dialog.close();
  const title = h("h2", { id: "detail-title", tabindex: "-1" });
  const body = h("div", { class: "detail-body" });
  const head = h(
    "div",
    { class: "detail-head" },
    title,
    h("button", { type: "button", class: "cross", "aria-label": "Close", onclick: close }, "×"),
  );
  dialog.append(head, body);
  dialog.addEventListener("close", () => dialog.remove());
  dialog.addEventListener("click", (event) => event.target === dialog && close());
  document.body.append(dialog);
  dialog.showModal();
  showObject(photo, objectId);
  title.focus();

  async function showObject(firstPhoto, name) {
    title.textContent = name;
    const stage = photoStage(index, asked, name === objectId ? reference : null);
    const strip = h("ul", { class: "film", "aria-label": "Photos of this object" });
    const facts = h("div", { class: "facts" });
    const alike = h("div", { class: "alike" });
    body.replaceChildren(stage.element, strip, facts, alike);
    const select = (each, button) => {
      stage.show(each.id);
      strip.querySelectorAll("button").forEach((other) => other.setAttribute("aria-pressed", String(other === button)));
      facts.replaceChildren(metadata(each));
      showAlike(alike, each, showObject);
    };
    stage.show(firstPhoto);
    try {
      const found = await api.catalogue({ object: name, limit: MOST_PHOTOS });
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
        found.items.findIndex((each) => each.id === firstPhoto),
      );
      if (found.items.length) select(found.items[place], buttons[place].firstChild);
      announce(`${name}, ${count(found.total, "photo")}`);
    } catch (error) {
      strip.replaceWith(problemCard(error));
    }
  }
}

/** The photo, the nearest reference touch and the touch beside it; a click enlarges each. */
function photoStage(index, asked, reference) {
  const photos = h("div", { class: "frame" });
  const photoFigure = h("figure", { class: "pane" }, photos);
  const element = h("div", { class: "stage" }, photoFigure);
  const alone = reference !== null && reference.adds === null; // what is shown is a gel image, and no photo
  const tool = asked && !alone && agreementTool(asked);
  const caption = h("figcaption", {});
  photoFigure.append(caption);
  if (reference) element.append(gelPane("the reference touch", referenceGels(index, reference), element));
  if (asked) element.append(gelPane("the touch", askedGels(index, asked), element));

  function show(id) {
    const image = picture(api.photoURL(id), alone ? `Gel image ${id}` : `Photo ${id}`);
    photos.replaceChildren(enlarger(image, "the photo", element, photoFigure));
    caption.replaceChildren(h("span", { class: "faint" }, id), tool ? tool.of(id, image, photos) : "");
  }
  return { element, show };
}

/** A picture as a button that gives it the whole stage, and takes it back. */
function enlarger(image, what, stage, pane) {
  const label = () => `${pane.classList.contains("large") ? "Show smaller" : "Enlarge"} ${what}`;
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

function askedGels(index, asked) {
  const gels = asked.touches.flatMap((grasp, number) =>
    grasp.map((blob, place) => ({ src: blobURL(blob), name: `Grasp ${number + 1}${ofFinger(index, place)}` })),
  );
  return { gels, choice: "Touch beside the photo", note: null };
}

function referenceGels(index, reference) {
  const gels = reference.touch.map((path, place) => ({
    src: api.photoURL(path),
    name: `Nearest reference touch${ofFinger(index, place)}`,
  }));
  return { gels, choice: "Reference touch beside the photo", note: nearness(reference) };
}

/** Gel images, of which one is shown. */
function gelPane(what, { gels, choice, note }, stage) {
  const frame = h("div", { class: "frame" });
  const pane = h("figure", { class: "pane" }, frame);
  const show = ({ src, name }) =>
    frame.replaceChildren(enlarger(picture(src, `Gel image: ${name}`), what, stage, pane));
  const choose = h(
    "select",
    { "aria-label": choice },
    gels.map(({ name }, place) => h("option", { value: String(place) }, name)),
  );
  choose.addEventListener("change", () => show(gels[Number(choose.value)]));
  show(gels[0]);
  pane.append(
    h("figcaption", {}, gels.length > 1 ? choose : gels[0].name, note && h("span", { class: "faint" }, note)),
  );
  return pane;
}

function metadata(photo) {
  const rows = Object.entries(photo.metadata);
  if (!rows.length) return h("p", { class: "faint" }, "The catalogue says nothing more of this photo.");
  const said = (value) => (typeof value === "object" ? JSON.stringify(value) : String(value));
  return h(
    "dl",
    {},
    rows.map(([term, value]) => [h("dt", {}, term), h("dd", {}, said(value))]),
  );
}

async function showAlike(place, photo, showObject) {
  place.replaceChildren();
  let found;
  try {
    found = await api.nearest(photo.id);
  } catch {
    return; // an index without embeddings has none to compare
  }
  const items = found.items.map((each) =>
    h(
      "li",
      {},
      h(
        "button",
        { type: "button", onclick: () => showObject(each.id, each.object_id) },
        picture(api.thumbnailURL(each.id, 240), "", { loading: "lazy" }),
        h("span", {}, each.object_id),
      ),
    ),
  );
  if (items.length)
    place.replaceChildren(
      h("h3", {}, "Photos that look like this one to the model"),
      h("ul", { class: "film named" }, items),
    );
}
