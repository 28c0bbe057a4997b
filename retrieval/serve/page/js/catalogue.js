// The catalogue view: only the photos on the screen become elements, and only their pages are requested.

import * as api from "./api.js";
import { h, picture, problemCard, debounce } from "./dom.js";
import { openDetail } from "./detail.js";
import { count } from "./wording.js";

const PAGE = 200;
const MAX_PAGES = 50;
const MIN_WIDTH = 170;
const LABEL_PX = 46;
const GAP = 16;
const SPARE_ROWS = 2;

export function catalogueView(index) {
  const search = h("input", {
    type: "search",
    id: "catalogue-search",
    autocomplete: "off",
    placeholder: "Object, file or metadata",
  });
  const total = h("p", { class: "muted", role: "status" });
  const problem = h("div", {});
  const grid = h("ul", { class: "grid", "aria-label": "Photos of the catalogue" });
  const element = h(
    "div",
    { class: "catalogue" },
    h("h1", { tabindex: "-1" }, "Catalogue"),
    h(
      "div",
      { class: "filters" },
      h("div", { class: "field" }, h("label", { for: "catalogue-search" }, "Search"), search),
    ),
    total,
    problem,
    grid,
  );
  const tiles = new Map(); // place -> element
  let pages = new Map(); // number -> photos, or their promise
  let found = null; // number of matching photos
  let words = "";
  let focused = 0;

  function layout() {
    const width = grid.clientWidth;
    const columns = Math.max(2, Math.floor((width + GAP) / (MIN_WIDTH + GAP)));
    const side = (width - GAP * (columns - 1)) / columns;
    return { columns, side, row: side + LABEL_PX + GAP };
  }

  async function page(number) {
    if (!pages.has(number)) {
      const own = pages;
      own.set(number, api.catalogue({ offset: number * PAGE, limit: PAGE, search: words }));
      try {
        const answer = await own.get(number);
        own.set(number, answer.items);
        if (own !== pages) return;
        forget(number);
        if (found !== answer.total) {
          found = answer.total;
          showTotal();
        }
        problem.replaceChildren();
      } catch (error) {
        own.delete(number);
        if (own === pages) problem.replaceChildren(problemCard(error, draw));
        return;
      }
      draw();
    }
  }

  /** Keep only the pages nearest to the newest one. */
  function forget(number) {
    const far = [...pages.keys()].sort((one, other) => Math.abs(one - number) - Math.abs(other - number));
    far.slice(MAX_PAGES).forEach((each) => pages.delete(each));
  }

  function showTotal() {
    total.textContent = found
      ? words
        ? `${count(found, "photo")} found`
        : `${count(found, "photo")} of ${count(index.objects, "object")}`
      : "No photo of the catalogue matches all these words.";
  }

  /** Create elements for the rows on the screen, and keep the focused one. */
  function draw() {
    if (element.hidden || found === null) return;
    const { columns, side, row } = layout();
    grid.style.height = `${Math.ceil(found / columns) * row}px`;
    const above = Math.max(0, -grid.getBoundingClientRect().top);
    const first = Math.max(0, (Math.floor(above / row) - SPARE_ROWS) * columns);
    const last = Math.min(found, (Math.ceil((above + innerHeight) / row) + SPARE_ROWS) * columns);
    const active = document.activeElement?.closest?.(".grid li");
    for (const [place, tile] of tiles) {
      if ((place < first || place >= last) && tile !== active) {
        tile.remove();
        tiles.delete(place);
      }
    }
    for (let place = first; place < last; place += 1) {
      const items = pages.get(Math.floor(place / PAGE));
      if (!Array.isArray(items)) page(Math.floor(place / PAGE));
      else if (items[place % PAGE]) show(place, items[place % PAGE]);
    }
    for (const [place, tile] of tiles) {
      tile.style.width = `${side}px`;
      tile.style.transform = `translate(${(place % columns) * (side + GAP)}px, ${Math.floor(place / columns) * row}px)`;
    }
  }

  function show(place, photo) {
    if (tiles.has(place)) return;
    const open = () => {
      focused = place;
      openDetail({ index, photo: photo.id, objectId: photo.object_id });
    };
    const button = h(
      "button",
      { type: "button", class: "tile", onclick: open, tabindex: place === focused ? "0" : "-1" },
      picture(api.thumbnailURL(photo.id, 320), ""),
      h("span", { class: "name" }, photo.object_id),
    );
    const tile = h("li", { "aria-setsize": String(found), "aria-posinset": String(place + 1) }, button);
    tile.dataset.place = String(place);
    tiles.set(place, tile);
    const next = [...grid.children].find((other) => Number(other.dataset.place) > place);
    grid.insertBefore(tile, next ?? null);
  }

  function clear() {
    tiles.forEach((tile) => tile.remove());
    tiles.clear();
    pages = new Map();
    found = null;
    focused = 0;
  }

  async function start() {
    clear();
    words = search.value.trim();
    await page(0);
  }

  /** Draw a photo and focus it. */
  async function focus(place) {
    focused = Math.min(found - 1, Math.max(0, place));
    const { columns, row } = layout();
    const top = grid.getBoundingClientRect().top + scrollY + Math.floor(focused / columns) * row;
    if (top < scrollY || top + row > scrollY + innerHeight) scrollTo(0, top - (innerHeight - row) / 2);
    await page(Math.floor(focused / PAGE));
    await pages.get(Math.floor(focused / PAGE));
    draw();
    tiles.forEach((tile, each) => (tile.firstChild.tabIndex = each === focused ? 0 : -1));
    tiles.get(focused)?.firstChild.focus({ preventScroll: true });
  }

  grid.addEventListener("keydown", (event) => {
    const { columns } = layout();
    const shown = Math.max(1, Math.floor(innerHeight / layout().row)) * columns;
    const steps = {
      ArrowRight: 1,
      ArrowLeft: -1,
      ArrowDown: columns,
      ArrowUp: -columns,
      PageDown: shown,
      PageUp: -shown,
    };
    const place = Number(event.target.closest("li")?.dataset.place ?? focused);
    const to =
      event.key === "Home" ? 0 : event.key === "End" ? found - 1 : steps[event.key] && place + steps[event.key];
    if (to === undefined || to === null) return;
    event.preventDefault();
    focus(to);
  });
  search.addEventListener("input", debounce(start));
  addEventListener("enrolment", clear);
  addEventListener("scroll", draw, { passive: true });
  new ResizeObserver(draw).observe(grid);
  return { element, show: () => (found === null ? start() : draw()) };
}
