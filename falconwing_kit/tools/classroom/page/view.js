// States at 20 Hz and the hall's scene -> pictures at the display's rate; the camera's pictures where WebGL2 is missing.

import { SplatView } from "./splats.js";
import { sameParts } from "./channel.js";
import { poseMatrix, chaseCamera, noseCamera, towerCamera, interpolatePoses } from "./camera.js";

export const CAMERAS = ["chase", "nose", "tower", "picture"];
const VIEW_BACKGROUND = [0.106, 0.133, 0.169];
const CHASE_FOV_DEG = 70;
const TOWER_WIDTH = 5; // m of the hall that the tower's camera shows at the aircraft
const TOWER_FOV_DEG = [20, 65]; // of its zoom
const JUMP = 2.5; // m between two states: a new flight, not a movement
const LEADER_COLOR = "#d98f00";
const STEADY_MS = 700; // go on drawing this long after the last change: sorting ends later

/** The pictures of the aircraft's camera, drawn on canvases; asked for only while one is seen. */
export class Pictures {
  constructor(channel) {
    this.channel = channel;
    this.canvases = new Set();
    this.asked = false;
    this.waiting = null;
    this.busy = false;
    channel.on("hello", () => {
      this.asked = false;
      this.ask();
    });
    channel.on("picture", (picture) => this.take(picture.blob));
    document.addEventListener("visibilitychange", () => this.ask());
  }

  show(canvas, on) {
    if (on) this.canvases.add(canvas);
    else this.canvases.delete(canvas);
    this.ask();
  }

  ask() {
    const on = this.canvases.size > 0 && document.visibilityState === "visible";
    if (on !== this.asked && this.channel.send({ type: "picture", on })) this.asked = on;
  }

  /** Decode one picture at a time; of those that arrive meanwhile only the newest is kept. */
  async take(blob) {
    this.waiting = blob;
    if (this.busy) return;
    this.busy = true;
    while (this.waiting) {
      const next = this.waiting;
      this.waiting = null;
      try {
        const bitmap = await createImageBitmap(next);
        for (const canvas of this.canvases) {
          if (canvas.width !== bitmap.width) canvas.width = bitmap.width;
          if (canvas.height !== bitmap.height) canvas.height = bitmap.height;
          canvas.getContext("2d").drawImage(bitmap, 0, 0);
          canvas.dataset.pictures = String(Number(canvas.dataset.pictures || 0) + 1);
        }
        bitmap.close();
      } catch {
        // A damaged picture is left out; the next one comes in 50 ms.
      }
    }
    this.busy = false;
  }
}

/**
 * The hall inside `box`: chase, nose or tower camera, or the aircraft's own pictures. Poses are
 * drawn up to one state behind, moving from the pose on the screen to the newest one.
 */
export class HallView {
  constructor(box, channel, pictures, { camera = "chase", onchange = () => {} } = {}) {
    this.channel = channel;
    this.pictures = pictures;
    this.onchange = onchange;
    this.camera = camera;
    this.wanted = camera;
    this.canvas = document.createElement("canvas");
    this.flat = document.createElement("canvas");
    this.note = document.createElement("p");
    this.canvas.className = "hall-canvas";
    this.flat.className = "hall-picture";
    this.flat.width = 320;
    this.flat.height = 240;
    this.note.className = "hall-note";
    this.note.setAttribute("role", "status");
    this.canvas.setAttribute("role", "img");
    this.flat.setAttribute("role", "img");
    this.flat.setAttribute("aria-label", "Picture of the aircraft's camera");
    box.append(this.canvas, this.flat, this.note);
    this.splats = null;
    this.failed = false;
    this.suspended = false;
    this.state = null;
    this.shown = null;
    this.period = 50;
    this.drawnUntil = 0;
    this.settled = false; // the newest state is drawn, and its order has had time to come
    this.saidReady = false; // the server knows that the hall is seen here
    this.drawing = this.drawing.bind(this);
    if (!SplatView.supported()) this.fail("This browser has no WebGL2");
    channel.on("hello", (hello) => this.begin(hello));
    channel.on("preparing", (message) => this.prepare(message));
    channel.on("state", (state) => this.take(state));
    document.addEventListener("visibilitychange", () => this.sayReady());
    this.setCamera(camera);
    requestAnimationFrame(this.drawing);
  }

  /** Load the hall that the class flies in as soon as it is there; the aircraft is drawn before. */
  async begin(hello) {
    this.hello = hello;
    this.saidReady = false;
    this.sayReady();
    if (this.failed || this.address === hello.scene_url) return;
    this.address = hello.scene_url;
    try {
      if (!this.splats) {
        const onstatus = (text) => this.say(text);
        this.splats = new SplatView(this.canvas, { background: VIEW_BACKGROUND, onstatus });
      }
      this.wake();
      if (!hello.scene_url) return;
      await this.splats.load(hello.scene_url, (bytes, total) => this.progress(bytes, total));
      this.say("");
    } catch (error) {
      this.fail(`The hall cannot be drawn here (${error.message})`);
    }
    this.wake();
  }

  /** What the class says while it makes the hall ready; the last word stays if there is no hall. */
  prepare(message) {
    if (this.address || this.failed) return;
    const text = String(message.text || "");
    this.say(text && `${text[0].toUpperCase()}${text.slice(1)}.`);
  }

  /** Bytes so far, and in all where the browser says so. */
  progress(bytes, total) {
    const size = `${(bytes / 1e6).toFixed(1)} MB`;
    this.say(`Loading the hall: ${total ? `${Math.round((100 * bytes) / total)} %` : size}`);
  }

