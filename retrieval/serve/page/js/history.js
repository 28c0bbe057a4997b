// The history view: queries, answers and feedback.

import * as api from "./api.js";
import { h, picture, problemCard, debounce } from "./dom.js";
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
  const element = h(
    "div",
    { class: "history" },
    h("div", { class: "view-head" }, h("h1", { tabindex: "-1" }, "History")),
    h(
      "div",
      { class: "filters" },
      h("div", { class: "field" }, h("label", { for: "history-search" }, "Search"), search),
      h("div", { class: "field" }, h("label", { for: "history-feedback" }, "Feedback"), feedbackSelect),
    ),
    total,
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
      const items = page.items.map(entry);
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

  return { element, show: () => load() };
}

function empty({ search, feedback }) {
  return search || feedback ? "No matching queries." : "No queries yet. Queries of the view Ask appear here.";
}

function entry(item) {
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
