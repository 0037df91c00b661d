// Cameras: poses of an aircraft -> poses of cameras, as row-major 4 x 4 matrices "world from ...".
//
// Axes as in core/frames.py: world x along the runway, y left, z up; body x nose, y right wing,
// z belly; camera x right, y down, z forward. A pose is six numbers x, y, z [m], roll, pitch, yaw
// [rad], or already such a matrix.

export function poseMatrix(x, y, z, roll, pitch, yaw) {
  // R_world_body = diag(1, -1, -1) Rz(yaw) Ry(pitch) Rx(roll)
  const [sr, cr, sp, cp, sy, cy] = [
    Math.sin(roll), Math.cos(roll), Math.sin(pitch), Math.cos(pitch), Math.sin(yaw), Math.cos(yaw),
  ];
  return Float64Array.of(
    cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy, x,
    -cp * sy, -sr * sp * sy - cr * cy, -cr * sp * sy + sr * cy, y,
    sp, -sr * cp, -cr * cp, z,
    0, 0, 0, 1,
  );
}

export function asPoseMatrix(pose) {
  return pose.length === 16 ? pose : poseMatrix(...pose);
}

export function multiplyPoses(T_a_b, T_b_c) {
  const T_a_c = new Float64Array(16);
  for (let row = 0; row < 4; row += 1) {
    for (let column = 0; column < 4; column += 1) {
      for (let k = 0; k < 4; k += 1) {
        T_a_c[4 * row + column] += T_a_b[4 * row + k] * T_b_c[4 * k + column];
      }
    }
  }
  return T_a_c;
}

// A camera along the nose at `mount`: [x, y, z] in body axes [m], or
// {p_body_camera: [x, y, z], pitch_deg: positive nose up}.
export function noseCamera(pose, mount = [0, 0, 0]) {
  const [x, y, z] = mount.p_body_camera ?? mount;
  const pitch = ((mount.pitch_deg ?? 0) * Math.PI) / 180;
  const [s, c] = [Math.sin(pitch), Math.cos(pitch)];
  // The columns are the camera's right, down and forward in body axes.
  const T_body_camera = Float64Array.of(0, s, c, x, 1, 0, 0, y, 0, c, -s, z, 0, 0, 0, 1);
  return multiplyPoses(asPoseMatrix(pose), T_body_camera);
}

// A camera behind and above the aircraft that keeps its course but not its bank, inside the hall.
export function chaseCamera(pose, { behind = 2.6, above = 0.75, ahead = 1.2, hall = null } = {}) {
  const T = asPoseMatrix(pose);
  const level = Math.hypot(T[0], T[4]);
  const [cx, cy] = level > 1e-6 ? [T[0] / level, T[4] / level] : [1, 0];
  const place = [T[3] - behind * cx, T[7] - behind * cy, T[11] + above];
  return lookAt(holdInside(place, hall), [T[3] + ahead * cx, T[7] + ahead * cy, T[11]]);
}

// A camera that stands at `place` [m] in the world and turns with the aircraft.
export function towerCamera(pose, place = [-6, 6.5, 3.2]) {
  const T = asPoseMatrix(pose);
  return lookAt(place, [T[3], T[7], T[11]]);
}

// A camera at `place` that looks at `target`, its right edge level; straight down x of the world
// where the target is right above or below, and along it where both are the same.
export function lookAt(place, target) {
  let forward = target.map((value, i) => value - place[i]);
  const distance = Math.hypot(...forward);
  forward = distance > 1e-9 ? forward.map((value) => value / distance) : [1, 0, 0];
  const level = Math.hypot(forward[0], forward[1]);
  const [rx, ry] = level > 1e-9 ? [forward[1] / level, -forward[0] / level] : [0, -1];
  const [fx, fy, fz] = forward;
  const down = [fy * 0 - fz * ry, fz * rx - fx * 0, fx * ry - fy * rx]; // forward x right
  return Float64Array.of(
    rx, down[0], fx, place[0],
    ry, down[1], fy, place[1],
    0, down[2], fz, place[2],
    0, 0, 0, 1,
  );
}

// The pose a share s of the way from a to b: positions on a line, attitudes along the shortest turn.
export function interpolatePoses(a, b, s) {
  const [T_a, T_b] = [asPoseMatrix(a), asPoseMatrix(b)];
  const [q, r] = [quaternionFromMatrix(T_a), quaternionFromMatrix(T_b)];
  let cosine = q.reduce((sum, value, i) => sum + value * r[i], 0);
  const sign = cosine < 0 ? -1 : 1;
  cosine = Math.min(1, cosine * sign);
  const angle = Math.acos(cosine);
  const [from, to] = angle > 1e-6
    ? [Math.sin((1 - s) * angle) / Math.sin(angle), Math.sin(s * angle) / Math.sin(angle)]
    : [1 - s, s];
  const T = matrixFromQuaternion(q.map((value, i) => from * value + to * sign * r[i]));
  for (const i of [3, 7, 11]) T[i] = (1 - s) * T_a[i] + s * T_b[i];
  return T;
}

export function holdInside(place, hall, margin = 0.3) {
  if (!hall) return place;
  const bounds = [hall.x, hall.y, hall.z];
  return place.map((value, i) => (
    Math.min(Math.max(value, bounds[i][0] + margin), bounds[i][1] - margin)
  ));
}

// w, x, y, z of a rotation, by its largest component, so that no small number divides.
export function quaternionFromMatrix(T) {
  const [xx, yy, zz] = [T[0], T[5], T[10]];
  const squares = [1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz];
  const largest = squares.indexOf(Math.max(...squares));
  const [yz, zx, xy] = [T[9] - T[6], T[2] - T[8], T[4] - T[1]];
  const [sum_yz, sum_zx, sum_xy] = [T[9] + T[6], T[2] + T[8], T[4] + T[1]];
  const rows = [
    [squares[0], yz, zx, xy], [yz, squares[1], sum_xy, sum_zx],
    [zx, sum_xy, squares[2], sum_yz], [xy, sum_zx, sum_yz, squares[3]],
  ];
  const scale = 0.5 / Math.sqrt(squares[largest]);
  return rows[largest].map((value) => value * scale);
}

export function matrixFromQuaternion(quaternion) {
  const length = Math.hypot(...quaternion);
  const [w, x, y, z] = quaternion.map((value) => value / length);
  return Float64Array.of(
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 0,
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), 0,
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), 0,
    0, 0, 0, 1,
  );
}
