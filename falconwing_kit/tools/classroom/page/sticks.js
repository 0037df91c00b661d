// Keys, a gamepad or two touch pads -> throttle 0..1 and aileron, elevator, rudder -1..1, and whether they are held.
//
// Positive is right wing down, nose up, nose right, as everywhere in the kit.
//
//   keyboard   arrows: aileron and elevator (up is the stick forward: nose down), A D: rudder,
//              W S or page up, page down: throttle, which stays; hold: space
//   gamepad    both sticks in mode 1 to 4; hold: any shoulder button
//   touch      two pads; a thumb takes the stick where it touches; hold: a thumb on a pad

export const STICK_DEFAULTS = {
  mode: 2, // 1: elevator left, throttle right; 2: throttle left, elevator right; 3 and 4: the same with aileron left
  deadBand: 0.05, // of the travel, around the centre
  expo: 0.3, // 0 straight, 1 cubic
  reversed: { throttle: false, aileron: false, elevator: false, rudder: false },
  assist: true, // the beginner's assist is asked for
  axes: [0, 1, 2, 3], // of the gamepad: left x, left y, right x, right y
  holdButtons: [4, 5, 6, 7], // of the gamepad: the shoulder buttons
  throttleHalf: 0.25, // throttle of a half-way stick that springs back, without the assist: about level flight
};
export const STICK_MODES = {
  // what [left x, left y, right x, right y] are
  1: ["rudder", "elevator", "aileron", "throttle"],
  2: ["rudder", "throttle", "aileron", "elevator"],
  3: ["aileron", "elevator", "rudder", "throttle"],
  4: ["aileron", "throttle", "rudder", "elevator"],
};
const STICK_KEYS = {
  ArrowLeft: ["aileron", -1],
  ArrowRight: ["aileron", 1],
  ArrowUp: ["elevator", -1],
  ArrowDown: ["elevator", 1],
  KeyA: ["rudder", -1],
  KeyD: ["rudder", 1],
  KeyW: ["throttle", 1],
  KeyS: ["throttle", -1],
  PageUp: ["throttle", 1],
  PageDown: ["throttle", -1],
};
const STICK_HOLD_KEY = "Space";
const STICK_SURFACES = ["aileron", "elevator", "rudder"];
const STICK_KEY_RATE = 2.0; // travel a second while a key is down: full stick after half a second
const STICK_SPRING_RATE = 4.0; // back to the centre
const STICK_THROTTLE_RATE = 0.5; // [1/s]
const STICK_LONGEST_STEP_S = 0.1; // a page that slept does not jump
const STICK_STORE = "falconwing.sticks";
const STICK_TAKES = 0.3; // travel with which an untouched gamepad becomes the source

/** A number within low..high; 0 where it is not finite. */
export function stickLimit(value, low, high) {
  return Number.isFinite(value) ? Math.min(Math.max(value, low), high) : 0;
}

/** Travel -1..1 of a stick -> its output -1..1: dead band d, then (1 - e) x + e x^3, then the sign. */
export function shape(value, { deadBand = 0, expo = 0, reversed = false } = {}) {
  const travel = stickLimit(value, -1, 1);
  const beyond = Math.max((Math.abs(travel) - deadBand) / (1 - deadBand), 0);
  const size = (1 - expo) * beyond + expo * beyond ** 3;
  const output = Math.sign(travel) * size * (reversed ? -1 : 1);
  return output === 0 ? 0 : output; // never -0
}

/**
 * Sticks after dt [s] with these keys, -1, 0 or 1 for each stick.
 *
 * A key moves its stick at a steady rate, so a short tap is a small movement; let go, or with the
 * key of the other side, it springs back to the centre twice as fast. The throttle stays.
 */
export function keyStep(sticks, keys, dt) {
  const step = stickLimit(dt, 0, STICK_LONGEST_STEP_S);
  const next = {
    throttle: stickLimit(sticks.throttle + (keys.throttle || 0) * STICK_THROTTLE_RATE * step, 0, 1),
  };
  for (const name of STICK_SURFACES) {
    const value = sticks[name];
    const key = keys[name] || 0;
    if (key === 0 || key * value < 0) {
      next[name] = Math.sign(value) * Math.max(Math.abs(value) - STICK_SPRING_RATE * step, 0) + 0;
    } else {
      next[name] = stickLimit(value + key * STICK_KEY_RATE * step, -1, 1);
    }
  }
  return next;
}

