// A flight's data -> a player: the hall with aircraft and ghost, scrub bar, plots, verdict, numbers.

import { interpolatePoses, chaseCamera, noseCamera, towerCamera } from "./camera.js";

const PLAYER_RATES = [0.1, 0.25, 0.5, 1, 2, 4];
const GHOST_COLOUR = "#3d8bff";
const GHOST_OPACITY = 0.45;
const LEADER_COLOUR = "#d98f00";
const HOLDER_COLOURS = ["#7a8591", "#2f7fd6", "#d2691e", "#7a8591"]; // nobody, autopilot, student, safe
const HOLDER_WORDS = ["nobody flies yet", "autopilot", "student", "SAFE: sticks neutral"];
const PLAYER_VIEWS = ["chase", "nose", "tower", "map"];
const VIEW_FOV_DEG = { chase: 70, tower: 45 };
const MAP_FOOT = 44; // px below the map, for the line that says who flies
const SETTLE_MS = 900; // go on drawing so long after the last change: sorting ends later

/** Row before a time and the share of the way to the next one. */
export function rowAt(times, t) {
  let [low, high] = [0, times.length - 1];
  if (t <= times[0]) return { row: 0, next: 0, share: 0 };
  if (t >= times[high]) return { row: high, next: high, share: 0 };
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (times[middle] <= t) low = middle;
    else high = middle;
  }
  return { row: low, next: low + 1, share: (t - times[low]) / (times[low + 1] - times[low]) };
}

/** The pose (row-major 4 x 4) at a time; null where a row has none. */
export function poseAt(times, rows, t) {
  const { row, next, share } = rowAt(times, t);
  const [a, b] = [rows[row], rows[next]];
  if (!isPose(a)) return null;
  return interpolatePoses(a, isPose(b) ? b : a, isPose(b) ? share : 0);
}

/** Whether a row holds six numbers. */
export function isPose(row) {
  return Array.isArray(row) && row.length === 6 && row.every((value) => Number.isFinite(value));
}

/** A number as a person reads it, with its unit. */
export function numberText(value, unit) {
  if (typeof value !== "number" || !Number.isFinite(value)) return "\u2013";
  const size = Math.abs(value);
  const digits = size >= 100 ? 0 : size >= 10 ? 1 : 2;
  const text = value.toFixed(digits).replace("-", "\u2212");
  return unit === "%" ? `${text}\u00a0%` : `${text}\u00a0${unit || ""}`.trim();
}

/** A new element; text is never read as HTML. */
export function playerElement(tag, className, text) {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== undefined) made.textContent = text;
  return made;
}

/** The flight from above and from the side, on a 2D canvas: where there is no WebGL2, and as a map. */
export class FlatView {
  constructor(canvas) {
    this.canvas = canvas;
  }

