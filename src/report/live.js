"use strict";
// What changes is asked for again and again, as long as somebody looks.
const main = document.querySelector("main"), state = document.querySelector("#state");
let shown = "";
setInterval(async () => {
  if (document.hidden) return;
  try {
    const answer = await fetch("live");
    const part = await answer.text();
    if (!answer.ok) throw new Error(part);
    if (part !== shown) main.innerHTML = shown = part;
    state.textContent = "Renewed every two seconds.";
  } catch {
    state.textContent = "The command that serves this page has ended.";
  }
}, 2000);
