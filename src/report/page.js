"use strict";
// What is compared with what, and where each picture is divided.
for (const form of document.querySelectorAll(".compare")) {
  const views = document.querySelectorAll(".view");
  const choose = () => {
    const { method, left, what } = Object.fromEntries(new FormData(form));
    for (const view of views) {
      for (const item of view.querySelectorAll("[data-method]")) {
        item.hidden = item.dataset.method !== method || (item.dataset.what ?? what) !== what;
      }
    }
    for (const pair of document.querySelectorAll(".pair")) {
      const shown = left && pair.querySelector(`[data-method="${left}"][data-what=picture]`);
      const image = pair.querySelector(".left");
      image.hidden = !shown;
      if (shown) [image.src, image.alt] = [shown.src, shown.alt];
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
