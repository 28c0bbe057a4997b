// Clickable places of a picture: a click shows the grasps of a place, another click hides them. Arrow keys move between
// the places, so that each picture is one tab stop.
const photographs = document.querySelector(".photographs")?.content;

for (const picture of document.querySelectorAll(".picture")) {
  const spots = [...picture.querySelectorAll(".spot")];
  const shown = picture.parentElement.querySelector(".shown");
  spots.forEach((spot, place) => {
    spot.tabIndex = place === 0 ? 0 : -1;
    spot.addEventListener("click", () => show(spot, spot.ariaExpanded !== "true"));
    spot.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
      if (event.key === "Escape") show(spot, false);
      if (!step) return;
      event.preventDefault();
      const next = spots[(place + step + spots.length) % spots.length];
      spots.forEach((each) => (each.tabIndex = each === next ? 0 : -1));
      next.focus();
    });
  });

  function show(spot, expanded) {
    spots.forEach((each) => (each.ariaExpanded = String(expanded && each === spot)));
    const cards = spot.nextElementSibling.content.cloneNode(true);
    for (const tile of cards.querySelectorAll("[data-picture]")) {
      const found = photographs?.querySelector(`[data-name="${tile.dataset.picture}"]`)?.cloneNode();
      if (!found) continue;
      found.alt = tile.nextElementSibling.textContent;
      tile.append(found);
    }
    shown.replaceChildren(...(expanded ? [cards] : []));
    shown.hidden = !expanded;
  }
}
