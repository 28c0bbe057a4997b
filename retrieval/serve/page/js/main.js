// The views that this service offers, and the routing between them.

import * as api from "./api.js";
import { h, problemCard } from "./dom.js";
import { count } from "./wording.js";
import { askView } from "./ask.js";
import { catalogueView } from "./catalogue.js";
import { historyView } from "./history.js";

const main = document.getElementById("main");
const nav = document.getElementById("nav");
const views = new Map();
let shown = null;

function addView(name, title, view) {
  const link = h("a", { href: `#/${name}` }, title);
  nav.append(link);
  main.append(view.element);
  view.element.hidden = true;
  views.set(name, { ...view, title, link });
}

/** Show the view of the address: "#/", the view's name, then its item. */
function route() {
  if (!location.hash.startsWith("#/") && location.hash) return; // the skip link
  const [name, ...rest] = location.hash.slice(2).split("/").map(decodeURIComponent);
  const view = views.get(name) ?? views.get("");
  if (shown && shown !== view) {
    shown.hide?.();
    shown.element.hidden = true;
  }
  views.forEach((each) => each.link.toggleAttribute("aria-current", false));
  view.link.setAttribute("aria-current", "page");
  view.element.hidden = false;
  document.title = name ? `${view.title} - Touch retrieval` : "Which object is in the hand?";
  const moved = shown && shown !== view;
  shown = view;
  view.show?.(rest.join("/"));
  if (moved) {
    scrollTo(0, 0);
    view.element.querySelector("h1")?.focus({ preventScroll: true });
  }
}

/** Request the token from the user, once for all waiting requests. */
function tokenDialog() {
  let waiting = null;
  return () => {
    waiting ??= new Promise((done) => {
      const field = h("input", { type: "password", id: "token", autocomplete: "current-password", required: true });
      const wrong = h("p", { class: "wrong", role: "alert" });
      const form = h(
        "form",
        { method: "dialog", class: "token" },
        h("h2", {}, "This service requires a token"),
        h("p", {}, "The operator of the service sets it. The browser stores it until you close the browser."),
        h("label", { for: "token" }, "Token"),
        field,
        wrong,
        h("button", { class: "primary" }, "Continue"),
      );
      const dialog = h("dialog", { class: "small-dialog", "aria-label": "Token" }, form);
      dialog.addEventListener("cancel", (event) => event.preventDefault());
      form.addEventListener("submit", async (event) => {
        event.preventDefault();
        try {
          await api.session(field.value);
          dialog.close();
          dialog.remove();
          waiting = null;
          done();
        } catch (error) {
          wrong.textContent = error.detail;
          field.select();
        }
      });
      document.body.append(dialog);
      dialog.showModal();
    });
    return waiting;
  };
}

function foot(index) {
  document
    .getElementById("foot")
    .replaceChildren(
      h("span", {}, `${count(index.photos, "photo")} of ${count(index.objects, "object")}, ${index.generation}`),
      h("span", {}, `${index.model}, trained on: ${index.trained_on}`),
      h("span", {}, `touch-retrieval ${index.version} `, h("a", { href: "openapi.json" }, "API")),
    );
}

async function start() {
  api.onTokenRequired(tokenDialog());
  let index;
  try {
    index = await api.index();
  } catch (error) {
    main.replaceChildren(problemCard(error, () => location.reload()));
    return;
  }
  main.replaceChildren();
  addView("", "Ask", askView(index));
  addView("catalogue", "Catalogue", catalogueView(index));
  if (index.stores_history) addView("history", "History", historyView());
  nav.hidden = views.size < 2;
  foot(index);
  addEventListener("hashchange", route);
  route();
}

start();