/** Throttle 0..1 of a stick -1..1 that springs back to its middle; its half-way throttle is given. */
export function springThrottle(travel, half) {
  const x = stickLimit(travel, -1, 1);
  return x < 0 ? half * (1 + x) : half + (1 - half) * x;
}

/** Axes and buttons of a gamepad -> sticks and hold, by settings as of STICK_DEFAULTS. */
export function gamepadSticks(axes, buttons, settings) {
  const set = { ...STICK_DEFAULTS, ...settings };
  const sticks = {};
  STICK_MODES[set.mode].forEach((name, place) => {
    const travel = stickLimit(axes[set.axes[place]], -1, 1); // right and down are positive
    const reversed = Boolean(set.reversed[name]);
    if (name === "throttle") {
      const up = shape(-travel, { deadBand: set.deadBand, reversed });
      sticks.throttle = springThrottle(up, set.assist ? 0.5 : set.throttleHalf);
    } else {
      // Down is the stick pulled back, nose up, so elevator has the sign of its axis.
      sticks[name] = shape(travel, { deadBand: set.deadBand, expo: set.expo, reversed });
    }
  });
  const pressed = (button) => (typeof button === "object" && button ? button.pressed || button.value > 0.5 : button > 0.5);
  sticks.hold = set.holdButtons.some((index) => Boolean(pressed(buttons[index])));
  return sticks;
}

/** The axis that moved most from one reading to another, {index, sign}; null below half of its travel. */
export function movedAxis(before, after) {
  let found = null;
  let most = 0.5;
  after.forEach((value, index) => {
    const moved = stickLimit(value - (before[index] || 0), -2, 2);
    if (Math.abs(moved) >= most) {
      most = Math.abs(moved);
      found = { index, sign: Math.sign(moved) };
    }
  });
  return found;
}

/** Settings with what is valid in a change; the rest stays. */
export function stickSettings(settings, change) {
  const next = { ...settings, reversed: { ...settings.reversed } };
  if (!change || typeof change !== "object") return next;
  const within = (name, low, high) => {
    if (Number.isFinite(change[name])) next[name] = stickLimit(change[name], low, high);
  };
  if (Object.hasOwn(STICK_MODES, change.mode)) next.mode = Number(change.mode);
  within("deadBand", 0, 0.5);
  within("expo", 0, 1);
  within("throttleHalf", 0.05, 0.95);
  if (typeof change.assist === "boolean") next.assist = change.assist;
  for (const name of Object.keys(next.reversed)) {
    if (typeof change.reversed?.[name] === "boolean") next.reversed[name] = change.reversed[name];
  }
  const indices = (list) => Array.isArray(list) && list.every((index) => Number.isInteger(index) && index >= 0 && index < 64);
  if (indices(change.axes) && change.axes.length === 4) next.axes = [...change.axes];
  if (indices(change.holdButtons)) next.holdButtons = [...change.holdButtons];
  return next;
}

/** Reads whatever a person flies with; the source that moved last counts. */
export class Sticks {
  /** element: where drawTouch() builds its pads; storage: null keeps nothing. */
  constructor(element, { mode, storage } = {}) {
    this.element = element;
    this.onchange = null; // called with the settings after each change
    this._storage = storage === undefined ? ownStickStorage() : storage;
    this._settings = stickSettings(stickSettings(STICK_DEFAULTS, { mode }), this._stored());
    this._source = "none";
    this._keys = new Set();
    this._sticks = { throttle: 0.5, aileron: 0, elevator: 0, rudder: 0 };
    this._time = performance.now();
    this._axes = null; // of the gamepad when it was last read
    this._pads = [];
    this._box = null;
    this._listeners = [];
    this._listen(window, "keydown", (event) => this._key(event, true));
    this._listen(window, "keyup", (event) => this._key(event, false));
    // A page that no longer gets key-ups lets go of everything.
    this._listen(window, "blur", () => this._letGo());
    this._listen(document, "visibilitychange", () => document.hidden && this._letGo());
  }

