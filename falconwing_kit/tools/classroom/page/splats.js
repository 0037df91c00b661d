// Splat renderer: an SPZ of version 3 + a camera pose -> the hall and aircraft on a WebGL2 canvas.
//
// The mathematics and constants are those of scene/fast.py: each Gaussian becomes an ellipse in the
// image. Steps of a frame: boxes of the aircraft with their depth; splats, farthest first, behind
// whatever box is nearer; translucent boxes; a copy to the canvas. A worker sorts the splats by
// depth whenever the view moves; until its answer comes, the last order is drawn. One frame at a
// time: of the views that come while it is being drawn, only the newest is drawn next.
import { AIRCRAFT_BOXES, boxTriangles, colourFromText } from "./aircraft.js";

const SPLAT_NEAR = 0.01; // smallest depth that is drawn [m]
// The depth buffer holds -DEPTH_NEAR / z, from -1 at this depth [m] to 0 at infinity. The rest of its
// range is for the corners of quads that reach past their own horizon, where 1 / z is negative.
const DEPTH_NEAR = 0.02;
const TEXTURE_WIDTH = 2048; // texels; two hold one Gaussian
const MAX_PIXEL_RATIO = 1.5; // sharper screens get this: four times the pixels take four times as long
const REACH = 5; // radius in standard deviations for what is in view: 3.3, and the error of its ellipse
const VIEW_MARGIN = 1.3; // splats up to so many half images from the middle are sorted and drawn: the
// view may turn by some 10 degrees until the next order comes
const MAX_TURN = (8 * Math.PI) / 180; // of a view since its order was asked for: then it waits for its own
const MAX_MOVE = 1; // and at most so far [m]
const SHARES = [1, 0.75, 0.5, 0.35]; // of the resolution, from a quick machine to a slow one
const SLOW_MS = 45; // a frame, averaged over PACE_FRAMES: the next lower share
const QUICK_MS = 18; // the next higher one, at most MAX_RAISES times, so that it cannot alternate
const PACE_FRAMES = 40;
const MAX_RAISES = 3;
const STUCK_MS = 400; // two frames in a row: the lowest share at once
const POLL_MS = 5; // from one look whether a frame is done to the next
const REST = 0.5; // of the time of a slow frame, after it: for the rest of the page and the machine
const LONGEST_MS = 10000; // a frame that is not reported as done by then is taken for done
const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i; // renderers without a GPU
const MAX_SPLATS = 2097152; // 2048 rows of 1024; more is no scene for a page
const SPZ_MAGIC = 0x5053474e; // "NGSP"