  /** paths: [{rows, color, width, upTo}]; marks: [{T, color}], T row-major 4 x 4. */
  draw(data, paths, marks) {
    const pen = fitCanvas(this.canvas);
    if (!pen) return;
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight - MAP_FOOT];
    const ink = getComputedStyle(this.canvas).color;
    const { x: hx, y: hy, z: hz } = data.hall;
    const gap = 26;
    const [wide, deep, tall] = [hx[1] - hx[0], hy[1] - hy[0], hz[1] - hz[0]];
    const stretch = Math.min(3, Math.max(1, (0.3 * height) / ((tall * (width - 20)) / wide)));
    const scale = Math.min((width - 20) / wide, (height - 2 * gap - 8) / (deep + stretch * tall));
    const left = (width - scale * wide) / 2;
    const above = gap + scale * deep;
    const ground = above + gap + scale * stretch * tall;
    const fromTop = (x, y) => [left + scale * (x - hx[0]), gap + scale * (hy[1] - y)];
    const fromSide = (x, z) => [left + scale * (x - hx[0]), ground - scale * stretch * (z - hz[0])];
    pen.font = `${getComputedStyle(this.canvas).fontSize} system-ui, sans-serif`;
    pen.fillStyle = ink;
    pen.fillText("from above", left, gap - 8);
    pen.fillText(`from the side${stretch > 1.01 ? `, height ${stretch.toFixed(1)} times` : ""}`, left, above + gap - 8);
    pen.strokeStyle = ink;
    pen.lineWidth = 1;
    pen.globalAlpha = 0.5;
    pen.strokeRect(...fromTop(hx[0], hy[1]), scale * wide, scale * deep);
    pen.strokeRect(...fromSide(hx[0], hz[1]), scale * wide, scale * stretch * tall);
    const { x0, x1, y0, y1, z } = data.pad;
    if (x1 > x0) {
      pen.fillStyle = "#3a74c4";
      pen.fillRect(...fromTop(x0, y1), scale * (x1 - x0), scale * (y1 - y0));
      pen.fillRect(...fromSide(x0, z), scale * (x1 - x0), Math.max(2, scale * stretch * z));
    }
    pen.globalAlpha = 1;
    for (const { rows, color, width: line, upTo } of paths) {
      pen.strokeStyle = color;
      pen.lineWidth = line;
      for (const to of [([x, y]) => fromTop(x, y), ([x, , h]) => fromSide(x, h)]) {
        pen.beginPath();
        let pen_down = false;
        for (const row of rows.slice(0, upTo ?? rows.length)) {
          if (!isPose(row)) {
            pen_down = false;
            continue;
          }
          if (pen_down) pen.lineTo(...to(row));
          else pen.moveTo(...to(row));
          pen_down = true;
        }
        pen.stroke();
      }
    }
    for (const { T, color, opacity } of marks) {
      pen.globalAlpha = opacity ?? 1;
      pen.fillStyle = color;
      const [x, y] = fromTop(T[3], T[7]);
      const course = Math.atan2(-T[4], T[0]);
      pen.save();
      pen.translate(x, y);
      pen.rotate(course);
      pen.beginPath();
      for (const [a, b] of [[10, 0], [-7, 6], [-4, 0], [-7, -6]]) pen.lineTo(a, b);
      pen.fill();
      pen.restore();
      pen.beginPath();
      pen.arc(...fromSide(T[3], T[11]), 5, 0, 2 * Math.PI);
      pen.fill();
    }
    pen.globalAlpha = 1;
  }
}

/** A canvas as many pixels wide as it is shown, cleared; null while it is hidden. */
export function fitCanvas(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
  if (width < 20 || height < 20) return null;
  if (canvas.width !== width) canvas.width = width;
  if (canvas.height !== height) canvas.height = height;
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  return pen;
}

/** One value over the whole flight, with a cursor; a click or drag goes to that time. */
export class FlightChart {
  constructor(label, unit, times, seek, least = 1) {
    this.box = playerElement("figure", "fw-chart");
    this.head = playerElement("figcaption");
    this.value = playerElement("b", "", "\u2013");
    this.unit = unit;
    this.least = least; // what the axis reaches at least
    this.head.append(playerElement("span", "", `${label} [${unit}]`), this.value);
    this.canvas = playerElement("canvas");
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", `${label} over the flight`);
    this.box.append(this.head, this.canvas);
    this.times = times;
    this.lines = [];
    const go = (event) => {
      if (event.type === "pointermove" && !(event.buttons & 1)) return;
      const box = this.canvas.getBoundingClientRect();
      const share = (event.clientX - box.left - this.left) / Math.max(1, box.width - this.left - 4);
      seek(Math.min(1, Math.max(0, share)) * this.times[this.times.length - 1]);
    };
    this.left = 34; // px for the numbers of the axis, set by the size of their font
    this.canvas.addEventListener("pointerdown", go);
    this.canvas.addEventListener("pointermove", go);
  }

