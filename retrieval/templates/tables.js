// Tables of a report: a click on a heading sorts.
const number = (text) => parseFloat(text.replace(/^< /, "").replace("−", "-").replace(/,(?=\d{3})/g, ""));

for (const table of document.querySelectorAll("table")) {
  const body = table.tBodies[0];
  const rows = [...body.rows];
  if (rows.length < 3) continue;
  const headings = [...table.tHead.rows[0].cells];
  headings.forEach((heading, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...heading.childNodes);
    button.addEventListener("click", () => sort(column));
    heading.append(button);
  });

  // The sort order cycles: descending, ascending, original.
  function sort(column) {
    const heading = headings[column];
    const next = { none: "descending", descending: "ascending", ascending: "none" }[heading.ariaSort ?? "none"];
    headings.forEach((other) => other.removeAttribute("aria-sort"));
    if (next !== "none") heading.ariaSort = next;
    const sign = next === "ascending" ? 1 : -1;
    const cell = (row) => row.cells[column];
    body.append(...(next === "none" ? rows : [...rows].sort((one, other) => order(cell(one), cell(other), sign))));
  }

  // Numbers by value, text alphabetically; cells without a number come last in both directions.
  function order(one, other, sign) {
    const [a, b] = [one, other].map((cell) => cell.textContent.trim());
    const [x, y] = [number(a), number(b)];
    if (one.className === "words" || (isNaN(x) && isNaN(y))) return sign * a.localeCompare(b, "en", { numeric: true });
    if (isNaN(x) || isNaN(y)) return isNaN(x) - isNaN(y);
    return sign * (x - y);
  }
}
