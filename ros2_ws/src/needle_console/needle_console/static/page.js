// The page's own part: the hold's words, the camera views, Escape for Stop.
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

let toldBar = null;

function showHold(status) {
  const words = document.getElementById("hold-words");
  if (words) words.textContent = holdWords(status);
  // NiceGUI takes no event before it has drawn the page: its elements are there then.
  if (words && status.bar !== toldBar) {
    toldBar = status.bar;
    window.emitEvent("hold_bar", status.bar);
  }
}

function holdWords(status) {
  if (status.why) return status.why;
  if (status.bar) return status.bar;
  if (status.held) return "held: let go to stop";
  return "pointer, touch or space bar";
}

// A view asks for its next image when the last has come: a slow link gets fewer of them.
function loop() {
  for (const view of document.querySelectorAll("img[data-view]")) {
    if (view.dataset.started) continue;
    view.dataset.started = "true";
    let number = 0;
    const ask = () => {
      if (document.visibilityState !== "visible") return setTimeout(ask, RETRY_PERIOD);
      view.src = `/view/${view.dataset.view}.jpg?n=${number++}`;
    };
    view.addEventListener("load", () => {
      view.parentElement.dataset.image = "there";
      setTimeout(ask, VIEW_PERIOD);
    });
    view.addEventListener("error", () => {
      view.parentElement.dataset.image = "missing";
      setTimeout(ask, RETRY_PERIOD);
    });
    ask();
  }
  // NiceGUI draws the page after this script has begun, and once more after a reconnection.
  showHold(window.needleHold.status);
  setTimeout(loop, RETRY_PERIOD);
}
