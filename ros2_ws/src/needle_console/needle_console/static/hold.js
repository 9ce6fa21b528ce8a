// Hold to run over a WebSocket: 50 times a second, the page echoes the server's count with the state
// of the button. It sends a release at once. The server alone decides what counts (docs/safety.md).
//
// The buttons are all elements with data-hold="insert" or data-hold="retract", even if added later.

const RETRY = 1000; // [ms]
const SILENCE = 500; // The connection counts as lost after this time without a message [ms].
const UNCONNECTED = "no hold: not connected";
const HIDDEN = "the page is hidden";
const UNFOCUSED = "the window lost focus";
const OTHER_POINTER = "a second finger or mouse button";
const STYLE =
  "[data-hold] { touch-action: none; user-select: none; -webkit-user-select: none;" +
  " -webkit-touch-callout: none; }";

class Hold {
  #address;
  #speed = 0;
  #socket = null;
  // The server's newest count, which each message echoes; 0 before the first on this connection.
  #count = 0;
  // The current press: { mode, button, pointer (null: the space bar), after (the newest count when
  // it began: a later echo includes it), counted (whether it was a hold) }.
  #press = null;
  // Reason why the last press ended without a release, until a new one begins; empty if it did not.
  #ended = "";
  #state = { held: false, bar: "", why: "" };
  #receivedAt = 0;
  #shown = "";

  constructor(port, speed) {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    this.#address = `${scheme}://${location.hostname}:${port}/hold`;
    this.setSpeed(speed);
    this.#listen();
    this.#connect();
    setInterval(() => this.#show(), SILENCE / 2);
    this.#show();
  }

  setSpeed(speed) {
    if (typeof speed === "number" && speed >= 0 && speed <= 1) this.#speed = speed;
  }

  // `why` is the reason if the person did not release the button.
  release(why = "") {
    if (!this.#press) return;
    this.#endPress(why);
    this.#send();
    this.#show();
  }

  get status() {
    const open = this.#count > 0 && performance.now() - this.#receivedAt < SILENCE;
    return {
      // Reason why this page may only watch and stop; empty if it may hold.
      bar: open ? this.#state.bar : UNCONNECTED,
      held: open && this.#state.held && this.#press !== null,
      mode: this.#press ? this.#press.mode : "insert",
      why: open ? this.#ended : "",
    };
  }

  // ---- the socket ------------------------------------------------------------------------------

  #connect() {
    const socket = new WebSocket(this.#address);
    this.#socket = socket;
    socket.onmessage = (event) => this.#receive(JSON.parse(event.data));
    socket.onclose = () => {
      this.#endPress("connection to the console lost");
      this.#count = 0;
      this.#show();
      setTimeout(() => this.#connect(), RETRY);
    };
  }

  #receive(state) {
    this.#count = state.count;
    this.#state = state;
    this.#receivedAt = performance.now();
    if (this.#press && state.heard > this.#press.after) {
      // A lost press is over, even if the button is still pressed.
      if (state.held) this.#press.counted = true;
      else this.#endPress(state.why || "press again");
    }
    const interruption = this.#press && this.#interruption();
    if (interruption) this.#endPress(interruption);
    this.#send();
    this.#show();
  }

  #send() {
    if (this.#count === 0 || this.#socket.readyState !== WebSocket.OPEN) return;
    this.#socket.send(
      JSON.stringify({
        count: this.#count,
        pressed: this.#press !== null,
        speed: this.#speed,
        mode: this.#press ? this.#press.mode : "insert",
      }),
    );
  }

  // Return the reason to end the press although no event reported it, as for a removed button.
  #interruption() {
    const { button } = this.#press;
    if (!button.isConnected || buttonOf(button) !== button) return "its button was switched off";
    if (document.visibilityState !== "visible") return HIDDEN;
    return document.hasFocus() ? "" : UNFOCUSED;
  }

