// The history view: queries, answers and feedback.

import * as api from "./api.js";
import { announce, h, picture, problemCard, debounce } from "./dom.js";
import { count, moment, percent, feedbackText } from "./wording.js";

const PAGE = 30;
const FEEDBACK_FILTERS = [
  ["", "All"],
  ["missing", "Without feedback"],
  ["right", "Right"],
  ["object", "Another object"],
  ["none", "Not in the catalogue"],
];

export function historyView() {
  const search = h("input", { type: "search", id: "history-search", autocomplete: "off" });
  const feedbackSelect = h(
    "select",
    { id: "history-feedback" },
    FEEDBACK_FILTERS.map(([value, text]) => h("option", { value }, text)),
  );
  const total = h("p", { class: "muted", role: "status" });
  const list = h("ul", { class: "queries" });
  const more = h(
    "button",
    { type: "button", class: "quiet more", hidden: true, onclick: () => load(list.children.length) },
    "Older",
  );
  const similar = h("section", { class: "similar-touches", hidden: true, "aria-label": "Similar touches" });
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
      h("div", { class: "field" }, h("label", { for: "history-feedback" }, "Feedback"), feedbackSelect),
    ),
    total,
    similar,
    list,
    more,
  );
  search.addEventListener(
    "input",
    debounce(() => load()),
  );
  feedbackSelect.addEventListener("change", () => load());

  async function load(offset = 0) {
    const filters = { offset, limit: PAGE, search: search.value.trim(), feedback: feedbackSelect.value };
    try {
      const page = await api.history(filters);
      const items = page.items.map((item) => entry(item, showSimilarTouches));
      if (offset) list.append(...items);
      else list.replaceChildren(...items);
      more.hidden = page.next === null;
      total.textContent = page.total ? count(page.total, "query") : empty(filters);
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

  async function showSimilarTouches(item) {
    similar.hidden = false;
    const close = h("button", { type: "button", class: "link", onclick: () => (similar.hidden = true) }, "Close");
    const head = h(
      "div",
      { class: "live-head" },
      h("h2", { tabindex: "-1" }, "Similar touches"),
      close,
    );
    try {
      const found = await api.nearestTouches(item.id);
      const items = found.items.map((each) => entry(each, showSimilarTouches));
      similar.replaceChildren(
        head,
        thumbs(item),
        items.length
          ? h("ul", { class: "queries" }, items)
          : h("p", { class: "muted" }, "There are no other touches yet."),
      );
    } catch (error) {
      similar.replaceChildren(head, problemCard(error));
    }
    similar.scrollIntoView({ block: "nearest" });
    head.firstChild.focus();
    announce("Similar touches are shown.");
  }

  return {
    element,
    show: () => {
      similar.hidden = true;
      load();
    },
  };
}

function empty({ search, feedback }) {
  return search || feedback ? "No matching queries." : "No queries yet. Queries of the view Ask appear here.";
}

function entry(item, showSimilarTouches) {
  const named = item.verdict === "match" || item.verdict === "uncalibrated";
  const claim = named ? item.best : item.verdict[0].toUpperCase() + item.verdict.slice(1);
  return h(
    "li",
    { class: "query" },
    h(
      "a",
      { href: `#//${item.id}`, class: "open" },
      thumbs(item),
      h("span", { class: "what" }, h("strong", {}, claim), h("span", { class: "muted" }, facts(item, named))),
    ),
    h(
      "span",
      { class: `feedback-mark${item.feedback ? "" : " muted"}` },
      item.feedback ? feedbackText(item.feedback, item.object_id) : "",
    ),
    h(
      "button",
      { type: "button", class: "link", onclick: () => showSimilarTouches(item) },
      "Similar",
      h("span", { class: "visually-hidden" }, ` touches to that of ${moment(item.time)}`),
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