  /** lines: [{values, colorOf: row -> colour}]; the first one is read at the cursor. */
  set(lines) {
    this.lines = lines;
    const values = lines.flatMap((line) => line.values.filter((value) => Number.isFinite(value)));
    this.high = values.reduce((a, b) => Math.max(a, b), this.least);
    this.low = values.reduce((a, b) => Math.min(a, b), 0);
  }

  draw(t) {
    const first = this.lines[0];
    const size = parseFloat(getComputedStyle(this.canvas).fontSize);
    this.left = 2.8 * size;
    const { row, next, share } = rowAt(this.times, t);
    const [a, b] = first ? [first.values[row], first.values[next]] : [NaN, NaN];
    const between = Number.isFinite(a) && Number.isFinite(b) ? a + share * (b - a) : a;
    this.value.textContent = numberText(between, this.unit);
    const pen = fitCanvas(this.canvas);
    if (!pen) return;
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    const ink = getComputedStyle(this.canvas).color;
    const end = this.times[this.times.length - 1] || 1;
    const x = (time) => this.left + (time / end) * (width - this.left - 4);
    const span = this.high - this.low;
    const bottom = this.box.dataset.axis ? 1.7 * size : 0;
    const y = (value) => 6 + ((this.high - value) / span) * (height - 12 - bottom);
    const rough = span / 3;
    const power = 10 ** Math.floor(Math.log10(rough));
    const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough * 0.999);
    pen.font = `${size}px system-ui, sans-serif`;
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    for (let i = Math.ceil(this.low / step - 1e-9); i * step <= this.high + 1e-9; i += 1) {
      pen.globalAlpha = 0.18;
      pen.fillStyle = ink;
      pen.fillRect(this.left, Math.round(y(i * step)), width - this.left - 4, 1);
      pen.globalAlpha = 0.9;
      const text = (i * step).toFixed(step >= 1 ? 0 : step >= 0.1 ? 1 : 2).replace("-", "\u2212");
      pen.fillText(text, this.left - 5, y(i * step));
    }
    if (bottom) {
      pen.textAlign = "center";
      const marks = [0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500].find((s) => end / s <= (width / size) / 6) || end;
      for (let i = 0; x(i * marks) < width - 6 * size; i += 1) {
        pen.fillText(`${Number((i * marks).toFixed(1))}`, x(i * marks), height - 0.7 * size);
      }
      pen.textAlign = "right";
      pen.fillText("time [s]", width - 2, height - 0.7 * size);
    }
    pen.globalAlpha = 1;
    pen.lineWidth = 2;
    pen.lineJoin = "round";
    for (const { values, colorOf } of this.lines) {
      let color = null;
      for (let k = 1; k < values.length; k += 1) {
        if (!Number.isFinite(values[k - 1]) || !Number.isFinite(values[k])) {
          if (color) pen.stroke();
          color = null;
          continue;
        }
        if (colorOf(k) !== color) {
          if (color) pen.stroke();
          color = colorOf(k);
          pen.strokeStyle = color;
          pen.beginPath();
          pen.moveTo(x(this.times[k - 1]), y(values[k - 1]));
        }
        pen.lineTo(x(this.times[k]), y(values[k]));
      }
      if (color) pen.stroke();
    }
    pen.fillStyle = ink;
    pen.fillRect(x(t) - 1, 0, 2, height - bottom);
    if (Number.isFinite(between)) {
      pen.beginPath();
      pen.arc(x(t), y(between), 4, 0, 2 * Math.PI);
      pen.fill();
    }
  }
}

/**
 * Shows one flight inside an element: data as /flights/N.json holds them, and a SplatView or null.
 *
 * Space plays and pauses, arrows move by 0.05 s (with Shift 1 s), Home and End go to the ends, + and
 * - change the speed of time, G shows the ghost, 1 to 4 choose the camera.
 */
