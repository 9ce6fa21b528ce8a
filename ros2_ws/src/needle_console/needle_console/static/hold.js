// Hold to run over a WebSocket of its own: the server's count is echoed with the state of the
// button, 50 times a second; a release is said at once. The server alone decides what counts
// (docs/safety.md).
//
// Elements with data-hold="insert" or data-hold="retract" are the buttons; they may come and go.

const RETRY = 1000; // [ms]
const SILENCE = 500; // Without a word for so long the link is not called open [ms].
const UNCONNECTED = "no hold: not connected";
const HIDDEN = "the page is hidden";
const UNFOCUSED = "the window lost the focus";
const OTHER_POINTER = "a second finger or mouse button";
const STYLE =
  "[data-hold] { touch-action: none; user-select: none; -webkit-user-select: none;" +
  " -webkit-touch-callout: none; }";

class Hold {
  #address;
  #speed = 0;
  #socket = null;
  // The server's newest count, which each message echoes; 0: none on this connection.
  #count = 0;
  // The press under way: { mode, button, pointer (null: the space bar), after (the newest count when
  // it began: an echo above it has told of it), counted (whether it was a hold) }.
  #press = null;
  // Why the last press ended by itself, until a new one begins; empty: it did not.
  #ended = "";
  #told = { held: false, bar: "", why: "" };
  #heardAt = 0;
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

  // `why` is given where the hand did not let go itself.
  release(why = "") {
    if (!this.#press) return;
    this.#drop(why);
    this.#send();
    this.#show();
  }

  get status() {
    const open = this.#count > 0 && performance.now() - this.#heardAt < SILENCE;
    return {
      // Why this page may only watch, and stop; empty: it may hold.
      bar: open ? this.#told.bar : UNCONNECTED,
      held: open && this.#told.held && this.#press !== null,
      mode: this.#press ? this.#press.mode : "insert",
      why: open ? this.#ended : "",
    };
  }

  // ---- the socket ------------------------------------------------------------------------------

  #connect() {
    const socket = new WebSocket(this.#address);
    this.#socket = socket;
    socket.onmessage = (event) => this.#hear(JSON.parse(event.data));
    socket.onclose = () => {
      this.#drop("connection to the console lost");
      this.#count = 0;
      this.#show();
      setTimeout(() => this.#connect(), RETRY);
    };
  }

  #hear(told) {
    this.#count = told.count;
    this.#told = told;
    this.#heardAt = performance.now();
    if (this.#press && told.heard > this.#press.after) {
      // Once lost, a press is over, whatever the finger does.
      if (told.held) this.#press.counted = true;
      else this.#drop(told.why || "press again");
    }
    const gone = this.#press && this.#whyGone();
    if (gone) this.#drop(gone);
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

  // What should have come as an event, and may not have: a button that is taken away says nothing.
  #whyGone() {
    const { button } = this.#press;
    if (!button.isConnected || buttonOf(button) !== button) return "its button was switched off";
    if (document.visibilityState !== "visible") return HIDDEN;
    return document.hasFocus() ? "" : UNFOCUSED;
  }

  #begin(button, pointer) {
    this.#ended = "";
    // The next count is answered with it: an echo must be above the last one to count.
    const after = this.#count;
    this.#press = { mode: button.dataset.hold, button, pointer, after, counted: false };
    this.#show();
  }

  // End the press; `why` is empty where the hand let go.
  #drop(why) {
    if (!this.#press) return;
    this.#ended = why && `${this.#press.counted ? "hold ended" : "no hold"}: ${why}`;
    this.#press = null;
  }

  // ---- the hand --------------------------------------------------------------------------------

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
    // A long touch is a hold, no request for a menu. And Chromium keeps messages of sockets back for
    // 100 ms after a touch that it may still have to scroll by: the hold would be lost each time.
    for (const type of ["touchstart", "contextmenu", "dragstart"]) {
      const mine = (event) => {
        if (buttonOf(event.target)) event.preventDefault();
      };
      window.addEventListener(type, mine, { capture: true, passive: false });
    }
  }

  #pointerDown(event) {
    // A second finger, wherever it is, ends the hold.
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
    // A second button of a mouse comes as a movement.
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

  // ---- what is shown ---------------------------------------------------------------------------

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

// Return the button that an element belongs to; null: none, or one that is switched off.
function buttonOf(element) {
  const button = element instanceof Element ? element.closest("[data-hold]") : null;
  return button && !button.matches(":disabled, [aria-disabled=true], .disabled") ? button : null;
}

// Return the button that the space bar holds: the focused one, or without any focus `insert`.
function focused() {
  const element = document.activeElement;
  if (!element || element === document.body || element === document.documentElement) {
    return buttonOf(document.querySelector('[data-hold="insert"]'));
  }
  return buttonOf(element);
}

// Connect to the hold's server, and make the page's hold buttons work.
export function startHold({ port, speed }) {
  return new Hold(port, speed);
}