  #begin(button, pointer) {
    this.#ended = "";
    // The echo of the next count reports the press.
    const after = this.#count;
    this.#press = { mode: button.dataset.hold, button, pointer, after, counted: false };
    this.#show();
  }

  // End the press; `why` is empty after a release.
  #endPress(why) {
    if (!this.#press) return;
    this.#ended = why && `${this.#press.counted ? "hold ended" : "no hold"}: ${why}`;
    this.#press = null;
  }

  // ---- input -----------------------------------------------------------------------------------

  #listen() {
    const style = document.createElement("style");
    style.textContent = STYLE;
    document.head.append(style);
    const on = (target, type, handler) => target.addEventListener(type, handler, true);
    const hide = () => this.release(HIDDEN);
    on(window, "pointerdown", (event) => this.#pointerDown(event));
    on(window, "pointermove", (event) => this.#pointerMoved(event));
    for (const type of ["pointerup", "pointercancel", "lostpointercapture"]) {
      on(window, type, (event) => {
        if (!this.#press || event.pointerId !== this.#press.pointer) return;
        this.release(type === "pointerup" ? "" : "the browser took the pointer away");
      });
    }
    on(window, "keydown", (event) => this.#keyDown(event));
    on(window, "keyup", (event) => this.#keyUp(event));
    on(window, "blur", (event) => {
      if (event.target === window) this.release(UNFOCUSED);
    });
    on(window, "pagehide", hide);
    on(document, "visibilitychange", hide);
    on(document, "freeze", hide);
    // A long touch must not open a menu. After a touch that may become a scroll, Chromium also delays
    // socket messages by 100 ms, which would end the hold.
    for (const type of ["touchstart", "contextmenu", "dragstart"]) {
      const prevent = (event) => {
        if (buttonOf(event.target)) event.preventDefault();
      };
      window.addEventListener(type, prevent, { capture: true, passive: false });
    }
  }

  #pointerDown(event) {
    // A second finger anywhere ends the hold.
    if (this.#press) {
      this.release(OTHER_POINTER);
      return;
    }
    const button = buttonOf(event.target);
    if (!button || !event.isPrimary || event.button !== 0) return;
    button.setPointerCapture(event.pointerId);
    this.#begin(button, event.pointerId);
  }

  #pointerMoved(event) {
    // A second mouse button is reported as a movement.
    if (this.#press && event.pointerId === this.#press.pointer && event.buttons !== 1) {
      this.release(event.buttons ? OTHER_POINTER : "");
    }
  }

  #keyDown(event) {
    const space = event.code === "Space";
    if (this.#press) {
      const same = space && this.#press.pointer === null;
      if (same) event.preventDefault();
      // Any other key ends the hold.
      if (!same || !event.repeat) this.release("another key was pressed");
      return;
    }
    const button = space && !event.ctrlKey && !event.altKey && !event.metaKey && focused();
    if (!button) return;
    event.preventDefault();
    if (!event.repeat) this.#begin(button, null);
  }

  #keyUp(event) {
    if (event.code !== "Space") return;
    if (buttonOf(document.activeElement)) event.preventDefault();
    if (this.#press && this.#press.pointer === null) this.release();
  }

  // ---- display ---------------------------------------------------------------------------------

  #show() {
    const status = this.status;
    const shown = JSON.stringify(status);
    if (shown === this.#shown) return;
    this.#shown = shown;
    let state = "ready";
    if (status.bar === UNCONNECTED) state = "offline";
    else if (status.bar) state = "other";
    else if (status.held) state = "held";
    else if (this.#ended) state = "again";
    document.documentElement.dataset.holdState = state;
    window.dispatchEvent(new CustomEvent("hold:status", { detail: status }));
  }
}

// Return the hold button that contains an element; null if there is none, or it is disabled.
function buttonOf(element) {
  const button = element instanceof Element ? element.closest("[data-hold]") : null;
  return button && !button.matches(":disabled, [aria-disabled=true], .disabled") ? button : null;
}

// Return the button for the space bar: the focused one, or `insert` without a focus.
function focused() {
  const element = document.activeElement;
  if (!element || element === document.body || element === document.documentElement) {
    return buttonOf(document.querySelector('[data-hold="insert"]'));
  }
  return buttonOf(element);
}

// Connect to the hold's server and activate the page's hold buttons.
export function startHold({ port, speed }) {
  return new Hold(port, speed);
}
