// Numbers over the time of a flight -> strip charts with units, on one canvas each.

import { themeColor } from "./theme.js";

const CHART_COLORS = { autopilot: "blue", student: "rust", safe: "quiet", nobody: "quiet" };
const CHART_DASHES = { autopilot: [], student: [], safe: [2, 2], nobody: [2, 2] };

/** A step of 1, 2 or 5 times a power of ten that cuts `span` into at most `count` parts. */
export function roundStep(span, count) {
  const rough = span / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  return power * [1, 2, 5, 10].find((factor) => factor * power >= rough * 0.999);
}

/**
 * One strip chart: the last `seconds` of a value. The line has the colour of who flies, and is
 * thicker under a student's hand.
 */
export class StripChart {
  constructor(canvas, { low, high, seconds = 20, zero = false }) {
    this.canvas = canvas;
    this.least = [low, high];
    this.seconds = seconds;
    this.zero = zero;
    this.points = [];
  }

  clear() {
    this.points = [];
  }

  add(t, value, holder) {
    const last = this.points[this.points.length - 1];
    if (last && t < last.t) this.clear();
    if (!Number.isFinite(value) || (last && t === last.t)) return;
    this.points.push({ t, value, holder });
    while (this.points.length && this.points[0].t < t - this.seconds - 1) this.points.shift();
  }

  /** The limits of the vertical axis: the usual ones, wider where the values are. */
  limits() {
    const values = this.points.map((point) => point.value);
    let [low, high] = [Math.min(this.least[0], ...values), Math.max(this.least[1], ...values)];
    const step = roundStep(high - low, 3);
    if (low < this.least[0]) low = Math.floor(low / step) * step;
    if (high > this.least[1]) high = Math.ceil(high / step) * step;
    return { low, high, step };
  }

  draw() {
    const { canvas } = this;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (width < 20 || height < 20) return;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const style = getComputedStyle(canvas);
    const size = parseFloat(style.fontSize);
    pen.font = `${size}px ${style.fontFamily}`;
    const { low, high, step } = this.limits();
    const decimals = step < 1 ? 1 : 0;
    const ticks = [];
    for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9; i += 1) ticks.push(i * step);
    const texts = ticks.map((tick) => tick.toFixed(decimals).replace("-", "\u2212"));
    const left = Math.max(...texts.map((text) => pen.measureText(text).width)) + 0.4 * size;
    const end = this.points.length ? this.points[this.points.length - 1].t : 0;
    const begin = Math.max(0, end - this.seconds);
    const x = (t) => left + ((t - begin) / this.seconds) * (width - left - 2);
    const y = (value) => 0.55 * size + ((high - value) / (high - low)) * (height - 1.1 * size);
    this.drawTicks(pen, { ticks, texts, left, width, y });
    this.drawLine(pen, x, y);
  }

  drawTicks(pen, { ticks, texts, left, width, y }) {
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    pen.setLineDash([]);
    ticks.forEach((tick, i) => {
      pen.fillStyle = themeColor("quiet");
      pen.fillText(texts[i], left - 0.3 * parseFloat(pen.font), y(tick));
      pen.strokeStyle = themeColor(this.zero && tick === 0 ? "quiet" : "line");
      pen.lineWidth = 1;
      pen.beginPath();
      pen.moveTo(left, y(tick));
      pen.lineTo(width, y(tick));
      pen.stroke();
    });
  }

  drawLine(pen, x, y) {
    let start = 0;
    for (let i = 1; i <= this.points.length; i += 1) {
      const holder = this.points[start].holder;
      if (i < this.points.length && this.points[i].holder === holder) continue;
      pen.strokeStyle = themeColor(CHART_COLORS[holder] || "quiet");
      pen.setLineDash(CHART_DASHES[holder] || []);
      pen.lineWidth = holder === "student" ? 4 : 2.5;
      pen.lineJoin = "round";
      pen.beginPath();
      for (let k = Math.max(0, start - 1); k < i; k += 1) {
        const point = this.points[k];
        if (k === Math.max(0, start - 1)) pen.moveTo(x(point.t), y(point.value));
        else pen.lineTo(x(point.t), y(point.value));
      }
      pen.stroke();
      start = i;
    }
    pen.setLineDash([]);
  }
}

/**
 * Height, speed and distance from the runway's centre line, each with a heading that shows the
 * newest value, inside `box`.
 */
export class FlightCharts {
  constructor(box) {
    const make = (label, unit, range) => {
      const figure = document.createElement("figure");
      const caption = document.createElement("figcaption");
      const value = document.createElement("span");
      const canvas = document.createElement("canvas");
      figure.className = "chart";
      value.className = "value";
      caption.append(`${label} `, value);
      canvas.setAttribute("role", "img");
      canvas.setAttribute("aria-label", `${label} in ${unit} over the last 20 seconds`);
      figure.append(caption, canvas);
      box.append(figure);
      return { chart: new StripChart(canvas, range), value, unit };
    };
    this.rows = [
      make("Height", "m", { low: 0, high: 2 }),
      make("Speed", "m/s", { low: 0, high: 6 }),
      make("From the centre line", "m", { low: -2, high: 2, zero: true }),
    ];
    this.flight = -1;
    this.textAt = 0;
  }

  add(state) {
    if (state.flight !== this.flight) for (const row of this.rows) row.chart.clear();
    this.flight = state.flight;
    const [, y, height] = state.pose;
    const values = [height, Math.hypot(...state.velocity), y];
    const now = performance.now();
    const showText = now - this.textAt > 180; // figures that change faster cannot be read
    if (showText) this.textAt = now;
    this.rows.forEach((row, i) => {
      row.chart.add(state.t, values[i], state.holder);
      if (!showText) return;
      const side = i === 2 && Math.abs(values[i]) >= 0.05 ? (values[i] > 0 ? " left" : " right") : "";
      row.value.textContent = `${(i === 2 ? Math.abs(values[i]) : values[i]).toFixed(1)} ${row.unit}${side}`;
    });
  }

  draw() {
    for (const row of this.rows) row.chart.draw();
  }
}
