// Messages of the class -> parts that wall, seat and desk share: who flies, sticks, verdict, board, effects.

import { themeColor } from "./theme.js";

const WHO_WORDS = {
  autopilot: "AUTOPILOT",
  student: "STUDENT",
  safe: "SAFE: sticks neutral, motor idle",
  nobody: "PREPARING",
};
const WHO_PATIENCE = 10; // states that disagree before they are believed

/** The element with an id. */
export function byId(id) {
  return document.getElementById(id);
}

/** A new element with a class and text; text is never read as HTML. */
export function newElement(tag, className = "", text = "") {
  const made = document.createElement(tag);
  if (className) made.className = className;
  if (text !== "") made.textContent = text;
  return made;
}

/** A number as a person reads it, at most three figures; a dash where there is none. */
export function readable(value) {
  if (typeof value !== "number" || !Number.isFinite(value)) return "\u2013";
  const text = Math.abs(value) >= 100 ? value.toFixed(0) : String(Number(value.toPrecision(3)));
  return text.replace("-", "\u2212");
}

/** A number with its unit; "-3 cm left" is "3 cm right". */
export function readableMeasure(value, unit) {
  const words = unit || "";
  if (value < 0 && words.endsWith(" left")) return `${readable(-value)} ${words.slice(0, -4)}right`;
  return `${readable(value)} ${words}`.trim();
}

/** 1st, 2nd, 3rd, 4th, ... 11th, 12th, 13th, ... */
export function ordinal(number) {
  const teen = number % 100 >= 11 && number % 100 <= 13;
  return `${number}${(!teen && { 1: "st", 2: "nd", 3: "rd" }[number % 10]) || "th"}`;
}

/** A name as the kit writes it, as words: "left_turn_s_descent" -> "left turn s descent". */
export function asWords(name) {
  return String(name || "").replaceAll("_", " ");
}

/** The line that says who flies, from "who" texts; from states where those disagree for long. */
export class WhoLine {
  constructor(line, reason, channel) {
    this.line = line;
    this.reason = reason;
    this.who = { holder: "nobody", name: "", reason: "" };
    this.doubts = 0;
    this.words = WHO_WORDS;
    channel.on("hello", (hello) => {
      if (hello.has_poses === false) this.words = { ...WHO_WORDS, nobody: "REPLAY" };
    });
    channel.on("who", (who) => {
      this.who = who;
      this.doubts = 0;
      this.showWho();
    });
    channel.on("state", (state) => {
      if (state.holder === this.who.holder) {
        if (this.doubts >= WHO_PATIENCE) this.showWho();
        this.doubts = 0;
      } else {
        this.doubts += 1;
        if (this.doubts === WHO_PATIENCE) this.show(state.holder, "", "");
      }
    });
    this.show("nobody", "", "");
  }

  showWho() {
    const { holder, name, reason } = this.who;
    this.show(holder, holder === "student" ? name : "", reason);
  }

  show(holder, name, reason) {
    const known = Object.hasOwn(WHO_WORDS, holder) ? holder : "nobody";
    this.line.dataset.holder = known;
    this.line.textContent = this.words[known] + (name ? `: ${name}` : "");
    if (this.reason) this.reason.textContent = reason || "";
  }
}

/** Two square gimbals on a canvas, as on a transmitter of mode 2: pulled back is nose up. */
export function drawSticks(canvas, [throttle, aileron, elevator, rudder], holder) {
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  if (width < 10 || height < 10) return;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  const upright = height > width;
  const side = upright ? Math.min(width, 0.48 * height) : Math.min(height, 0.48 * width);
  const color = themeColor({ autopilot: "blue", student: "rust" }[holder] || "quiet");
  const gimbal = (x0, y0, right, up) => {
    const [half, reach] = [side / 2 - 2, 0.4 * side];
    const [cx, cy] = [x0 + side / 2, y0 + side / 2];
    pen.lineWidth = 2;
    pen.strokeStyle = themeColor("quiet");
    pen.beginPath();
    pen.roundRect(cx - half, cy - half, 2 * half, 2 * half, 0.12 * side);
    pen.moveTo(cx - half, cy);
    pen.lineTo(cx + half, cy);
    pen.moveTo(cx, cy - half);
    pen.lineTo(cx, cy + half);
    pen.stroke();
    pen.strokeStyle = color;
    pen.fillStyle = color;
    pen.lineWidth = 0.06 * side;
    pen.beginPath();
    pen.moveTo(cx, cy);
    pen.lineTo(cx + reach * right, cy - reach * up);
    pen.stroke();
    pen.beginPath();
    pen.arc(cx + reach * right, cy - reach * up, 0.11 * side, 0, 2 * Math.PI);
    pen.fill();
  };
  gimbal(upright ? (width - side) / 2 : 0, 0, rudder, 2 * throttle - 1);
  gimbal(upright ? (width - side) / 2 : width - side, upright ? height - side : 0, aileron, -elevator);
}