// The vertex shader: the codes of an SPZ -> an ellipse, as a quad of 4 vertices. Names as in fast.py.
const SPLAT_VERTEX = `#version 300 es
precision highp float;
precision highp int;
uniform highp usampler2D codes;
uniform highp usampler2D order;
uniform mat3 R_camera_world;
uniform vec3 p_world;
uniform vec2 size;      // of the image [px]
uniform float focal;    // [px]
out vec2 offset;        // from the middle, in standard deviations
flat out vec4 colour;   // red, green, blue, opacity
const float NEAR = ${SPLAT_NEAR}, DEPTH_NEAR = ${DEPTH_NEAR}, BLUR = 0.3, MARGIN = 0.3, ALPHA_MIN = 1.0 / 255.0;

vec4 bytesOf(uint word) {
  return vec4(word & 255u, word >> 8 & 255u, word >> 16 & 255u, word >> 24);
}

mat3 rotationOf(uint word) {  // index of the largest of x y z w, sign and 9 bits of the others
  uvec3 fields = uvec3(word >> 20, word >> 10, word) & 1023u;
  vec3 small = vec3(fields & 511u) * (0.70710678 / 511.0);
  small *= 1.0 - 2.0 * vec3(fields >> 9);
  float large = sqrt(max(0.0, 1.0 - dot(small, small)));
  uint largest = word >> 30;
  vec4 q = largest == 0u ? vec4(large, small) : largest == 1u ? vec4(small.x, large, small.yz)
    : largest == 2u ? vec4(small.xy, large, small.z) : vec4(small, large);
  float x = q.x, y = q.y, z = q.z, w = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside: nothing is drawn
  offset = vec2(0.0);
  colour = vec4(0.0);
  int turn = gl_VertexID >> 2;  // four vertices a splat
  ivec2 entry = ivec2(turn % ${TEXTURE_WIDTH}, turn / ${TEXTURE_WIDTH});
  int texel = 2 * int(texelFetch(order, entry, 0).x);
  ivec2 place = ivec2(texel % ${TEXTURE_WIDTH}, texel / ${TEXTURE_WIDTH});
  uvec4 first = texelFetch(codes, place, 0);
  uvec4 second = texelFetch(codes, place + ivec2(1, 0), 0);
  vec3 toward = uintBitsToFloat(first.xyz) - p_world;
  vec3 p = R_camera_world * toward;
  vec4 tone = bytesOf(first.w) / 255.0;
  float opacity = tone.a;
  if (!(p.z >= NEAR) || opacity < ALPHA_MIN) return;
  // Principal axes in camera axes as columns; their first two rows become those of J A
  vec4 shape = bytesOf(second.y);
  mat3 A = R_camera_world * rotationOf(second.x);
  vec3 scales = exp(shape.xyz / 16.0 - 10.0);
  vec3 row_x = vec3(A[0].x, A[1].x, A[2].x) * scales;
  vec3 row_y = vec3(A[0].y, A[1].y, A[2].y) * scales;
  vec3 row_z = vec3(A[0].z, A[1].z, A[2].z) * scales;
  float per_z = 1.0 / p.z;
  vec2 limit = (0.5 + 0.5 * MARGIN) * size / focal;
  vec2 slope = clamp(p.xy * per_z, -limit, limit);
  vec3 row_u = focal * per_z * (row_x - slope.x * row_z);
  vec3 row_v = focal * per_z * (row_y - slope.y * row_z);
  // Covariance in the image with the blur, and its determinant without cancellation
  vec3 normal = cross(row_u, row_v);
  float uu = dot(row_u, row_u), uv = dot(row_u, row_v), vv = dot(row_v, row_v);
  float det = dot(normal, normal) + BLUR * (uu + vv) + BLUR * BLUR;
  uu += BLUR;
  vv += BLUR;
  // Standard deviations along the axes of the ellipse
  float radius = length(vec2(0.5 * (uu - vv), uv));
  float large = 0.5 * (uu + vv) + radius;
  vec2 axis = uu >= vv ? vec2(large - vv, uv) : vec2(uv, large - uu);
  axis = radius > 1e-6 * large ? normalize(axis) : vec2(1.0, 0.0);
  float extent = sqrt(2.0 * log(255.0 * opacity));
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1 & 1) * 2.0 - 1.0;
  offset = corner * extent;
  vec2 d = offset.x * sqrt(large) * axis + offset.y * sqrt(det / large) * vec2(-axis.y, axis.x);
  vec2 pixel = focal * per_z * p.xy + d;  // from the middle of the image, down positive
  // The quad lies in the plane of the mean depth given the pixel, so a floor passes under a wheel
  vec2 c = vec2(dot(row_u, row_z), dot(row_v, row_z));
  float deeper = dot(vec2(vv * c.x - uv * c.y, uu * c.y - uv * c.x), d) / det;
  float depth = -DEPTH_NEAR * (per_z - deeper * per_z * per_z);
  gl_Position = vec4(2.0 * pixel.x / size.x, -2.0 * pixel.y / size.y, clamp(depth, -1.0, 1.0), 1.0);
  // Colour 1/2 + sum of harmonics of degree 0 and 1
  vec3 direction = normalize(toward);
  vec4 h = bytesOf(second.z), k = bytesOf(second.w);
  mat3 rest = (mat3(shape.w, h.xyz, h.w, k) - mat3(128.0, 128.0, 128.0, 128.0, 128.0, 128.0, 128.0,
    128.0, 128.0)) / 128.0;
  vec3 rgb = 0.5 + 0.28209479 * (tone.rgb - 0.5) / 0.15
    + 0.48860251 * (rest * vec3(-direction.y, direction.z, -direction.x));
  colour = vec4(max(rgb, 0.0), opacity);
}`;

