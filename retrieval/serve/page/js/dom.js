// Functions that create elements. Text never becomes markup, so an object's name cannot become a script.

/** Create an element; `on...` are listeners, `style` is an object, `null` and `false` omit an attribute. */
export function h(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "style") Object.entries(value).forEach(([key, each]) => element.style.setProperty(key, each));
    else if (name in element && typeof value !== "string") element[name] = value;
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(
    ...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false),
  );
  return element;
}

/** Announce a text to screen readers. */
export function announce(text) {
  document.getElementById("status").textContent = text;
}

/** A card with the title and detail of a problem, and a button to try again if `again` is given. */
export function problemCard(error, again = null) {
  return h(
    "div",
    { class: "notice problem", role: "alert" },
    h("strong", {}, error.title ?? "The action failed"),
    h("p", {}, error.detail ?? String(error)),
    again && h("button", { type: "button", class: "quiet", onclick: again }, "Try again"),
  );
}

/** A picture that is replaced by a blank if its file cannot be shown. */
export function picture(src, alt, attributes = {}) {
  const image = h("img", { src, alt, decoding: "async", ...attributes });
  image.addEventListener("error", () => {
    image.replaceWith(h("div", { class: "blank", role: alt ? "img" : null, "aria-label": alt || null }, "no preview"));
  });
  return image;
}

/** Call `act` after the calls pause. */
export function debounce(act, pause_ms = 200) {
  let timer;
  return (...values) => {
    clearTimeout(timer);
    timer = setTimeout(() => act(...values), pause_ms);
  };
}