export class Player {
  constructor(element, data, view = null, canvas = null) {
    this.element = element;
    this.data = data;
    this.view = view;
    this.t = 0;
    this.speed = 1;
    this.playing = false;
    this.ghostShown = data.ghost !== null && data.ghost !== undefined;
    this.fromStart = false;
    this.end = data.t[data.t.length - 1] || 0;
    this.alive = true;
    this.settledAt = 0;
    this.build(canvas || (view && view.canvas) || null);
    this.chooseCamera(view ? "chase" : "map");
    this.frame = this.frame.bind(this);
    this.resized = new ResizeObserver(() => this.touch());
    this.resized.observe(this.stage);
    this.seek(0);
    requestAnimationFrame(this.frame);
  }

  get rate() {
    return this.speed;
  }

  /** The speed of time, 0.1 to 4. */
  set rate(value) {
    const wanted = Number(value);
    if (!Number.isFinite(wanted)) return;
    this.speed = Math.min(4, Math.max(0.1, wanted));
    const near = PLAYER_RATES.reduce((a, b) => (Math.abs(b - this.speed) < Math.abs(a - this.speed) ? b : a));
    this.rateChoice.value = String(near);
    this.element.dataset.rate = String(this.speed);
  }

  play() {
    if (this.t >= this.end - 1e-6) this.seek(0);
    this.playing = true;
    this.last = null;
    this.showButton();
  }

  pause() {
    this.playing = false;
    this.showButton();
  }

  /** Go to a time of the flight [s]; draws at once. */
  seek(t) {
    const wanted = Number(t);
    if (!Number.isFinite(wanted)) return;
    this.t = Math.min(this.end, Math.max(0, wanted));
    this.draw();
    this.touch();
  }

  /** Show or hide the ghost. */
  ghost(on) {
    this.ghostShown = Boolean(on) && Boolean(this.data.ghost);
    this.ghostButton.setAttribute("aria-pressed", String(this.ghostShown));
    this.setCharts();
    this.touch();
    this.draw();
  }

  dispose() {
    this.alive = false;
    this.playing = false;
    this.resized.disconnect();
    if (this.view) this.view.dispose();
    this.element.replaceChildren();
    this.element.classList.remove("fw-player");
  }

  // ---- what is built once

  build(canvas) {
    const { data, element } = this;
    element.classList.add("fw-player");
    element.replaceChildren();
    const head = playerElement("header", "fw-head");
    const words = playerElement("div");
    words.append(playerElement("h2", "", data.title), playerElement("p", "fw-sentence", data.sentence));
    head.append(words, playerElement("strong", "fw-simulation", data.simulated ? "SIMULATION" : "REAL FLIGHT"));
    head.dataset.success = String(data.success);

    this.stage = playerElement("div", "fw-stage");
    this.stage.tabIndex = 0;
    this.stage.setAttribute("role", "group");
    this.stage.setAttribute("aria-label", "The flight; space plays and pauses, arrows move in time");
    this.solid = canvas;
    if (canvas) {
      canvas.classList.add("fw-canvas");
      this.stage.append(canvas);
    }
    this.map = playerElement("canvas", "fw-canvas fw-map");
    this.flat = new FlatView(this.map);
    this.note = playerElement("p", "fw-note");
    this.note.setAttribute("role", "status");
    this.note.hidden = true;
    this.who = playerElement("p", "fw-who");
    this.stage.append(this.map, this.who, this.note, playerElement("span", "fw-stamp", data.simulated ? "SIMULATION" : ""));

    const left = playerElement("div", "fw-left");
    left.append(this.stage, this.buildBar(), this.buildButtons());
    if (data.ghost && data.ghost.note) {
      this.ghostNote = playerElement("p", "fw-ghost-note", `Ghost: ${data.ghost.note}.`);
      left.append(this.ghostNote);
    }
    const right = playerElement("div", "fw-right");
    right.append(this.buildNumbers(), ...this.buildCharts(), this.buildEvents());
    element.append(head, left, right);
    element.addEventListener("keydown", (event) => this.key(event));
  }

