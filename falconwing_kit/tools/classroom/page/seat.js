// The class's messages and a student's sticks -> the seat: own view, a place in the queue, the hold button, 50 Hz of sticks.

import { Channel, packSticks } from "./channel.js";
import { Theme, keepValue, keptValue } from "./theme.js";
import { HallView, Pictures } from "./view.js";
import { assignGamepad } from "./assign.js";
import { Replay } from "./replay.js";
import { Sticks } from "./sticks.js";
import { WhoLine, byId, drawSticks, newElement, ordinal } from "./parts.js";
import { cameraButtons, showBoard, showConnection, showEffects, showVerdict } from "./parts.js";
import { simulationWords, timeSentence } from "./parts.js";

const LEVEL_THROTTLE = 0.21; // of straight and level flight at 7 m/s, without the assist
const STICKS_MS = 20;
const HOLD_ANSWER_MS = 400;
const NAME_KEY = "falconwing-name";
const SEAT_CAMERAS = { chase: "Chase", nose: "Nose", tower: "Tower", picture: "Picture" };
const SEAT_ROWS = 8;
const MODE_WORDS = { 1: "1: elevator left, throttle right", 2: "2: throttle left, elevator right" };

/** The page of one student. */
class Seat {
  constructor() {
    this.channel = new Channel("seat");
    this.hello = null;
    this.who = null;
    this.mayFly = false;
    this.holding = false;
    this.pressed = false; // the hold button; keys, pads and gamepads are read by sticks.js
    this.sticks = null; // only while this seat may fly: else the keys are the page's own
    this.sequence = 0;
    this.theme = new Theme([byId("theme")]);
    showConnection(byId("connection"), this.channel);
    this.whoLine = new WhoLine(byId("who"), null, this.channel);
    this.pictures = new Pictures(this.channel);
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.cameras = cameraButtons(byId("cameras"), SEAT_CAMERAS, (name) => this.view.setCamera(name));
    this.view = new HallView(byId("hall"), this.channel, this.pictures, {
      camera: still ? "tower" : "chase", // a moving camera makes some people sick
      onchange: (camera) => this.cameras.show(camera),
    });
    this.replay = new Replay(byId("replay"), this.channel, this.view);
    this.settings = this.withSticks((sticks) => sticks.settings);
    this.listen();
    this.form();
    this.makeSettings();
    this.holdButton();
    this.showLine();
    showBoard(byId("board"), [], SEAT_ROWS);
  }

  listen() {
    const { channel } = this;
    channel.on("hello", (hello) => {
      this.hello = hello;
      byId("simulation").textContent = simulationWords(hello, null);
      const kept = keptValue(NAME_KEY);
      if (kept && kept !== hello.name) channel.send({ type: "name", name: kept });
      channel.send({ type: "assist", on: this.settings.assist });
      this.showLine();
    });
    channel.on("status", (status) => {
      if (!status.connected) this.who = null;
      if (!status.connected) this.grant(false);
      this.showLine();
    });
    channel.on("who", (who) => {
      this.who = who;
      this.grant(channel.client > 0 && who.owner_may === channel.client);
      this.showLine();
    });
    channel.on("state", (state) => {
      const sentence = timeSentence(state);
      if (byId("time").textContent !== sentence) byId("time").textContent = sentence;
      byId("time").hidden = sentence === "";
      byId("simulation").textContent = simulationWords(this.hello, state);
      // The throttle begins where the autopilot has it; with the assist its middle is level flight.
      if (this.sticks && !this.holding && !this.settings.assist) this.sticks.match(state.command[0]);
    });
    channel.on("flight", (flight) => {
      showEffects(byId("effects"), flight.effects);
      // A hand that holds since the last landing has its throttle at idle; the new flight is level.
      if (this.sticks) this.sticks.match(this.settings.assist ? 0.5 : LEVEL_THROTTLE);
    });
    channel.on("effects", (message) => showEffects(byId("effects"), message.active));
    channel.on("board", (message) => showBoard(byId("board"), message.rows, SEAT_ROWS));
    channel.on("error", (message) => this.showLine(message.text));
    channel.on("verdict", (verdict) => this.showAfter(verdict));
    channel.on("pong", () => {
      byId("answer").textContent = `Answer from the class after ${Math.round(channel.roundTripMs)} ms. ${this.view.describe()}`;
    });
  }

