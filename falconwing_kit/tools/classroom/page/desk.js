// The class's messages -> the teacher's desk; its buttons -> messages that only the desk's key allows.

import { Channel } from "./channel.js";
import { Theme } from "./theme.js";
import { Replay } from "./replay.js";
import { HallView, Pictures } from "./view.js";
import { WhoLine, asWords, byId, cameraButtons, newElement } from "./parts.js";
import { showBoard, showConnection, showEffects, showLink, showQr, showVerdict, simulationWords, timeSentence } from "./parts.js";

const DESK_CAMERAS = { chase: "Chase", nose: "Nose", tower: "Tower" };
const DESK_SPEEDS = [0.25, 0.5, 1];
const DESK_EVENTS = 60;
const DESK_ROWS = 10;
const TROUBLE_MS = 12000;
const END_MS = 10000; // an unanswered question to end the class is taken back
const END_QUESTIONS = ["", "End the class for everybody?", "All flights stop and every screen goes quiet. Really end it?"];
const END_WORDS = ["End the class", "Yes, end the class", "End it now"];
// For a server that does not say which tasks it flies.
const DESK_TASKS = {
  landing: [],
  follow: ["left_turn_s_descent", "right_turn_s_ascent", "right_turn_sharp_climb", "figure_eight", "random_waypoints"],
};

/** The teacher's page. */
class Desk {
  constructor() {
    this.channel = new Channel("desk");
    this.hello = null;
    this.state = null;
    this.who = { queue: [], owner_may: 0 };
    this.active = new Set();
    this.recording = false;
    this.asked = 0;
    this.theme = new Theme([byId("theme")]);
    showConnection(byId("connection"), this.channel);
    showQr(byId("qr"));
    showBoard(byId("board"), [], DESK_ROWS);
    this.whoLine = new WhoLine(byId("who"), byId("reason"), this.channel);
    this.pictures = new Pictures(this.channel);
    this.cameras = cameraButtons(byId("cameras"), DESK_CAMERAS, (name) => this.view.setCamera(name));
    this.view = new HallView(byId("hall"), this.channel, this.pictures, {
      onchange: (camera) => this.cameras.show(camera),
    });
    this.replay = new Replay(byId("replay"), this.channel, this.view, { modal: false });
    this.showQueue();
    this.tasks = DESK_TASKS;
    this.showTasks("landing", "");
    this.listen();
    this.buttons();
  }

  listen() {
    const { channel } = this;
    channel.on("hello", (hello) => {
      const isFirst = this.hello === null;
      this.hello = hello;
      if ("recording" in hello) this.recording = Boolean(hello.recording);
      showLink(byId("link"), hello);
      if (isFirst) {
        this.tasks = hello.tasks || DESK_TASKS;
        this.showTasks(hello.task, hello.manoeuvre || "");
      }
      this.makeSwitches(hello.effects || []);
      this.showRecording();
    });
    channel.on("who", (who) => {
      this.who = who;
      this.showQueue();
    });
    channel.on("clients", (count) => {
      byId("clients").textContent = `${count.seats} seats, ${count.wall} wall, ${count.desks} desk`;
    });
    channel.on("flight", (flight) => {
      this.flight = flight;
      this.setEffects(flight.effects || []);
    });
    channel.on("effects", (message) => this.setEffects(message.active || []));
    channel.on("state", (state) => this.showState(state));
    channel.on("event", (event) => this.showEvent(event));
    channel.on("verdict", (verdict) => {
      showVerdict(byId("verdict"), verdict);
      byId("after").hidden = false;
      byId("keep").href = `/flights/${Number(verdict.flight)}.html`;
      this.verdict = verdict;
    });
    channel.on("board", (message) => showBoard(byId("board"), message.rows, DESK_ROWS));
    channel.on("gap", (message) => this.showEvent({ text: message.sentence, flight: message.flight }));
    channel.on("error", (message) => this.trouble(message.text));
  }

  /** Send, or say that nothing was sent: a teacher's press must never get lost in silence. */
  order(message) {
    if (!this.channel.send(message)) this.trouble("Nothing was sent: there is no connection to the class.");
  }

  buttons() {
    byId("take").addEventListener("click", () => this.order({ type: "take" }));
    addEventListener("keydown", (event) => {
      if (event.key !== "Escape" || event.repeat) return;
      this.order({ type: "take" });
    });
    byId("pause").addEventListener("click", () => this.order({ type: "pause", on: !(this.state && this.state.paused) }));
    byId("restart").addEventListener("click", () => this.order({ type: "restart" }));
    byId("record").addEventListener("click", () => {
      this.recording = !this.recording;
      this.order({ type: "record", on: this.recording });
      this.showRecording();
    });
    this.speeds = DESK_SPEEDS.map((value) => {
      const button = newElement("button", "fill", value === 1 ? "Real time" : `Slow ${value}\u00d7`);
      button.type = "button";
      button.addEventListener("click", () => this.order({ type: "speed", value }));
      byId("speeds").append(button);
      return { value, button };
    });
    byId("watch").addEventListener("click", () => this.replay.open(this.verdict.flight));
    byId("task").addEventListener("change", () => this.showManoeuvres(""));
    byId("pick").addEventListener("submit", (event) => {
      event.preventDefault();
      this.order({ type: "task", task: byId("task").value, manoeuvre: byId("manoeuvre").value });
    });
    byId("end").addEventListener("click", () => this.end());
    byId("end-not").addEventListener("click", () => this.askEnd(0));
  }