  buildBar() {
    const bar = playerElement("div", "fw-bar");
    this.range = playerElement("input");
    Object.assign(this.range, { type: "range", min: "0", max: String(this.end), step: "0.01", value: "0" });
    this.range.setAttribute("aria-label", "Time of the flight");
    this.range.addEventListener("input", () => this.seek(this.range.value));
    this.ticks = playerElement("div", "fw-ticks");
    for (const { t, text } of this.data.events) {
      const tick = playerElement("i");
      tick.title = `${t.toFixed(2)} s: ${text}`;
      tick.style.left = `${(100 * Math.min(t, this.end)) / (this.end || 1)}%`;
      this.ticks.append(tick);
    }
    this.clock = playerElement("output", "fw-clock");
    bar.append(this.range, this.ticks, this.clock);
    return bar;
  }

  buildButtons() {
    const row = playerElement("div", "fw-buttons");
    this.button = playerElement("button", "fw-play", "Play");
    this.button.type = "button";
    this.button.addEventListener("click", () => (this.playing ? this.pause() : this.play()));
    this.rateChoice = playerElement("select");
    this.rateChoice.setAttribute("aria-label", "Speed of time");
    for (const rate of PLAYER_RATES) {
      const option = playerElement("option", "", `${rate}\u00d7`);
      option.value = String(rate);
      this.rateChoice.append(option);
    }
    this.rateChoice.value = "1";
    this.rateChoice.addEventListener("change", () => {
      this.rate = this.rateChoice.value;
    });
    this.cameraChoice = playerElement("select");
    this.cameraChoice.setAttribute("aria-label", "Camera");
    for (const name of this.solid ? PLAYER_VIEWS : ["map"]) {
      const option = playerElement("option", "", name === "map" ? "map" : `${name} camera`);
      option.value = name;
      this.cameraChoice.append(option);
    }
    this.cameraChoice.addEventListener("change", () => this.chooseCamera(this.cameraChoice.value));
    this.ghostButton = playerElement("button", "fw-ghost", "Ghost");
    this.ghostButton.type = "button";
    this.ghostButton.setAttribute("aria-pressed", String(this.ghostShown));
    this.ghostButton.addEventListener("click", () => this.ghost(!this.ghostShown));
    this.startChoice = playerElement("select");
    this.startChoice.setAttribute("aria-label", "Where the ghost starts");
    const every = this.data.ghost ? this.data.ghost.horizon ?? 2 : 2;
    for (const [value, text] of [["again", `ghost: every ${every} s anew`], ["start", "ghost: from the start"]]) {
      const option = playerElement("option", "", text);
      option.value = value;
      this.startChoice.append(option);
    }
    this.startChoice.addEventListener("change", () => this.ghostFromStart(this.startChoice.value === "start"));
    row.append(this.button, this.rateChoice, this.cameraChoice);
    if (this.data.ghost) row.append(this.ghostButton);
    if (this.data.ghost && this.data.ghost.from_start) row.append(this.startChoice);
    return row;
  }

  buildNumbers() {
    const list = playerElement("dl", "fw-numbers");
    for (const [label, [value, unit]] of Object.entries(this.data.numbers || {})) {
      const pair = playerElement("div");
      pair.append(playerElement("dt", "", label), playerElement("dd", "", numberText(value, unit)));
      list.append(pair);
    }
    return list;
  }

  buildCharts() {
    const { data } = this;
    const seek = (t) => this.seek(t);
    this.charts = {
      height: new FlightChart("height", "m", data.t, seek),
      speed: new FlightChart("speed", "m/s", data.t, seek),
    };
    if (data.ghost) this.charts.distance = new FlightChart("distance to the ghost", "m", data.t, seek, 0.2);
    this.setCharts();
    const charts = Object.values(this.charts);
    charts[charts.length - 1].box.dataset.axis = "time";
    return charts.map((chart) => chart.box);
  }