  /** {throttle, aileron, elevator, rudder, hold, source} now; source is keyboard, gamepad, touch or none. */
  read() {
    const now = performance.now();
    const dt = (now - this._time) / 1000;
    this._time = now;
    const gamepad = this._gamepad();
    if (this._source === "gamepad") {
      if (gamepad === null) return { ...this._sticks, aileron: 0, elevator: 0, rudder: 0, hold: false, source: "none" };
      this._sticks.throttle = gamepad.throttle; // stays when another source takes over
      return { ...gamepad, source: "gamepad" };
    }
    if (this._source === "touch") return this._touch();
    this._sticks = keyStep(this._sticks, this._directions(), dt);
    return { ...this._sticks, hold: this._keys.has(STICK_HOLD_KEY), source: this._source };
  }

  /** Set the throttle that stays, such as to the autopilot's when the sticks are handed over. */
  match(throttle) {
    this._sticks.throttle = stickLimit(throttle, 0, 1);
    this._drawKnobs();
  }

  get settings() {
    return structuredClone(this._settings);
  }

  /** Takes what is valid, keeps it in the browser and draws the pads anew. */
  set settings(change) {
    this._settings = stickSettings(this._settings, change);
    try {
      this._storage?.setItem(STICK_STORE, JSON.stringify(this._settings));
    } catch {
      // A browser that keeps nothing flies as well.
    }
    if (this._box) this.drawTouch();
    if (this.onchange) this.onchange(this.settings);
  }

  /** Build two touch pads inside the element. */
  drawTouch() {
    this._box?.remove();
    const box = document.createElement("div");
    box.className = "stick-pads";
    box.style.cssText = "display:flex;justify-content:space-between;gap:4vw;touch-action:none;user-select:none;-webkit-user-select:none";
    const names = STICK_MODES[this._settings.mode];
    this._pads = ["left", "right"].map((side, place) => {
      const [x, y] = names.slice(2 * place, 2 * place + 2);
      return this._pad(box, side, x, y);
    });
    this.element.append(box);
    this._box = box;
    this._drawKnobs();
  }

  /** Let go of everything and remove pads and listeners. */
  dispose() {
    this._letGo();
    for (const [target, type, listener] of this._listeners) target.removeEventListener(type, listener);
    this._listeners = [];
    this._box?.remove();
    this._box = null;
    this._pads = [];
  }

  _listen(target, type, listener) {
    target.addEventListener(type, listener);
    this._listeners.push([target, type, listener]);
  }

  _stored() {
    try {
      return JSON.parse(this._storage?.getItem(STICK_STORE) ?? "null");
    } catch {
      return null; // damaged, or not allowed
    }
  }

  _letGo() {
    this._keys.clear();
    for (const pad of this._pads) this._release(pad);
    this._drawKnobs();
  }

