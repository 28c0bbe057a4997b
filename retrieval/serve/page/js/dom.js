// Elements from calls: no markup is ever made from text, so that no name of an object can become a script.

/** An element; `on...` are listeners, `style` an object, `null` and `false` leave an attribute out. */
export function h(tag, given = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(given)) {
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

const SVG = "http://www.w3.org/2000/svg";

/** An SVG element with attributes. */
export function svg(tag, given = {}, ...children) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(given)) element.setAttribute(name, value);
  element.append(...children.flat());
  return element;
}

/** Say something to screen readers. */
export function announce(text) {
  document.getElementById("status").textContent = text;
}

/** A problem as a card: its title, its sentence, and a button where trying again may help. */
export function problemCard(error, again = null) {
  return h(
    "div",
    { class: "notice problem", role: "alert" },
    h("strong", {}, error.title ?? "Something failed"),
    h("p", {}, error.detail ?? String(error)),
    again && h("button", { type: "button", class: "quiet", onclick: again }, "Try again"),
  );
}

/** A picture whose place stays where its file cannot be shown. */
export function picture(src, alt, given = {}) {
  const image = h("img", { src, alt, decoding: "async", ...given });
  image.addEventListener("error", () => {
    image.replaceWith(h("div", { class: "blank", role: alt ? "img" : null, "aria-label": alt || null }, "no preview"));
  });
  return image;
}

/** Call `act` once the calls have paused. */
export function settled(act, pause_ms = 200) {
  let timer;
  return (...given) => {
    clearTimeout(timer);
    timer = setTimeout(() => act(...given), pause_ms);
  };
}