const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
in vec2 offset;
flat in vec4 colour;
out vec4 pixel;
void main() {
  float alpha = colour.a * exp(-0.5 * dot(offset, offset));
  if (alpha < 1.0 / 255.0) discard;
  alpha = min(alpha, 0.999);
  pixel = vec4(colour.rgb * alpha, alpha);
}`;

const BOX_VERTEX = `#version 300 es
precision highp float;
uniform mat4 T_camera_body;
uniform mat3 R_world_body;
uniform vec2 lens;      // 2 f / width, -2 f / height
uniform vec4 paint;     // red, green, blue; with paint.a = 0 the boxes' own colours
in vec3 position;
in vec3 normal;
in vec3 own;
out vec3 shade;
void main() {
  vec3 p = (T_camera_body * vec4(position, 1.0)).xyz;
  gl_Position = vec4(lens * p.xy, -${DEPTH_NEAR}, p.z);
  vec3 n = R_world_body * normal;
  shade = mix(own, paint.rgb, paint.a) * (0.74 + 0.22 * n.z + 0.04 * n.x);
}`;

// One triangle over the whole image: the picture in half precision -> the canvas, cut to 0..1.
const COPY_VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`;

const COPY_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D picture;
out vec4 pixel;
void main() {
  pixel = vec4(texelFetch(picture, ivec2(gl_FragCoord.xy), 0).rgb, 1.0);
}`;

const BOX_FRAGMENT = `#version 300 es
precision highp float;
uniform float opacity;
in vec3 shade;
out vec4 pixel;
void main() {
  pixel = vec4(shade * opacity, opacity);
}`;

// Runs in a worker, from its own source: it may use nothing from outside. First it receives the
// places (x, y, z of each) and radii, then views; it answers with the indices of those in or near
// the view, farthest first: a counting sort by 16 bits of depth.
export function sortSplatsWorker(scope) {
  let places = null;
  let radii = null;
  let depths = null;
  let keys = null;
  const counts = new Uint32Array(65536);
  scope.onmessage = ({ data }) => {
    if (data.places) {
      ({ places, radii } = data);
      depths = new Float32Array(radii.length);
      keys = new Uint16Array(radii.length);
      return;
    }
    const begin = performance.now();
    const { near, limits, length, spare } = data;
    const [xx, xy, xz, x0, yx, yy, yz, y0, zx, zy, zz, z0] = data.view; // rows of T_camera_world
    const [limit_u, limit_v] = limits; // of x/z and y/z
    const [slant_u, slant_v] = limits.map((limit) => Math.hypot(1, limit));
    let farthest = near;
    for (let i = 0, k = 0; i < depths.length; i += 1, k += 3) {
      const [x, y, z] = [places[k], places[k + 1], places[k + 2]];
      const depth = zx * x + zy * y + zz * z + z0;
      depths[i] = 0;
      if (depth < near) continue;
      const u = Math.abs(xx * x + xy * y + xz * z + x0) - limit_u * depth;
      const v = Math.abs(yx * x + yy * y + yz * z + y0) - limit_v * depth;
      if (u > slant_u * radii[i] || v > slant_v * radii[i]) continue;
      depths[i] = depth;
      if (depth > farthest) farthest = depth;
    }
    counts.fill(0);
    const scale = 65535 / Math.max(farthest - near, 1e-9);
    for (let i = 0; i < depths.length; i += 1) {
      if (depths[i] > 0) {
        keys[i] = 65535 - (depths[i] - near) * scale;
        counts[keys[i]] += 1;
      }
    }
    let count = 0;
    for (let key = 0; key < 65536; key += 1) {
      const here = counts[key];
      counts[key] = count;
      count += here;
    }
    const order = spare ?? new Uint32Array(length);
    // backwards, so that of equal depths the first is drawn last and lies in front, as in fast.py
    for (let i = depths.length - 1; i >= 0; i -= 1) {
      if (depths[i] > 0) {
        order[counts[keys[i]]] = i;
        counts[keys[i]] += 1;
      }
    }
    scope.postMessage({ order, count, ms: performance.now() - begin }, [order.buffer]);
  };
}

// An SPZ, packed by gzip or already unpacked -> {count, codes for the texture, places, radii}.
// The axes stay those of SPZ, x right, y up, z back; the camera is turned instead.
export async function readSpz(buffer) {
  let bytes = new Uint8Array(buffer);
  if (bytes[0] === 0x1f && bytes[1] === 0x8b) {
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  }
  const header = bytes.length >= 16 ? new DataView(bytes.buffer, bytes.byteOffset, 16) : null;
  if (!header || header.getUint32(0, true) !== SPZ_MAGIC || header.getUint32(4, true) !== 3) {
    throw new Error("scene: expected an SPZ of version 3, got other bytes; load the page again");
  }
  const [count, degree, bits] = [header.getUint32(8, true), bytes[12], bytes[13]];
  const rest = [0, 9, 24, 45][degree];
  if (rest === undefined || count < 1 || count > MAX_SPLATS || bytes.length !== 16 + count * (20 + rest)) {
    throw new Error(`scene: expected a whole SPZ, got ${bytes.length} bytes for ${count} Gaussians;`
      + " load the page again");
  }
  const starts = [9, 1, 3, 3, 4].reduce((list, width) => [...list, list.at(-1) + count * width], [16]);
  const [positions, opacities, colours, scales, rotations, harmonics] = starts;
  const codes = new Uint8Array(TEXTURE_WIDTH * Math.ceil((2 * count) / TEXTURE_WIDTH) * 16);
  const floats = new Float32Array(codes.buffer);
  const [places, radii] = [new Float32Array(3 * count), new Float32Array(count)];
  const deviations = Float32Array.from({ length: 256 }, (_, code) => Math.exp(code / 16 - 10));
  const step = 2 ** -bits;
  for (let i = 0; i < count; i += 1) {
    for (let axis = 0; axis < 3; axis += 1) {
      const k = positions + 9 * i + 3 * axis;
      // shifted up and down again, the third byte's sign fills the word
      const fixed = ((bytes[k] << 8) | (bytes[k + 1] << 16) | (bytes[k + 2] << 24)) >> 8;
      places[3 * i + axis] = fixed * step;
      floats[8 * i + axis] = fixed * step;
    }
    const to = 32 * i;
    for (let k = 0; k < 3; k += 1) {
      codes[to + 12 + k] = bytes[colours + 3 * i + k];
      codes[to + 20 + k] = bytes[scales + 3 * i + k];
    }
    radii[i] = REACH * deviations[Math.max(codes[to + 20], codes[to + 21], codes[to + 22])];
    codes[to + 15] = bytes[opacities + i];
    for (let k = 0; k < 4; k += 1) codes[to + 16 + k] = bytes[rotations + 4 * i + k];
    // harmonics of degree 1 only: higher ones change little and would double the texture
    for (let k = 0; k < 9; k += 1) codes[to + 23 + k] = rest ? bytes[harmonics + rest * i + k] : 128;
  }
  return { count, codes: new Uint32Array(codes.buffer), places, radii };
}

// Whether the browser draws without a GPU: even with the fewest pixels a frame of the hall takes a
// second, so it begins with those.
export function drawsInSoftware(gl) {
  const names = gl.getExtension("WEBGL_debug_renderer_info");
  return SOFTWARE.test(gl.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
}

export class SplatView {
  // background: "#rrggbb" or [red, green, blue] 0..1; onstatus(text): a sentence for the reader, ""
  // when all is well again; keep: true keeps each picture readable and always in full resolution,
  // for tests and screenshots.
  constructor(canvas, { background = [0, 0, 0], onstatus = () => {}, keep = false } = {}) {
    this.canvas = canvas;
    this.background = typeof background === "string" ? colourFromText(background) : background;
    this.keep = keep;
    this.onstatus = onstatus;
    this.gl = canvas.getContext("webgl2", {
      alpha: false, antialias: false, depth: false, preserveDrawingBuffer: keep,
      powerPreference: "high-performance",
    });
    if (!this.gl) throw new Error("This browser has no WebGL2; the page shows pictures instead.");
    this.scene = null;
    this.aircraft = [];
    this.stats = { fps: 0, sortMs: 0, frameMs: 0, share: 1 };
    const step = !keep && drawsInSoftware(this.gl) ? SHARES.length - 1 : 0;
    this.pace = { step, frames: 0, sum: 0, raises: 0, before: 0 };
    this.order = { count: 0, indices: null, fresh: false };
    this.sorting = { worker: null, busy: false, view: null, waiting: [] };
    this.lastDraw = 0;
    this.last = null;
    this.next = null; // a view that waits for its order
    this.frame = null; // {fence, begin} of the frame that is being drawn, and while it rests after it
    this.shown = ""; // what the newest frame shows, as a text
    this.isHallSeen = false; // whether a frame with the hall in it is done
    this.lost = false;
    this.onlost = (event) => {
      event.preventDefault();
      this.lost = true;
      this.next = null;
      this.frame = null;
      this.onstatus("The browser took the graphics away from this page; it waits for them.");
    };
    this.onrestored = () => {
      this.lost = false;
      this.build();
      this.onstatus("");
      this.drawLater();
    };
    canvas.addEventListener("webglcontextlost", this.onlost);
    canvas.addEventListener("webglcontextrestored", this.onrestored);
    this.observer = new ResizeObserver(() => {
      this.measure();
      this.drawLater();
    });
    this.observer.observe(canvas);
    this.measure();
    this.build();
  }

  static supported() {
    try {
      const gl = document.createElement("canvas").getContext("webgl2");
      gl?.getExtension("WEBGL_lose_context")?.loseContext();
      return gl !== null;
    } catch {
      return false;
    }
  }

  get count() {
    return this.scene ? this.scene.count : 0;
  }

  get ready() {
    return this.scene !== null && !this.lost;
  }

  // onprogress(bytes so far, bytes in all); both as unpacked by the browser, so the second is null
  // where the server sends them packed.
  async load(url, onprogress = () => {}) {
    const answer = await fetch(url);
    if (!answer.ok) throw new Error(`scene: expected ${url}, got the answer ${answer.status}`);
    const packed = answer.headers.get("Content-Encoding");
    const total = packed ? null : Number(answer.headers.get("Content-Length")) || null;
    const parts = [];
    let size = 0;
    for (const reader = answer.body.getReader(); ;) {
      const { done, value } = await reader.read();
      if (done) break;
      parts.push(value);
      size += value.length;
      onprogress(size, total);
    }
    await this.loadBytes(await new Blob(parts).arrayBuffer());
  }

  async loadBytes(buffer) {
    this.scene = await readSpz(buffer);
    this.upload();
    const source = `(${sortSplatsWorker})(self)`;
    const url = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
    this.sorting.worker?.terminate();
    this.sorting = { worker: new Worker(url), busy: false, view: null, waiting: [] };
    URL.revokeObjectURL(url);
    this.order = { count: 0, indices: null, fresh: false };
    const { worker } = this.sorting;
    worker.onmessage = ({ data }) => this.takeOrder(data);
    worker.onerror = () => this.onstatus("The browser does not run the worker that sorts the hall.");
    const { places, radii } = this.scene;
    worker.postMessage({ places, radii }, [places.buffer, radii.buffer]);
    this.scene.places = null;
    this.scene.radii = null;
  }

  // list: [{T_world_body: row-major 4 x 4, color: "#rrggbb" or null, opacity: 0..1}]
  setAircraft(list) {
    this.aircraft = list;
  }

  // Draw one frame from a camera (row-major 4 x 4, "world from camera"); nothing if it is shown.
  draw(T_world_camera, { fovDeg = 70 } = {}) {
    this.last = [T_world_camera, { fovDeg }]; // drawn when the graphics are back
    if (this.lost) return;
    if (this.next || this.frame) return; // it waits for an order or a frame, and then draws the last view
    this.fit();
    this.askForOrder(T_world_camera, fovDeg);
    if (!this.keep && !this.order.fresh && this.shown === this.describe(T_world_camera, fovDeg)) return;
    if (this.sorting.busy && !this.keep && this.hasTurned(T_world_camera)) this.next = this.last;
    else this.paint(T_world_camera, fovDeg);
  }

  // What a frame depends on besides the scene and its order.
  describe(T, fovDeg) {
    return JSON.stringify([T, fovDeg, this.aircraft, this.wanted]);
  }

  // Whether a view has left the margin around the one that the newest order belongs to.
  hasTurned(T) {
    const O = this.order.T;
    if (!O) return false; // nothing to draw yet
    const across = O[2] * T[2] + O[6] * T[6] + O[10] * T[10];
    const moved = Math.hypot(O[3] - T[3], O[7] - T[7], O[11] - T[11]);
    return across < Math.cos(MAX_TURN) || moved > MAX_MOVE;
  }

  // The picture of a view, with the newest order.
  paint(T, fovDeg) {
    const begin = performance.now();
    const { gl } = this;
    const [width, height] = [this.canvas.width, this.canvas.height];
    const focal = (0.5 * width) / Math.tan((fovDeg * Math.PI) / 360);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.framebuffer);
    gl.viewport(0, 0, width, height);
    gl.colorMask(true, true, true, true);
    gl.depthMask(true);
    gl.clearColor(...this.background, 1);
    gl.clearDepth(1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.disable(gl.BLEND);
    const lens = [(2 * focal) / width, (-2 * focal) / height];
    const isSolid = ({ opacity = 1 }) => opacity >= 1;
    for (const one of this.aircraft.filter(isSolid)) this.drawBoxes(one, T, lens);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA); // colours are multiplied by their alpha
    this.drawSplats(T, [width, height], focal);
    for (const one of this.aircraft.filter((other) => !isSolid(other))) {
      // its depth first, so that of several boxes behind each other only the nearest is drawn
      gl.colorMask(false, false, false, false);
      gl.depthMask(true);
      this.drawBoxes(one, T, lens);
      gl.colorMask(true, true, true, true);
      this.drawBoxes(one, T, lens);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    gl.useProgram(this.copy.program);
    gl.bindVertexArray(this.copy.vertices);
    gl.bindTexture(gl.TEXTURE_2D, this.target.colour);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    if (this.keep) {
      this.countFrame(begin, performance.now() - begin);
      return;
    }
    if (gl.isContextLost()) return; // the event that says so comes later
    this.shown = this.describe(T, fovDeg);
    const hasHall = this.order.count > 0;
    this.frame = { begin, hasHall, fence: gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0) };
    gl.flush();
    this.watch(this.frame);
  }

  // Wait until a frame is done. Without this the browser takes further frames, and everything else
  // on the page waits for all of them: half a minute, where a frame takes seconds.
  watch(frame) {
    if (frame !== this.frame) return; // the graphics are lost
    const { gl } = this;
    const took = Math.min(performance.now() - frame.begin, LONGEST_MS);
    if (gl.getSyncParameter(frame.fence, gl.SYNC_STATUS) !== gl.SIGNALED && took < LONGEST_MS) {
      setTimeout(() => this.watch(frame), POLL_MS);
      return;
    }
    gl.deleteSync(frame.fence);
    this.isHallSeen ||= frame.hasHall;
    this.countFrame(frame.begin, took);
    const goOn = () => {
      if (frame !== this.frame) return;
      this.frame = null;
      this.draw(...this.last);
    };
    if (took > SLOW_MS) setTimeout(goOn, REST * took);
    else goOn();
  }

  // Draw with the order that belongs to this very view: for a still picture.
  async drawSorted(T_world_camera, options = {}) {
    const { sorting } = this;
    const answer = async () => {
      while (sorting.busy) await new Promise((resolve) => sorting.waiting.push(resolve));
    };
    await answer(); // to an earlier view
    this.fit();
    this.askForOrder(T_world_camera, options.fovDeg);
    await answer();
    this.draw(T_world_camera, options);
  }

  dispose() {
    this.observer.disconnect();
    this.canvas.removeEventListener("webglcontextlost", this.onlost);
    this.canvas.removeEventListener("webglcontextrestored", this.onrestored);
    this.sorting.worker?.terminate();
    this.sorting.worker = null;
    this.sorting.busy = false;
    for (const resolve of this.sorting.waiting.splice(0)) resolve();
    this.lost = true;
    this.frame = null;
    // given back now, since browsers allow few: the canvas cannot be drawn on again
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }

  drawSplats(T, size, focal) {
    // From SPZ's axes, world after half a turn about x, to the camera's
    const R = [T[0], -T[4], -T[8], T[1], -T[5], -T[9], T[2], -T[6], -T[10]]; // row by row
    const p = [T[3], -T[7], -T[11]];
    const { gl, splats, order } = this;
    if (!order.indices) return;
    gl.useProgram(splats.program);
    gl.bindVertexArray(splats.vertices);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, splats.order);
    if (order.fresh) {
      const rows = Math.ceil(order.count / TEXTURE_WIDTH);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXTURE_WIDTH, rows, gl.RED_INTEGER,
        gl.UNSIGNED_INT, order.indices);
      order.fresh = false;
    }
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, splats.codes);
    gl.uniform1i(splats.at.order, 1);
    gl.uniformMatrix3fv(splats.at.R_camera_world, true, R);
    gl.uniform3fv(splats.at.p_world, p);
    gl.uniform2fv(splats.at.size, size);
    gl.uniform1f(splats.at.focal, focal);
    gl.depthMask(false);
    gl.drawElements(gl.TRIANGLES, 6 * order.count, gl.UNSIGNED_INT, 0);
  }

  drawBoxes({ T_world_body, color = null, opacity = 1 }, T, lens) {
    const { gl, boxes } = this;
    const B = T_world_body;
    const toCamera = new Float32Array(16).fill(0);
    toCamera[15] = 1;
    for (let row = 0; row < 3; row += 1) {
      for (let column = 0; column < 4; column += 1) {
        for (let k = 0; k < 3; k += 1) {
          const from = B[4 * k + column] - (column === 3 ? T[4 * k + 3] : 0);
          toCamera[4 * row + column] += T[4 * k + row] * from;
        }
      }
    }
    gl.useProgram(boxes.program);
    gl.bindVertexArray(boxes.vertices);
    gl.uniformMatrix4fv(boxes.at.T_camera_body, true, toCamera);
    gl.uniformMatrix3fv(boxes.at.R_world_body, true,
      [B[0], B[1], B[2], B[4], B[5], B[6], B[8], B[9], B[10]]);
    gl.uniform2fv(boxes.at.lens, lens);
    gl.uniform4fv(boxes.at.paint, color ? [...colourFromText(color), 1] : [0, 0, 0, 0]);
    gl.uniform1f(boxes.at.opacity, opacity);
    gl.drawArrays(gl.TRIANGLES, 0, boxes.count);
  }

  // Ask the worker for the order of this view, if it moved and the worker is idle.
  askForOrder(T, fovDeg = 70) {
    const { sorting } = this;
    const view = [0, 1, 2].flatMap((k) => {
      const [x, y, z] = [T[k], -T[4 + k], -T[8 + k]]; // an axis of the camera, in SPZ's axes
      return [x, y, z, -(x * T[3] - y * T[7] - z * T[11])];
    });
    const limit = VIEW_MARGIN * Math.tan((fovDeg * Math.PI) / 360);
    const limits = [limit, (limit * this.canvas.height) / this.canvas.width];
    const numbers = [...view, ...limits];
    const moved = !sorting.view || numbers.some((value, i) => Math.abs(value - sorting.view[i]) > 1e-5);
    if (!sorting.worker || sorting.busy || !moved) return;
    sorting.busy = true;
    sorting.view = numbers;
    sorting.T = T;
    const { spare } = this.order;
    this.order.spare = null;
    const length = TEXTURE_WIDTH * Math.ceil(this.count / TEXTURE_WIDTH); // whole rows of a texture
    const request = { view, limits, near: SPLAT_NEAR, length, spare };
    sorting.worker.postMessage(request, spare ? [spare.buffer] : []);
  }

  takeOrder({ order, count, ms }) {
    const { sorting } = this;
    this.order = { count, indices: order, fresh: true, spare: this.order.indices, T: sorting.T };
    this.stats.sortMs = ms;
    sorting.busy = false;
    for (const resolve of sorting.waiting.splice(0)) resolve();
    if (this.next && !this.lost) {
      const [T, { fovDeg }] = this.next;
      this.next = null;
      this.fit();
      this.paint(T, fovDeg);
    }
    this.drawLater();
  }

  // Draw the last view again, unless the page does so by itself: a page that stands still.
  drawLater() {
    const { lastDraw } = this;
    setTimeout(() => {
      if (this.last && !this.lost && this.lastDraw === lastDraw) this.draw(...this.last);
    }, 100);
  }

  measure() {
    this.stats.share = SHARES[this.pace.step];
    const ratio = Math.min(window.devicePixelRatio || 1, MAX_PIXEL_RATIO) * this.stats.share;
    const box = this.canvas.getBoundingClientRect();
    this.wanted = [box.width, box.height].map((side) => Math.max(1, Math.round(side * ratio)));
  }

  // The size of the canvas and of the picture behind it, half-precision where there is such: with
  // 8 bits, hundreds of faint splats over each other would each be rounded.
  fit() {
    const { gl, canvas, wanted } = this;
    const [width, height] = wanted;
    if (this.target && canvas.width === width && canvas.height === height) return;
    [canvas.width, canvas.height] = wanted;
    this.freeTarget();
    const half = gl.getExtension("EXT_color_buffer_half_float") ?? gl.getExtension("EXT_color_buffer_float");
    const framebuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    const colour = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, colour);
    this.sampleNearest();
    gl.texStorage2D(gl.TEXTURE_2D, 1, half ? gl.RGBA16F : gl.RGBA8, width, height);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, colour, 0);
    const depth = gl.createRenderbuffer();
    gl.bindRenderbuffer(gl.RENDERBUFFER, depth);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, depth);
    this.target = { framebuffer, colour, depth };
  }

  freeTarget() {
    const { gl, target } = this;
    if (!target) return;
    gl.deleteTexture(target.colour);
    gl.deleteRenderbuffer(target.depth);
    gl.deleteFramebuffer(target.framebuffer);
    this.target = null;
  }

  sampleNearest() {
    const { gl } = this;
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
      gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    }
  }

  // Programs and buffers; again after the browser restored a lost context.
  build() {
    const { gl } = this;
    this.target = null;
    this.shown = "";
    this.splats = this.program(SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.splats.vertices = gl.createVertexArray();
    this.splats.quads = gl.createBuffer();
    this.splats.codes = gl.createTexture();
    this.splats.order = gl.createTexture();

    this.boxes = this.program(BOX_VERTEX, BOX_FRAGMENT);
    this.boxes.vertices = gl.createVertexArray();
    const triangles = boxTriangles(AIRCRAFT_BOXES);
    this.boxes.count = triangles.length / 9;
    gl.bindVertexArray(this.boxes.vertices);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, triangles, gl.STATIC_DRAW);
    ["position", "normal", "own"].forEach((name, k) => {
      const place = gl.getAttribLocation(this.boxes.program, name);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 36, 12 * k);
    });
    this.copy = this.program(COPY_VERTEX, COPY_FRAGMENT);
    this.copy.vertices = gl.createVertexArray();
    gl.bindVertexArray(null);
    if (this.scene) this.upload();
  }

  // The scene's codes and room for the order as textures; two triangles for each four vertices. One
  // long list of triangles: thousands of instances of a quad are slow on several drivers.
  upload() {
    const { gl, splats, scene } = this;
    this.shown = "";
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, splats.codes);
    this.sampleNearest();
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, TEXTURE_WIDTH,
      scene.codes.length / (4 * TEXTURE_WIDTH), 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT, scene.codes);
    gl.bindTexture(gl.TEXTURE_2D, splats.order);
    this.sampleNearest();
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32UI, TEXTURE_WIDTH,
      Math.ceil(scene.count / TEXTURE_WIDTH), 0, gl.RED_INTEGER, gl.UNSIGNED_INT, null);
    const quads = new Uint32Array(6 * scene.count);
    for (let k = 0, vertex = 0; k < quads.length; k += 6, vertex += 4) {
      quads[k] = vertex;
      quads[k + 1] = vertex + 1;
      quads[k + 2] = vertex + 2;
      quads[k + 3] = vertex + 1;
      quads[k + 4] = vertex + 2;
      quads[k + 5] = vertex + 3;
    }
    gl.bindVertexArray(splats.vertices);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, splats.quads);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, quads, gl.STATIC_DRAW);
    this.order.fresh = this.order.indices !== null;
  }

  // A linked program with the places of its uniforms by name.
  program(vertex, fragment) {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      gl.deleteShader(shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      const why = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
      throw new Error(`The graphics driver refused the page's program: ${why.join(" ")}`);
    }
    const at = {};
    for (let k = 0; k < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); k += 1) {
      const { name } = gl.getActiveUniform(program, k);
      at[name] = gl.getUniformLocation(program, name);
    }
    return { program, at };
  }

  // Frames a second, and milliseconds a frame from its begin until it is drawn, averaged over some
  // twenty frames.
  countFrame(begin, took) {
    const { stats } = this;
    const smooth = (old, now) => (old > 0 ? old + 0.05 * (now - old) : now);
    stats.frameMs = smooth(stats.frameMs, took);
    const gap = begin - this.lastDraw;
    const isPause = this.lastDraw === 0 || gap > Math.max(1000, 2 * took); // nothing was to be drawn
    if (!isPause) stats.fps = 1000 / smooth(stats.fps > 0 ? 1000 / stats.fps : 0, Math.max(gap, took));
    this.lastDraw = begin;
    if (!this.keep && document.visibilityState === "visible") this.keepPace(took);
  }

  // Fewer pixels on a machine that is slow, and more again on one that was slow for a moment.
  keepPace(took) {
    const { pace } = this;
    const isStuck = Math.min(took, pace.before) > STUCK_MS;
    pace.before = took;
    pace.frames += 1;
    pace.sum += Math.min(took, STUCK_MS); // one long frame, as of a page that was asleep, changes nothing
    if (pace.frames < PACE_FRAMES && !isStuck) return;
    const mean = pace.sum / pace.frames;
    [pace.frames, pace.sum] = [0, 0];
    if ((mean > SLOW_MS || isStuck) && pace.step < SHARES.length - 1) {
      pace.step = isStuck ? SHARES.length - 1 : pace.step + 1;
      this.measure();
    } else if (mean < QUICK_MS && pace.step > 0 && pace.raises < MAX_RAISES) {
      pace.step -= 1;
      pace.raises += 1;
      this.measure();
    }
  }
}
