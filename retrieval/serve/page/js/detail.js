// An object in detail: its photos large, the touch beside them, what is known of it, and what looks like it.

import * as api from "./api.js";
import { announce, h, picture, problemCard } from "./dom.js";
import { agreementTool } from "./agreement.js";
import { blobURL, finger } from "./tray.js";
import { count } from "./words.js";

const MOST_PHOTOS = 500;

/** Open the dialog on a photo; `asked` holds the touches that were asked about, null in the catalogue. */
export function openDetail({ index, photo, objectId, asked = null }) {
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
    const stage = photoStage(index, asked);
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

/** The photo, and the touch beside it; a click enlarges either. */
function photoStage(index, asked) {
  const photos = h("div", { class: "frame" });
  const photoFigure = h("figure", { class: "pane" }, photos);
  const element = h("div", { class: "stage" }, photoFigure);
  const tool = asked && agreementTool(asked);
  const caption = h("figcaption", {});
  photoFigure.append(caption);
  if (asked) element.append(touchPane(index, asked, element));

  function show(id) {
    const image = picture(api.photoURL(id), `Photo ${id}`);
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

function touchPane(index, asked, stage) {
  const frame = h("div", { class: "frame" });
  const pane = h("figure", { class: "pane" }, frame);
  const all = asked.touches.flatMap((grasp, number) => grasp.map((blob, place) => ({ blob, number, place })));
  const say = ({ number, place }) => `Grasp ${number + 1}${index.fingers > 1 ? `, finger ${finger(place)}` : ""}`;
  const show = (one) =>
    frame.replaceChildren(enlarger(picture(blobURL(one.blob), `Gel image: ${say(one)}`), "the touch", stage, pane));
  const choose = h(
    "select",
    { "aria-label": "Touch beside the photo" },
    all.map((one, place) => h("option", { value: String(place) }, say(one))),
  );
  choose.addEventListener("change", () => show(all[Number(choose.value)]));
  show(all[0]);
  pane.append(h("figcaption", {}, all.length > 1 ? choose : say(all[0])));
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
