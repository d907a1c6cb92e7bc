"use strict";
// Some rows at a time, of those that match; in the order of a column: numbers by size, the rest by
// letters, what is not known last.
const PAGE = 25;
const body = document.querySelector("tbody"), search = document.querySelector("[name=search]"), state = document.querySelector("[name=state]");
const [previous, next] = ["previous", "next"].map((name) => document.querySelector(`.${name}`));
let first = 0;

function show() {
  const words = search.value.toLowerCase().split(/\s+/);
  const found = [...body.children].filter((row) => {
    row.hidden = true;
    const text = row.textContent.toLowerCase();
    return (!state.value || row.dataset.state === state.value) && words.every((word) => text.includes(word));
  });
  first = Math.max(0, Math.min(first, Math.floor((found.length - 1) / PAGE) * PAGE));
  const shown = found.slice(first, first + PAGE);
  shown.forEach((row) => { row.hidden = false; });
  // a button that is switched off would lose the focus
  const ends = [first === 0, first + PAGE >= found.length];
  [previous, next].forEach((button, k) => button.setAttribute("aria-disabled", String(ends[k])));
  document.querySelector(".shown").textContent = found.length ? `${first + 1}–${first + shown.length} of ${found.length}` : "no run";
}
const turn = (to) => { first = to; show(); document.querySelector(".scroll").scrollTo(0, 0); };
[previous, next].forEach((button, k) => button.addEventListener("click", () => {
  if (button.getAttribute("aria-disabled") !== "true") turn(first + (k ? PAGE : -PAGE));
}));
search.addEventListener("input", () => turn(0));
state.addEventListener("input", () => turn(0));

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
  turn(0);
}));
show();
