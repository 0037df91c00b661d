// Bytes of the classroom's WebSocket <-> plain objects; a connection that comes back by itself.

export const STICKS_BYTES = 24;
export const HOLDERS = ["nobody", "autopilot", "student", "safe"];
const KIND_STATE = 1;
const KIND_PICTURE = 2;
const KIND_STICKS = 3;
const STATE_HEAD = 12; // "<BBBBHHf"; numbers of 4 bytes follow
const RETRY_MS = [300, 600, 1000, 2000, 4000];
const SILENCE_MS = 6000; // without a message for this long, a connection is lost
const CLASS_ENDED = [1000, 1001]; // close codes "normal" and "going away"

/**
 * One state, "<BBBBHHf" and at least 20 numbers, as an object; null for anything else.
 * Lengths in m, angles in rad, speeds in m/s; `leader` is null without one.
 */
export function unpackState(buffer) {
  if (buffer.byteLength < STATE_HEAD + 80 || (buffer.byteLength - STATE_HEAD) % 4) return null;
  const view = new DataView(buffer);
  if (view.getUint8(0) !== KIND_STATE) return null;
  const count = (buffer.byteLength - STATE_HEAD) / 4;
  const numbers = Array.from({ length: count }, (_, i) => view.getFloat32(STATE_HEAD + 4 * i, true));
  const flags = view.getUint8(1);
  return {
    paused: (flags & 2) !== 0,
    stretched: (flags & 4) !== 0,
    over: (flags & 8) !== 0,
    port: (flags & 16) !== 0,
    assist: (flags & 32) !== 0,
    holder: HOLDERS[view.getUint8(2)] || "nobody",
    phase: view.getUint8(3),
    flight: view.getUint16(4, true),
    step: view.getUint16(6, true),
    t: view.getFloat32(8, true),
    pose: numbers.slice(0, 6),
    velocity: numbers.slice(6, 9),
    command: numbers.slice(9, 13),
    leader: flags & 1 && Number.isFinite(numbers[13]) ? numbers.slice(13, 19) : null,
    rate: numbers[19],
    speed: count > 20 ? numbers[20] : 1,
  };
}

/** Whether two states agree in these parts: a flight that stands still is sent again and again. */
export function sameParts(a, b, names) {
  return names.every((name) => JSON.stringify(a[name]) === JSON.stringify(b[name]));
}

/** One picture, "<BBHI" and a JPEG, as {flight, sequence, blob}; null for anything else. */
export function unpackPicture(buffer) {
  if (buffer.byteLength <= 8) return null;
  const view = new DataView(buffer);
  if (view.getUint8(0) !== KIND_PICTURE) return null;
  const blob = new Blob([new Uint8Array(buffer, 8)], { type: "image/jpeg" });
  return { flight: view.getUint16(2, true), sequence: view.getUint32(4, true), blob };
}

/** Sticks {throttle 0..1, aileron, elevator, rudder -1..1} as 24 bytes "<BBHI4f". */
export function packSticks(sticks, hold, assist, sequence, clockMs) {
  const view = new DataView(new ArrayBuffer(STICKS_BYTES));
  view.setUint8(0, KIND_STICKS);
  view.setUint8(1, (hold ? 1 : 0) | (assist ? 2 : 0));
  view.setUint16(2, sequence & 0xffff, true);
  view.setUint32(4, Math.floor(clockMs) >>> 0, true);
  const within = (value, low) => Math.min(1, Math.max(low, Number.isFinite(value) ? value : 0));
  view.setFloat32(8, within(sticks.throttle, 0), true);
  view.setFloat32(12, within(sticks.aileron, -1), true);
  view.setFloat32(16, within(sticks.elevator, -1), true);
  view.setFloat32(20, within(sticks.rudder, -1), true);
  return view.buffer;
}

/**
 * The connection to the class. `on("hello" | "state" | "picture" | any text's type, handler)`;
 * "status" handlers get {connected, ended, sentence}, at once and after each change.
 */
export class Channel {
  constructor(role) {
    const asked = new URLSearchParams(location.search);
    const query = new URLSearchParams({ role });
    for (const name of ["key", "token"]) if (asked.has(name)) query.set(name, asked.get(name));
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    this.address = `${scheme}//${location.host}/ws?${query}`;
    this.client = 0;
    this.roundTripMs = NaN;
    this.status = { connected: false, ended: false, sentence: "Connecting to the class ..." };
    this.handlers = new Map();
    this.failures = 0;
    this.everOpen = false;
    this.heardAt = 0;
    this.open();
    setInterval(() => this.watch(), 2000);
  }

  on(type, handler) {
    this.handlers.set(type, [...(this.handlers.get(type) || []), handler]);
    if (type === "status") handler(this.status);
  }

  /** Send an object as JSON text; false while there is no connection. */
  send(message) {
    return this.pass(JSON.stringify(message));
  }

  /** Send bytes unless old ones still wait: a late stick position is worth nothing. */
  sendFresh(bytes) {
    return this.socket.bufferedAmount < 256 && this.pass(bytes);
  }

  pass(data) {
    if (this.socket.readyState !== WebSocket.OPEN) return false;
    this.socket.send(data);
    return true;
  }

  open() {
    const socket = new WebSocket(this.address);
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.failures = 0;
      this.everOpen = true;
      this.heardAt = performance.now();
      this.say({ connected: true, ended: false, sentence: "" });
    };
    socket.onmessage = (message) => {
      this.heardAt = performance.now();
      this.hear(message.data);
    };
    socket.onclose = (event) => this.lost(socket, event);
  }

  lost(socket, event) {
    if (socket !== this.socket) return;
    this.client = 0;
    const wait = RETRY_MS[Math.min(this.failures, RETRY_MS.length - 1)];
    this.failures += 1;
    const ended = CLASS_ENDED.includes(event.code) || (this.status.ended && event.code === 1006);
    const why = event.reason ? ` The class says: ${event.reason}.` : "";
    let sentence = `The connection to the class is lost.${why} Trying again ...`;
    if (!this.everOpen) {
      sentence = `No connection to the class at ${location.host}.${why} It may be full, or in another Wi-Fi. Trying again ...`;
    }
    if (ended) sentence = "The class has ended. This page connects again when the next one begins.";
    this.say({ connected: false, ended, sentence });
    setTimeout(() => this.open(), ended ? 5000 : wait);
  }

  /** Ask for a sign of life; a connection without any message for some seconds is closed. */
  watch() {
    if (this.socket.readyState !== WebSocket.OPEN) return;
    if (performance.now() - this.heardAt > SILENCE_MS) {
      const silent = this.socket;
      silent.close();
      this.lost(silent, { code: 1006, reason: "" });
      return;
    }
    this.send({ type: "ping", stamp: performance.now() });
  }

  hear(data) {
    if (data instanceof ArrayBuffer) {
      const state = unpackState(data);
      if (state) return this.tell("state", state);
      const picture = unpackPicture(data);
      return picture ? this.tell("picture", picture) : undefined;
    }
    let message;
    try {
      message = JSON.parse(data);
    } catch {
      return undefined; // half a message is no message
    }
    if (!message || typeof message.type !== "string") return undefined;
    if (message.type === "hello") this.client = message.client;
    if (message.type === "pong") this.roundTripMs = performance.now() - message.stamp;
    return this.tell(message.type, message);
  }

  tell(type, message) {
    for (const handler of this.handlers.get(type) || []) handler(message);
  }

  say(status) {
    this.status = status;
    this.tell("status", status);
  }
}