/** Fill `box` with a verdict: its sentence, its numbers, who flew. */
export function showVerdict(box, verdict) {
  const outcome = { true: "Success", false: "Not this time" }[String(verdict.success)] || "Not judged";
  const numbers = newElement("dl", "numbers");
  for (const [label, [value, unit]] of Object.entries(verdict.numbers || {})) {
    const pair = newElement("div");
    pair.append(newElement("dt", "", asWords(label)));
    pair.append(newElement("dd", "", readableMeasure(value, unit)));
    numbers.append(pair);
  }
  const flown = (verdict.holders || []).join(", ");
  box.dataset.success = String(verdict.success);
  box.replaceChildren(
    newElement("p", "outcome", outcome),
    newElement("p", "sentence", verdict.sentence),
    numbers,
    newElement("p", "flown", `Flight ${verdict.flight}${flown ? `, flown by ${flown}` : ""}`),
  );
}

/** Fill an ordered list with the best flights; at most `count`. */
export function showBoard(list, rows, count) {
  const items = (rows || []).slice(0, count).map((row, place) => {
    const item = newElement("li");
    item.append(
      newElement("span", "place", `${place + 1}.`),
      newElement("span", "name", row.name),
      newElement("span", "task", asWords(row.task)),
      newElement("span", "score", readableMeasure(row.score, row.unit)),
    );
    return item;
  });
  list.replaceChildren(...(items.length ? items : [newElement("li", "empty", "No flight on the board yet.")]));
}

/** Fill a list with the names of the effects that act now; hidden without any. */
export function showEffects(list, names) {
  list.replaceChildren(...(names || []).map((name) => newElement("li", "", asWords(name))));
  list.hidden = !names || names.length === 0;
}

/** One sentence on time: paused, slowed down, or stretched by a busy computer; "" in real time. */
export function timeSentence(state) {
  if (state.paused) return "PAUSED";
  const speed = readable(state.speed);
  if (state.stretched) return `TIME IS STRETCHED: this computer is busy, ${state.rate.toFixed(1)} of 20 steps a second`;
  if (state.speed < 0.99) return `SLOW MOTION: ${speed} of real time`;
  if (state.speed > 1.01) return `FAST: ${speed} times real time`;
  return "";
}

/** What the corner says: nothing here pretends to be a real flight. */
export function simulationWords(hello, state) {
  if (!hello || hello.simulated !== false) return state && state.port ? "SIMULATION, through the board" : "SIMULATION";
  return "REAL AIRCRAFT";
}

/** Show the connection's sentence in a box while there is one. */
export function showConnection(box, channel) {
  channel.on("status", (status) => {
    box.textContent = status.sentence;
    box.hidden = status.sentence === "";
    box.dataset.ended = String(status.ended);
    document.documentElement.dataset.connected = String(status.connected);
  });
}

/** The address that others open: the class's own link, or this page's with its token. */
function classLink(hello) {
  if (hello && hello.link) return hello.link;
  const token = new URLSearchParams(location.search).get("token");
  return `${location.origin}/${token ? `?token=${encodeURIComponent(token)}` : ""}`;
}

/** Write the address into a box: the part to type in large letters, the rest behind it. */
export function showLink(box, hello) {
  const link = new URL(classLink(hello), location.href);
  const rest = link.pathname === "/" && !link.search ? "" : link.pathname + link.search;
  box.replaceChildren(newElement("strong", "", link.host), newElement("span", "", rest));
}

/** An image that is hidden where the server has none. */
export function showQr(image) {
  image.addEventListener("error", () => {
    image.hidden = true;
  });
  image.src = "/qr.svg";
}

/** Buttons for the cameras {name: label} in a box; `show(name)` marks the one in use. */
export function cameraButtons(box, cameras, onchoose) {
  const buttons = Object.entries(cameras).map(([name, label]) => {
    const button = newElement("button", "choice", label);
    button.type = "button";
    button.addEventListener("click", () => onchoose(name));
    return [name, button];
  });
  box.replaceChildren(...buttons.map(([, button]) => button));
  const show = (chosen) => {
    for (const [name, button] of buttons) button.setAttribute("aria-pressed", String(name === chosen));
  };
  return { show };
}
