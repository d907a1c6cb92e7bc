"use strict";
// What is compared with the photographs, and where each picture is divided.
for (const form of document.querySelectorAll(".compare")) {
  const views = document.querySelectorAll(".view");
  const choose = () => {
    const { method, what } = Object.fromEntries(new FormData(form));
    for (const view of views) {
      for (const item of view.querySelectorAll("[data-method]")) {
        item.hidden = item.dataset.method !== method || (item.dataset.what ?? what) !== what;
      }
    }
    document.querySelector(".scale").hidden = what !== "error";
  };
  form.addEventListener("change", choose);
  choose();
  for (const pair of document.querySelectorAll(".pair")) {
    const divide = (e) => pair.style.setProperty("--at", `${e.target.value}%`);
    pair.querySelector("input").addEventListener("input", divide);
  }
}
