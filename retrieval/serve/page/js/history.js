// The history: what was asked, what was answered, what people said of it.

import * as api from "./api.js";
import { announce, h, picture, problemCard, settled } from "./dom.js";
import { count, moment, percent, saidWords } from "./words.js";

const PAGE = 30;
const SAID = [
  ["", "Everything"],
  ["missing", "Nothing said yet"],
  ["right", "Said to be right"],
  ["object", "Said to be another object"],
  ["none", "Said to be none"],
];

export function historyView() {
  const search = h("input", { type: "search", id: "history-search", autocomplete: "off" });
  const said = h(
    "select",
    { id: "history-said" },
    SAID.map(([value, text]) => h("option", { value }, text)),
  );
  const total = h("p", { class: "faint", role: "status" });
  const list = h("ul", { class: "queries" });
  const more = h(
    "button",
    { type: "button", class: "quiet more", hidden: true, onclick: () => load(list.children.length) },
    "Older",
  );
  const near = h("section", { class: "near", hidden: true, "aria-label": "Touches that feel alike" });
  const element = h(
    "div",
    { class: "history" },
    h(
      "div",
      { class: "view-head" },
      h("h1", { tabindex: "-1" }, "History"),
      h("a", { class: "quiet button", href: api.EXPORT, download: "" }, "Export all"),
    ),
    h(
      "div",
      { class: "filters" },
      h("div", { class: "field" }, h("label", { for: "history-search" }, "Search"), search),
      h("div", { class: "field" }, h("label", { for: "history-said" }, "Show"), said),
    ),
    total,
    near,
    list,
    more,
  );
  search.addEventListener(
    "input",
    settled(() => load()),
  );
  said.addEventListener("change", () => load());

  async function load(offset = 0) {
    const asked = { offset, limit: PAGE, search: search.value.trim(), said: said.value };
    try {
      const page = await api.history(asked);
      const items = page.items.map((item) => entry(item, showNear));
      if (offset) list.append(...items);
      else list.replaceChildren(...items);
      more.hidden = page.next === null;
      total.textContent = page.total ? count(page.total, "question") : empty(asked);
    } catch (error) {
      list.replaceChildren(
        h(
          "li",
          {},
          problemCard(error, () => load()),
        ),
      );
    }
  }

  async function showNear(item) {
    near.hidden = false;
    const close = h("button", { type: "button", class: "link", onclick: () => (near.hidden = true) }, "Close");
    const head = h(
      "div",
      { class: "live-head" },
      h("h2", { tabindex: "-1" }, "Touches that feel like this one to the model"),
      close,
    );
    try {
      const found = await api.nearestTouches(item.id);
      const items = found.items.map((each) => entry(each, showNear));
      near.replaceChildren(
        head,
        thumbs(item),
        items.length
          ? h("ul", { class: "queries" }, items)
          : h("p", { class: "faint" }, "There is no other touch yet."),
      );
    } catch (error) {
      near.replaceChildren(head, problemCard(error));
    }
    near.scrollIntoView({ block: "nearest" });
    head.firstChild.focus();
    announce("Touches that feel alike are shown.");
  }

  return {
    element,
    show: () => {
      near.hidden = true;
      load();
    },
  };
}

function empty({ search, said }) {
  return search || said ? "Nothing was found." : "Nothing was asked yet. What is asked on the first page is kept here.";
}

function entry(item, showNear) {
  const named = item.verdict === "match" || item.verdict === "uncalibrated";
  const claim = named ? item.best : item.verdict[0].toUpperCase() + item.verdict.slice(1);
  return h(
    "li",
    { class: "query" },
    h(
      "a",
      { href: `#//${item.id}`, class: "open" },
      thumbs(item),
      h("span", { class: "what" }, h("strong", {}, claim), h("span", { class: "faint" }, facts(item, named))),
    ),
    h(
      "span",
      { class: `said-mark${item.said ? "" : " faint"}` },
      item.said ? saidWords(item.said, item.object_id) : "",
    ),
    h(
      "button",
      { type: "button", class: "link", onclick: () => showNear(item) },
      "Alike",
      h("span", { class: "unseen" }, ` touches to that of ${moment(item.time)}`),
    ),
  );
}

/** The gel images of the first grasp. */
function thumbs(item) {
  return h(
    "span",
    { class: "thumbs" },
    item.touches[0].map((path) => picture(path, "", { loading: "lazy" })),
  );
}

function facts(item, named) {
  const parts = [moment(item.time), count(item.touches.length, "grasp")];
  if (named && item.probability !== null) parts.splice(0, 0, percent(item.probability));
  return parts.join(" · ");
}