  setCharts() {
    const { data } = this;
    const colorOf = (row) => HOLDER_COLOURS[data.holder[row]] || HOLDER_COLOURS[0];
    const ghost = this.currentGhost();
    const heights = data.pose.map((row) => row[2]);
    const lines = [{ values: heights, colorOf }];
    if (ghost && this.ghostShown) {
      lines.push({ values: ghost.pose.map((row) => (isPose(row) ? row[2] : NaN)), colorOf: () => "#3d8bff88" });
    }
    this.charts.height.set(lines);
    this.charts.speed.set([{ values: data.speed, colorOf }]);
    if (this.charts.distance) {
      this.charts.distance.set([{ values: ghost.distance.map((d) => d ?? NaN), colorOf: () => GHOST_COLOUR }]);
    }
  }

  buildEvents() {
    const box = playerElement("details", "fw-events");
    box.append(playerElement("summary", "", `Events (${this.data.events.length})`));
    const list = playerElement("ol");
    for (const { t, text } of this.data.events) {
      const item = playerElement("li");
      const button = playerElement("button", "", `${t.toFixed(2)} s  ${text}`);
      button.type = "button";
      button.addEventListener("click", () => this.seek(t));
      item.append(button);
      list.append(item);
    }
    box.append(list);
    return box;
  }

  // ---- what changes

  currentGhost() {
    const { ghost } = this.data;
    return ghost && this.fromStart && ghost.from_start ? ghost.from_start : ghost;
  }

  /** The ghost flies from the start on its own, instead of from the flight again and again. */
  ghostFromStart(on) {
    this.fromStart = Boolean(on);
    this.startChoice.value = on ? "start" : "again";
    this.setCharts();
    this.touch();
    this.draw();
  }

  chooseCamera(name) {
    this.camera = this.solid && PLAYER_VIEWS.includes(name) ? name : "map";
    this.cameraChoice.value = this.camera;
    this.map.hidden = this.camera !== "map";
    if (this.solid) this.solid.hidden = this.camera === "map";
    this.touch();
    this.draw();
  }

  /** One sentence over the picture; empty for none. */
  say(text) {
    this.note.textContent = text;
    this.note.hidden = text === "";
  }

  showButton() {
    this.button.textContent = this.playing ? "Pause" : "Play";
    this.element.dataset.playing = String(this.playing);
  }

  touch() {
    this.settledAt = performance.now() + SETTLE_MS;
  }

  key(event) {
    const field = event.target.tagName === "SELECT" || event.target.tagName === "SUMMARY";
    if (event.altKey || event.ctrlKey || event.metaKey || field) return;
    const onBar = event.target === this.range;
    const onButton = event.target.tagName === "BUTTON";
    const step = event.shiftKey ? 1 : this.data.period || 0.05;
    const at = PLAYER_RATES.indexOf(Number(this.rateChoice.value));
    const does = {
      ArrowLeft: () => this.seek(this.t - step),
      ArrowRight: () => this.seek(this.t + step),
      Home: () => this.seek(0),
      End: () => this.seek(this.end),
      "+": () => { this.rate = PLAYER_RATES[Math.min(PLAYER_RATES.length - 1, at + 1)]; },
      "-": () => { this.rate = PLAYER_RATES[Math.max(0, at - 1)]; },
      g: () => this.ghost(!this.ghostShown),
    };
    PLAYER_VIEWS.forEach((name, i) => {
      does[String(i + 1)] = () => this.chooseCamera(name);
    });
    if (!onButton) does[" "] = () => (this.playing ? this.pause() : this.play());
    const doing = does[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!doing || (onBar && event.key === " " && event.repeat)) return;
    event.preventDefault();
    doing();
  }

  frame(now) {
    if (!this.alive) return;
    requestAnimationFrame(this.frame);
    if (this.playing) {
      if (this.last !== null) this.t += ((now - this.last) / 1000) * this.speed;
      this.last = now;
      if (this.t >= this.end) {
        this.t = this.end;
        this.pause();
        this.touch();
      }
    } else if (performance.now() > this.settledAt) {
      return;
    }
    this.draw();
  }