  /** The class ends after two questions. */
  end() {
    if (this.asked + 1 < END_QUESTIONS.length) return this.askEnd(this.asked + 1);
    this.order({ type: "end" });
    return this.askEnd(0);
  }

  askEnd(asked) {
    this.asked = asked;
    byId("end").textContent = END_WORDS[asked];
    byId("end").classList.toggle("main", asked > 0);
    byId("end-question").textContent = END_QUESTIONS[asked];
    byId("end-question").hidden = asked === 0;
    byId("end-not").hidden = asked === 0;
    clearTimeout(this.forget);
    if (asked) this.forget = setTimeout(() => this.askEnd(0), END_MS);
  }

  showQueue() {
    const rows = (this.who.queue || []).map((entry, place) => {
      const row = newElement("li");
      const give = newElement("button", place === 0 ? "main" : "", "Give");
      give.type = "button";
      give.setAttribute("aria-label", `Give the sticks to ${entry.name || `seat ${entry.client}`}`);
      give.addEventListener("click", () => this.order({ type: "give", client: entry.client }));
      row.append(newElement("span", "quiet", `${place + 1}.`), newElement("span", "name", entry.name || `Seat ${entry.client}`));
      const has = entry.client === this.who.owner_may;
      row.append(has ? newElement("span", "has", "has the sticks") : give);
      return row;
    });
    const owner = this.who.owner_may;
    if (owner && !(this.who.queue || []).some((entry) => entry.client === owner)) {
      const name = this.who.client === owner && this.who.name ? this.who.name : `Seat ${owner}`;
      const row = newElement("li");
      row.append(newElement("span", "name", name), newElement("span", "has", "has the sticks"));
      rows.unshift(row);
    }
    byId("queue").replaceChildren(...(rows.length ? rows : [newElement("li", "quiet", "Nobody has asked yet.")]));
  }

  showTasks(task, manoeuvre) {
    byId("task").replaceChildren(...Object.keys(this.tasks).map((name) => deskOption(name)));
    if (Object.hasOwn(this.tasks, task)) byId("task").value = task;
    this.showManoeuvres(manoeuvre);
  }

  showManoeuvres(manoeuvre) {
    const names = this.tasks[byId("task").value] || [];
    byId("manoeuvre").replaceChildren(...(names.length ? names.map((name) => deskOption(name)) : [deskOption("", "none")]));
    if (names.includes(manoeuvre)) byId("manoeuvre").value = manoeuvre;
    byId("manoeuvre").disabled = names.length === 0;
  }

  makeSwitches(effects) {
    this.switches = new Map();
    const rows = effects.map(({ name, physics }) => {
      const button = newElement("button", "switch");
      button.type = "button";
      button.setAttribute("role", "switch");
      button.append(newElement("span", "track"), newElement("span", "name", asWords(name)), newElement("span", "physics", physics));
      button.addEventListener("click", () => this.order({ type: "effect", name, on: !this.active.has(name) }));
      this.switches.set(name, button);
      const row = newElement("li");
      row.append(button);
      return row;
    });
    byId("effects").replaceChildren(...rows);
    this.setEffects([...this.active]);
  }

  setEffects(names) {
    this.active = new Set(names);
    for (const [name, button] of this.switches || []) button.setAttribute("aria-checked", String(this.active.has(name)));
    byId("effects-count").textContent = names.length ? `${names.length} on` : "all off";
    showEffects(byId("effects-now"), names);
  }

  showState(state) {
    this.state = state;
    const phases = (this.flight && this.flight.phases) || (this.hello && this.hello.phases) || [];
    const phase = state.over ? "flight over" : asWords(phases[state.phase]);
    const task = (this.flight && this.flight.task) || (this.hello && this.hello.task) || "";
    const clock = `${asWords(task)}, ${state.t.toFixed(1)} s${phase ? `, ${phase}` : ""}`;
    byId("clock").textContent = clock[0].toUpperCase() + clock.slice(1);
    byId("flight-text").textContent = `number ${state.flight}, ${state.rate.toFixed(1)} steps a second`;
    byId("simulation").textContent = simulationWords(this.hello, state);
    const sentence = timeSentence(state);
    if (byId("time").textContent !== sentence) byId("time").textContent = sentence;
    byId("time").hidden = sentence === "";
    byId("pause").setAttribute("aria-pressed", String(state.paused));
    byId("pause").textContent = state.paused ? "Go on" : "Pause";
    if (state.stretched) return; // the speed is then the computer's, not the chosen one
    for (const { value, button } of this.speeds) button.setAttribute("aria-pressed", String(Math.abs(state.speed - value) < 0.02));
  }

  showRecording() {
    byId("record").setAttribute("aria-pressed", String(this.recording));
    byId("record").textContent = this.recording ? "Recording: stop" : "Record";
  }

  showEvent(event) {
    const row = newElement("li");
    const at = Number.isFinite(event.t) ? `${event.t.toFixed(1)} s` : "";
    row.append(newElement("span", "at", at), newElement("span", "", event.text));
    byId("events").prepend(row);
    while (byId("events").children.length > DESK_EVENTS) byId("events").lastElementChild.remove();
  }

  trouble(text) {
    byId("trouble").textContent = text;
    byId("trouble").hidden = false;
    clearTimeout(this.quieting);
    this.quieting = setTimeout(() => {
      byId("trouble").hidden = true;
    }, TROUBLE_MS);
  }
}

/** One choice of a list. */
function deskOption(value, text = asWords(value)) {
  const made = newElement("option", "", text);
  made.value = value;
  return made;
}

globalThis.classroomPage = new Desk();
