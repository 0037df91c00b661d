// The class's messages -> the wall: the hall, the nose picture, sticks, charts, who flies, verdict and board.

import { Channel, sameParts } from "./channel.js";
import { Theme } from "./theme.js";
import { FlightCharts } from "./plots.js";
import { Replay } from "./replay.js";
import { HallView, Pictures } from "./view.js";
import { WhoLine, asWords, byId, drawSticks, newElement } from "./parts.js";
import { showBoard, showConnection, showEffects, showLink, showQr, showVerdict, simulationWords, timeSentence } from "./parts.js";

const WALL_CAMERAS = { 1: "chase", 2: "nose", 3: "tower" };
const WALL_CAMERA_WORDS = { chase: "Chase camera", nose: "Nose camera", tower: "Tower camera", picture: "Camera's pictures" };
const VERDICT_MS = 7000; // a verdict stays at least this long, also when the next flight has begun
const WALL_EVENTS = 3;
const WALL_ROWS = 4;

/** The page in front of the class. */
class Wall {
  constructor() {
    this.channel = new Channel("wall");
    this.hello = null;
    this.flight = null;
    this.state = null;
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.theme = new Theme([byId("theme")]);
    showConnection(byId("connection"), this.channel);
    showQr(byId("qr"));
    showBoard(byId("board"), [], WALL_ROWS);
    this.who = new WhoLine(byId("who"), byId("reason"), this.channel);
    this.pictures = new Pictures(this.channel);
    this.pictures.show(byId("nose"), true);
    this.charts = new FlightCharts(byId("charts"));
    this.view = new HallView(byId("hall"), this.channel, this.pictures, {
      camera: still ? "tower" : "chase", // a moving camera makes some people sick
      onchange: (camera) => this.showCamera(camera),
    });
    this.replay = new Replay(byId("replay"), this.channel, this.view);
    this.listen();
    this.keys();
    const redraw = () => this.draw();
    this.theme.onchange = redraw;
    addEventListener("resize", redraw);
  }

  listen() {
    const { channel } = this;
    channel.on("hello", (hello) => {
      this.hello = hello;
      document.documentElement.dataset.school = String(hello.school !== false);
      if (hello.has_poses === false) this.view.setCamera("picture");
      showLink(byId("link"), hello);
      byId("simulation").textContent = simulationWords(hello, this.state);
      this.showTask();
    });
    channel.on("flight", (flight) => {
      this.flight = flight;
      this.showTask();
      showEffects(byId("effects"), flight.effects);
      this.hideVerdict(flight.number);
    });
    channel.on("effects", (message) => showEffects(byId("effects"), message.active));
    channel.on("who", (who) => {
      if (who.holder === "student") this.replay.close(); // the class looks at who flies now
    });
    channel.on("event", (event) => this.showEvent(event));
    channel.on("board", (message) => showBoard(byId("board"), message.rows, WALL_ROWS));
    channel.on("verdict", (verdict) => this.showVerdict(verdict));
    channel.on("error", (message) => this.showEvent({ text: message.text }));
    channel.on("state", (state) => {
      const moved = !this.state || !sameParts(state, this.state, ["flight", "t", "holder", "command"]);
      this.state = state;
      if (state.pose.every(Number.isFinite)) this.charts.add(state);
      this.showTime(state);
      if (moved && !this.drawn) {
        this.drawn = true; // one drawing a frame, however many states arrive
        requestAnimationFrame(() => {
          this.drawn = false;
          this.draw();
        });
      }
    });
  }

  keys() {
    addEventListener("keydown", (event) => {
      if (byId("replay").open) return; // the player's keys
      if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
      const key = event.key.toLowerCase();
      if (WALL_CAMERAS[key]) this.view.setCamera(WALL_CAMERAS[key]);
      if (key === "r" && this.againFlight !== undefined) this.replay.open(this.againFlight);
      if (key === "t") this.theme.next();
      if (key !== "f") return;
      if (document.fullscreenElement) document.exitFullscreen();
      else document.documentElement.requestFullscreen().catch(() => {});
    });
  }

  draw() {
    this.charts.draw();
    if (this.state) drawSticks(byId("sticks"), this.state.command, this.state.holder);
  }

  showCamera(camera) {
    byId("camera").textContent = `${WALL_CAMERA_WORDS[camera]}  ·  keys 1 2 3, F full screen`;
  }

  showTask() {
    const task = (this.flight && this.flight.task) || (this.hello && this.hello.task);
    const manoeuvre = this.flight && this.flight.manoeuvre ? `: ${asWords(this.flight.manoeuvre)}` : "";
    const name = task ? asWords(task) : "";
    byId("task").textContent = name ? name[0].toUpperCase() + name.slice(1) + manoeuvre : "";
  }

  showTime(state) {
    const sentence = timeSentence(state);
    const notice = byId("time");
    if (notice.textContent !== sentence) notice.textContent = sentence;
    notice.hidden = sentence === "";
    const phases = (this.flight && this.flight.phases) || (this.hello && this.hello.phases) || [];
    const phase = state.over ? "flight over" : asWords(phases[state.phase]);
    byId("clock").textContent = `Flight ${state.flight}  ·  ${state.t.toFixed(1)} s${phase ? `  ·  ${phase}` : ""}`;
    const words = simulationWords(this.hello, state);
    if (byId("simulation").textContent !== words) byId("simulation").textContent = words;
  }

  showEvent(event) {
    const item = newElement("li", "", event.text);
    const list = byId("events");
    list.prepend(item);
    while (list.children.length > WALL_EVENTS) list.lastElementChild.remove();
  }

  showVerdict(verdict) {
    const box = byId("verdict");
    showVerdict(box, verdict);
    if (verdict.again !== false) {
      const again = newElement("button", "", "Watch it again (key R)");
      again.type = "button";
      again.addEventListener("click", () => this.replay.open(verdict.flight));
      box.append(again);
      this.againFlight = verdict.flight;
    }
    box.hidden = false;
    this.verdictAt = performance.now();
    this.verdictFlight = verdict.flight;
    clearTimeout(this.hiding);
    if (this.flight && this.flight.number !== verdict.flight) this.hideVerdict(this.flight.number);
  }

  hideVerdict(number) {
    if (this.verdictFlight === undefined || number === this.verdictFlight) return;
    const rest = Math.max(0, this.verdictAt + VERDICT_MS - performance.now());
    clearTimeout(this.hiding);
    this.hiding = setTimeout(() => {
      byId("verdict").hidden = true;
    }, rest);
  }
}

globalThis.classroomPage = new Wall();
