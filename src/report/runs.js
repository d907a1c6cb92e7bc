"use strict";
// Rows in the order of a column: numbers by size, the rest by letters, what is not known last.
const body = document.querySelector("tbody");
const value = (row, k) => {
  const cell = row.children[k], text = cell.dataset.value ?? cell.textContent.trim();
  return text === "–" || text === "" ? null : Number.isNaN(Number(text)) ? text : Number(text);
};
document.querySelectorAll("thead th").forEach((heading, k, all) => heading.querySelector("button")?.addEventListener("click", () => {
  const rows = [...body.children].map((row) => [value(row, k), row]);
  // the largest number first, but names from A
  const before = heading.getAttribute("aria-sort"), numbers = rows.some(([v]) => typeof v === "number");
  const sign = before ? (before === "descending" ? 1 : -1) : numbers ? -1 : 1;
  all.forEach((other) => other.removeAttribute("aria-sort"));
  heading.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
  const order = (a, b) => typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b));
  rows.sort(([a], [b]) => a === null || b === null ? (a === null) - (b === null) : sign * order(a, b));
  body.append(...rows.map(([, row]) => row));
}));
