"use strict";
// A reload keeps the place on the page. What was written long ago says that the command was killed.
setInterval(() => { if (!document.hidden) location.reload(); }, 2000);
const state = document.querySelector("#state");
if (Date.now() - Number(state.dataset.written) > 20000) {
  state.textContent = "The command that renews this page has ended.";
}