  fail(why) {
    this.failed = true;
    this.say(`${why}: you see the pictures of the aircraft's camera instead.`);
    this.setCamera(this.wanted);
  }

  say(text) {
    this.note.textContent = text;
    this.note.hidden = text === "";
  }

  setCamera(name) {
    this.wanted = CAMERAS.includes(name) ? name : "chase";
    this.camera = this.failed ? "picture" : this.wanted;
    const flat = this.camera === "picture";
    this.canvas.hidden = flat;
    this.flat.hidden = !flat;
    this.pictures.show(this.flat, flat);
    this.canvas.setAttribute("aria-label", `The hall seen by the ${this.camera} camera`);
    this.wake();
    this.onchange(this.camera);
  }

  /** Draw nothing while another view of the hall lies over this one. */
  suspend(on) {
    this.suspended = on;
    this.wake();
  }

  take(state) {
    if (!state.pose.every(Number.isFinite)) return; // a real flight without poses
    const now = performance.now();
    const pose = poseMatrix(...state.pose);
    const leader = state.leader ? poseMatrix(...state.leader) : null;
    const far = this.state === null || state.flight !== this.state.flight || posesApart(pose, this.pose) > JUMP;
    if (!far) this.period += 0.2 * (Math.min(300, Math.max(20, now - this.heard)) - this.period);
    this.heard = now;
    if (this.state && sameParts(state, this.state, ["flight", "pose", "leader"])) return; // nothing moves
    const shown = this.poses(now);
    this.from = far || !shown ? { pose, leader } : shown;
    this.state = state;
    this.pose = pose;
    this.leader = leader;
    this.arrived = now;
    this.wake();
  }

  /** The poses to draw at a time [ms]: between those on the screen and the newest. */
  poses(now) {
    if (!this.state) return null;
    const share = Math.min(1, Math.max(0, (now - this.arrived) / this.period));
    const between = (a, b) => (a && b ? interpolatePoses(a, b, share) : b);
    return { pose: between(this.from.pose, this.pose), leader: between(this.from.leader, this.leader) };
  }

  /** How fast this device draws the hall; "" where it does not. */
  describe() {
    if (!this.splats || this.camera === "picture" || !(this.splats.stats.fps > 0)) return "";
    const { fps, sortMs } = this.splats.stats;
    return `The hall: ${Math.round(fps)} pictures a second, sorted in ${Math.round(sortMs)} ms.`;
  }

  /** Say once that a flight may begin: the hall is on the screen, or will not be. */
  sayReady() {
    const waits = this.camera !== "picture" && !document.hidden && !this.splats?.isHallSeen;
    if (!this.saidReady && !waits) this.saidReady = this.channel.send({ type: "ready" });
  }

  wake() {
    this.drawnUntil = performance.now() + STEADY_MS;
    this.settled = false;
  }

  drawing(now) {
    requestAnimationFrame(this.drawing);
    this.sayReady();
    if (!this.splats || !this.hello || this.suspended || this.camera === "picture") return;
    if (this.settled) return;
    const shown = this.poses(performance.now());
    const aircraft = [];
    if (shown && this.camera !== "nose") aircraft.push({ T_world_body: shown.pose, color: null, opacity: 1 });
    if (shown?.leader) aircraft.push({ T_world_body: shown.leader, color: LEADER_COLOR, opacity: 1 });
    this.splats.setAircraft(aircraft);
    const { T_world_camera, fovDeg } = shown ? this.look(shown.pose) : this.lookAtPad();
    this.splats.draw(T_world_camera, { fovDeg, time: now / 1000 });
    this.settled = performance.now() > this.drawnUntil;
  }

  look(pose) {
    if (this.camera === "nose") {
      const mount = this.hello.camera;
      return { T_world_camera: noseCamera(pose, mount), fovDeg: mount.fov_deg };
    }
    if (this.camera === "tower") {
      const place = this.tower();
      const distance = Math.hypot(pose[3] - place[0], pose[7] - place[1], pose[11] - place[2]);
      const wide = (2 * Math.atan2(TOWER_WIDTH / 2, distance) * 180) / Math.PI;
      const fovDeg = Math.min(TOWER_FOV_DEG[1], Math.max(TOWER_FOV_DEG[0], wide));
      return { T_world_camera: towerCamera(pose, place), fovDeg };
    }
    return { T_world_camera: chaseCamera(pose, { hall: this.hello.hall }), fovDeg: CHASE_FOV_DEG };
  }

  /** The spectator's view before anything flies. */
  lookAtPad() {
    const pad = poseMatrix(...this.middle(), 0, 0, 0, 0);
    return { T_world_camera: towerCamera(pad, this.tower()), fovDeg: TOWER_FOV_DEG[1] };
  }

  /** Where a spectator stands: beside the landing pad, inside the hall, eyes at 2.2 m [m]. */
  tower() {
    const { hall } = this.hello;
    return [this.middle()[0] + 2, hall.y[0] + 1.5, Math.min(2.2, hall.z[1] - 0.3)];
  }

  /** Middle of the landing pad, or of a hall without one: x and y [m]. */
  middle() {
    const { pad, hall } = this.hello;
    const [x, y] = pad ? [[pad.x0, pad.x1], [pad.y0, pad.y1]] : [hall.x, hall.y];
    return [0.5 * (x[0] + x[1]), 0.5 * (y[0] + y[1])];
  }
}

/** Distance between the origins of two poses [m]. */
function posesApart(a, b) {
  return Math.hypot(a[3] - b[3], a[7] - b[7], a[11] - b[11]);
}