  draw() {
    const { data, t } = this;
    const pose = poseAt(data.t, data.pose, t);
    const { row } = rowAt(data.t, t);
    const ghost = this.ghostShown ? this.currentGhost() : null;
    const ghostPose = ghost ? poseAt(data.t, ghost.pose, t) : null;
    const leader = data.leader ? poseAt(data.t, data.leader, t) : null;
    if (this.camera === "map") this.drawMap(pose, ghost, ghostPose, leader, row);
    else if (pose) this.drawSolid(pose, ghostPose, leader);
    for (const chart of Object.values(this.charts)) chart.draw(t);
    this.range.value = String(t);
    this.range.setAttribute("aria-valuetext", `${t.toFixed(2)} s of ${this.end.toFixed(2)} s`);
    this.clock.textContent = `${t.toFixed(2)} of ${this.end.toFixed(2)} s`;
    const event = data.events.filter((one) => one.t <= t + 1e-6).pop();
    const holder = data.holder[row] ?? 0;
    this.who.dataset.holder = String(holder);
    const hands = holder === 2 ? data.events.filter((one) => one.who && one.t <= t + 1e-6).pop() : null;
    const name = hands ? `: ${hands.who}` : "";
    this.who.textContent = HOLDER_WORDS[holder] + name + (event && event !== hands ? ` \u00b7 ${event.text}` : "");
    // What is drawn now, for who reads the page instead of seeing it.
    this.element.dataset.t = t.toFixed(3);
    if (pose) this.element.dataset.position = [pose[3], pose[7], pose[11]].map((p) => p.toFixed(3)).join(" ");
    this.element.dataset.ghost = ghostPose ? [3, 7, 11].map((i) => ghostPose[i].toFixed(3)).join(" ") : "";
    this.element.dataset.camera = this.camera;
  }

  drawSolid(pose, ghostPose, leader) {
    const list = [];
    if (this.camera !== "nose") list.push({ T_world_body: pose, color: null, opacity: 1 });
    if (ghostPose) list.push({ T_world_body: ghostPose, color: GHOST_COLOUR, opacity: GHOST_OPACITY });
    if (leader) list.push({ T_world_body: leader, color: LEADER_COLOUR, opacity: 1 });
    this.view.setAircraft(list);
    const { camera, hall, pad } = this.data;
    if (this.camera === "nose") {
      this.view.draw(noseCamera(pose, camera), { fovDeg: camera.fov_deg, time: this.t });
      return;
    }
    const tower = [0.5 * (pad.x0 + pad.x1) + 2, hall.y[0] + 1.5, Math.min(2.2, hall.z[1] - 0.3)];
    const T = this.camera === "tower" ? towerCamera(pose, tower) : chaseCamera(pose, { hall });
    this.view.draw(T, { fovDeg: VIEW_FOV_DEG[this.camera], time: this.t });
  }

  drawMap(pose, ghost, ghostPose, leader, row) {
    const { data } = this;
    const paths = [{ rows: data.pose, color: "#8a94a088", width: 1.5 }];
    const marks = [];
    if (data.leader) paths.push({ rows: data.leader, color: `${LEADER_COLOUR}66`, width: 1.5 });
    if (ghost) paths.push({ rows: ghost.pose, color: `${GHOST_COLOUR}88`, width: 2 });
    paths.push({ rows: data.pose, color: HOLDER_COLOURS[data.holder[row]] || "#d2691e", width: 2.5, upTo: row + 1 });
    if (leader) marks.push({ T: leader, color: LEADER_COLOUR });
    if (ghostPose) marks.push({ T: ghostPose, color: GHOST_COLOUR, opacity: 0.6 });
    if (pose) marks.push({ T: pose, color: HOLDER_COLOURS[data.holder[row]] || "#d2691e" });
    this.flat.draw(data, paths, marks);
  }
}