  form() {
    byId("name").value = keptValue(NAME_KEY) || "";
    byId("name").addEventListener("change", () => this.sendName());
    byId("ask-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.sendName();
      const waits = this.mayFly || this.place() > 0;
      this.channel.send({ type: waits ? "leave" : "ask" });
    });
    byId("give-back").addEventListener("click", () => {
      this.letGo();
      this.channel.send({ type: "leave" });
    });
    byId("watch").addEventListener("click", () => {
      this.letGo();
      this.replay.open(this.verdict.flight);
    });
  }

  /** Mode, dead band, expo, reversed sticks and the beginner's assist; sticks.js keeps them. */
  makeSettings() {
    const { settings } = this;
    const form = byId("settings");
    const field = (name, label, control) => {
      const box = newElement("label", control.type === "checkbox" ? "tick" : "");
      control.id = `set-${name}`;
      box.htmlFor = control.id;
      const text = newElement("span", "", label);
      box.append(...(control.type === "checkbox" ? [control, text] : [text, control]));
      return box;
    };
    const tick = (on) => Object.assign(newElement("input"), { type: "checkbox", checked: on });
    const range = (value, max) => {
      return Object.assign(newElement("input"), { type: "range", min: 0, max, step: 0.01, value });
    };
    const mode = newElement("select");
    for (const [value, text] of Object.entries(MODE_WORDS)) {
      mode.append(Object.assign(newElement("option", "", text), { value }));
    }
    mode.value = settings.mode;
    const deadBand = range(settings.deadBand, 0.3);
    const expo = range(settings.expo, 1);
    const assist = tick(settings.assist);
    const reversed = Object.keys(settings.reversed).map((name) => [name, tick(settings.reversed[name])]);
    const fieldset = newElement("fieldset");
    fieldset.append(newElement("legend", "", "Reversed"), ...reversed.map(([name, box]) => field(name, name, box)));
    form.append(
      field("assist", "Beginner's assist: the kit keeps the wings level and the height", assist),
      field("mode", "Stick mode", mode),
      field("dead-band", "Dead band", deadBand),
      field("expo", "Expo: softer around the centre", expo),
      fieldset,
    );
    const assign = Object.assign(newElement("button", "", "Assign the gamepad's sticks"), { type: "button" });
    const prompt = newElement("p", "assign");
    prompt.setAttribute("role", "status");
    assign.addEventListener("click", async () => {
      const change = await assignGamepad(this.settings.mode, (text) => {
        prompt.textContent = text;
      });
      prompt.textContent = change ? "Done: these sticks are kept." : "No gamepad moves: press one of its buttons first.";
      if (!change) return;
      for (const [name, box] of reversed) box.checked = Boolean({ ...this.settings.reversed, ...change.reversed }[name]);
      this.changeSettings(change);
    });
    form.append(assign, prompt);
    form.addEventListener("submit", (event) => event.preventDefault());
    form.addEventListener("input", () => {
      const change = {
        mode: Number(mode.value),
        deadBand: Number(deadBand.value),
        expo: Number(expo.value),
        assist: assist.checked,
        reversed: Object.fromEntries(reversed.map(([name, box]) => [name, box.checked])),
      };
      if (change.assist !== this.settings.assist) this.channel.send({ type: "assist", on: change.assist });
      this.changeSettings(change);
    });
    addEventListener("gamepadconnected", (event) => {
      byId("gamepad").textContent = `Connected: ${event.gamepad.id}.`;
    });
    addEventListener("gamepaddisconnected", () => {
      byId("gamepad").textContent = "The gamepad is gone.";
    });
  }

  changeSettings(change) {
    this.settings = this.withSticks((sticks) => {
      sticks.settings = change;
      return sticks.settings;
    });
  }

  sendName() {
    const name = byId("name").value.trim();
    keepValue(NAME_KEY, name);
    if (name) this.channel.send({ type: "name", name });
  }

  /** Hold by the button, or as sticks.js says; every way out of the page lets go. */
  holdButton() {
    const button = byId("hold");
    button.addEventListener("pointerdown", (event) => {
      event.preventDefault();
      button.setPointerCapture(event.pointerId);
      this.press(true);
    });
    for (const type of ["pointerup", "pointercancel", "lostpointercapture"]) {
      button.addEventListener(type, () => this.press(false));
    }
    button.addEventListener("contextmenu", (event) => event.preventDefault());
    const leave = () => this.letGo();
    addEventListener("blur", leave);
    addEventListener("pagehide", leave);
    document.addEventListener("visibilitychange", () => {
      if (document.visibilityState !== "visible") leave();
    });
    setInterval(() => this.sendSticks(), STICKS_MS);
  }

  press(on) {
    this.pressed = on;
    this.sendSticks();
  }

  letGo() {
    this.pressed = false;
    this.sendSticks(true);
  }

  /** What `use` answers for the sticks, or for sticks that are read only here. */
  withSticks(use) {
    const sticks = this.sticks || new Sticks(byId("pads"), {});
    const answer = use(sticks);
    if (!this.sticks) sticks.dispose();
    return answer;
  }

  /** One message while hold is pressed; one more, with hold = 0, as soon as it is not. */
  sendSticks(release = false) {
    if (!this.sticks) return;
    const sticks = this.sticks.read();
    const hold = !release && (this.pressed || sticks.hold);
    if (this.sequence % 2 === 0 || !hold) this.drawn(sticks, hold);
    if (hold || this.holding) {
      const bytes = packSticks(sticks, hold, this.settings.assist, this.sequence, performance.now());
      const sent = hold ? this.channel.sendFresh(bytes) : this.channel.pass(bytes);
      if (sent) this.sequence = (this.sequence + 1) % 65536;
    }
    if (hold === this.holding) return;
    this.holding = hold;
    byId("hold").setAttribute("aria-pressed", String(hold));
    // The class answers within some steps; only then it is said whether this seat flies.
    clearTimeout(this.answering);
    this.answering = setTimeout(() => this.showLine(), hold ? HOLD_ANSWER_MS : 0);
  }

  /** What the sticks do, for those who see no touch pads; drawn only when it changes. */
  drawn(sticks, hold) {
    const values = [sticks.throttle, sticks.aileron, sticks.elevator, sticks.rudder];
    const text = `${values} ${hold} ${this.theme.name} ${innerWidth}`;
    if (text === this.drawnText) return;
    this.drawnText = text;
    drawSticks(byId("stick-view"), values, hold ? "student" : "nobody");
  }

  grant(mayFly) {
    if (mayFly === this.mayFly) return;
    this.mayFly = mayFly;
    this.drawnText = "";
    byId("seat").classList.toggle("may-fly", mayFly);
    if (!mayFly) {
      this.letGo();
      this.sticks.dispose();
      this.sticks = null;
      return;
    }
    this.replay.close();
    this.sticks = new Sticks(byId("pads"), {});
    this.sticks.drawTouch();
    if (navigator.vibrate && navigator.userActivation && navigator.userActivation.hasBeenActive) navigator.vibrate(150);
    scrollTo(0, 0);
  }

  /** The place in the queue, from 1; 0 outside it. */
  place() {
    const queue = (this.who && this.who.queue) || [];
    return queue.findIndex((entry) => entry.client === this.channel.client) + 1;
  }

  /** Whether the class says that this seat flies now. */
  flies() {
    return this.who !== null && this.who.holder === "student" && this.who.client === this.channel.client;
  }

  showLine(text = "") {
    const place = this.place();
    const ask = byId("ask");
    ask.textContent = this.mayFly ? "Give the sticks back" : place ? "Leave the queue" : "Ask for the sticks";
    ask.classList.toggle("main", !this.mayFly && !place);
    ask.disabled = this.channel.client === 0;
    let line = "You watch. Ask for the sticks to fly.";
    if (place) line = place === 1 ? "You are next." : `You are ${ordinal(place)} in the queue.`;
    if (this.mayFly) line = "The sticks are yours: hold to fly.";
    if (this.mayFly && this.holding) {
      const reason = this.who.reason ? ` (${this.who.reason})` : "";
      line = this.flies() ? "You fly. Let go and the autopilot takes over." : `You do not fly now${reason}. Let go and hold again.`;
    }
    byId("hold").textContent = this.holding ? (this.flies() ? "YOU FLY" : "HOLD AGAIN") : "HOLD TO FLY";
    byId("hold").dataset.flies = String(this.holding && this.flies());
    if (this.channel.client === 0) line = "Not connected.";
    byId("line").textContent = text || line;
  }

  showAfter(verdict) {
    this.verdict = verdict;
    showVerdict(byId("verdict"), verdict);
    byId("keep").href = `/flights/${Number(verdict.flight)}.html`;
    byId("after").hidden = false;
  }
}

globalThis.classroomPage = new Seat();