  _key(event, down) {
    if (!down) {
      this._keys.delete(event.code);
      return;
    }
    const typing = event.target instanceof Element && event.target.closest("input, textarea, select, [contenteditable]");
    const known = event.code in STICK_KEYS || event.code === STICK_HOLD_KEY;
    if (typing || !known || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault(); // the page does not scroll, a focused button is not pressed
    if (this._source !== "keyboard") {
      const { throttle } = this._sticks;
      this._sticks = { throttle, aileron: 0, elevator: 0, rudder: 0 };
      this._source = "keyboard";
    }
    this._keys.add(event.code);
  }

  _directions() {
    const directions = {};
    for (const code of this._keys) {
      if (!(code in STICK_KEYS)) continue;
      const [name, sign] = STICK_KEYS[code];
      const side = this._settings.reversed[name] ? -sign : sign;
      directions[name] = stickLimit((directions[name] || 0) + side, -1, 1);
    }
    return directions;
  }

  /** Sticks of the first gamepad, or null; it becomes the source when it moves or is held. */
  _gamepad() {
    const all = navigator.getGamepads ? Array.from(navigator.getGamepads()) : [];
    const pad = all.find((one) => one && one.connected !== false && one.axes.length >= 2);
    if (!pad) {
      this._axes = null;
      return null;
    }
    const sticks = gamepadSticks(pad.axes, pad.buttons, this._settings);
    const before = this._axes ?? pad.axes;
    const moved = this._settings.axes.some((index) => Math.abs((pad.axes[index] ?? 0) - (before[index] ?? 0)) > STICK_TAKES);
    if (sticks.hold || moved) this._source = "gamepad";
    if (moved || this._axes === null) this._axes = [...pad.axes];
    return sticks;
  }

  _touch() {
    const { deadBand, expo, reversed } = this._settings;
    const result = { throttle: this._sticks.throttle, aileron: 0, elevator: 0, rudder: 0 };
    for (const pad of this._pads) {
      for (const [name, travel] of [[pad.x, pad.right], [pad.y, -pad.up]]) {
        // Down is the stick pulled back, nose up.
        if (name !== "throttle") result[name] = shape(travel, { deadBand, expo, reversed: reversed[name] });
      }
    }
    return { ...result, hold: this._pads.some((pad) => pad.pointer !== null), source: "touch" };
  }

  _pad(box, side, x, y) {
    const field = document.createElement("div");
    const knob = document.createElement("div");
    const label = document.createElement("div");
    field.className = "stick-pad";
    field.dataset.side = side;
    field.setAttribute("role", "group");
    field.setAttribute("aria-label", `${side} stick: ${x} and ${y}`);
    field.style.cssText =
      "position:relative;flex:1 1 0;max-width:220px;aspect-ratio:1;touch-action:none;border:2px solid currentColor;border-radius:16px;opacity:0.85";
    knob.className = "stick-knob";
    knob.style.cssText =
      "position:absolute;width:28%;height:28%;margin:-14%;left:50%;top:50%;border-radius:50%;background:currentColor;pointer-events:none";
    label.textContent = `\u2195 ${y}  \u2194 ${x}`; // up and down, left and right
    label.style.cssText = "position:absolute;left:0;right:0;bottom:4px;text-align:center;font-size:13px;pointer-events:none";
    field.append(knob, label);
    box.append(field);
    const pad = { field, knob, x, y, pointer: null, right: 0, up: 0, from: null };
    field.addEventListener("pointerdown", (event) => this._down(pad, event));
    field.addEventListener("pointermove", (event) => this._move(pad, event));
    for (const type of ["pointerup", "pointercancel", "lostpointercapture"]) {
      field.addEventListener(type, (event) => {
        if (event.pointerId !== pad.pointer) return;
        this._release(pad);
        this._drawKnobs();
      });
    }
    return pad;
  }

  _down(pad, event) {
    if (pad.pointer !== null) return;
    event.preventDefault();
    try {
      pad.field.setPointerCapture(event.pointerId); // a thumb that slides off the pad still flies
    } catch {
      // a pointer that is gone already
    }
    pad.pointer = event.pointerId;
    pad.from = { x: event.clientX, y: event.clientY, throttle: this._sticks.throttle };
    this._source = "touch";
  }

  _move(pad, event) {
    if (event.pointerId !== pad.pointer) return;
    const radius = Math.max(pad.field.getBoundingClientRect().width / 2, 1);
    pad.right = stickLimit((event.clientX - pad.from.x) / radius, -1, 1);
    pad.up = stickLimit((pad.from.y - event.clientY) / radius, -1, 1);
    if (pad.y === "throttle") {
      const sign = this._settings.reversed.throttle ? -1 : 1;
      // The whole pad is the throttle's travel, and it moves on from where it stands.
      this._sticks.throttle = stickLimit(pad.from.throttle + (sign * (pad.from.y - event.clientY)) / (2 * radius), 0, 1);
    }
    this._drawKnobs();
  }

  _release(pad) {
    pad.pointer = null;
    pad.right = pad.up = 0;
  }

  _drawKnobs() {
    for (const pad of this._pads) {
      const up = pad.y === "throttle" ? (2 * this._sticks.throttle - 1) * (this._settings.reversed.throttle ? -1 : 1) : pad.up;
      pad.knob.style.left = `${50 + 36 * pad.right}%`;
      pad.knob.style.top = `${50 - 36 * up}%`;
    }
  }
}

/** The browser's own store; null where it is not allowed. */
export function ownStickStorage() {
  try {
    return window.localStorage;
  } catch {
    return null;
  }
}
