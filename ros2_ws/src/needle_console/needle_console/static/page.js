// Browser part of the page: status of the hold, camera views, Escape for Stop.
import { startHold } from "./hold.js";

const VIEW_PERIOD = 100; // ms between two images of a view
const RETRY_PERIOD = 1000;

export function startPage(options) {
  window.needleHold = startHold(options);
  window.addEventListener("hold:status", (event) => showHold(event.detail));
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape") document.getElementById("stop")?.click();
  });
  loop();
}

let sentBar = null;

function showHold(status) {
  const words = document.getElementById("hold-words");
  if (words) words.textContent = holdText(status);
  // NiceGUI handles events only after it has drawn the page, when its elements exist.
  if (words && status.bar !== sentBar) {
    sentBar = status.bar;
    window.emitEvent("hold_bar", status.bar);
  }
}

function holdText(status) {
  if (status.why) return status.why;
  if (status.bar) return status.bar;
  if (status.held) return "held: release to stop";
  return "pointer, touch or space bar";
}

// A view requests its next image after the last one has arrived, so a slow link gets fewer.
function loop() {
  for (const view of document.querySelectorAll("img[data-view]")) {
    if (view.dataset.started) continue;
    view.dataset.started = "true";
    let number = 0;
    const request = () => {
      if (document.visibilityState !== "visible") return setTimeout(request, RETRY_PERIOD);
      view.src = `/view/${view.dataset.view}.jpg?n=${number++}`;
    };
    view.addEventListener("load", () => {
      view.parentElement.dataset.image = "there";
      setTimeout(request, VIEW_PERIOD);
    });
    view.addEventListener("error", () => {
      view.parentElement.dataset.image = "missing";
      setTimeout(request, RETRY_PERIOD);
    });
    request();
  }
  // NiceGUI draws the page after the start of this script, and again after a reconnection.
  showHold(window.needleHold.status);
  setTimeout(loop, RETRY_PERIOD);
}
