// Aircraft: its boxes in body axes (x nose, y right wing, z belly) -> triangles to draw.

// Colour, size and centre [m] of each box: the same as aircraft_boxes.py, which a test compares.
export const AIRCRAFT_BOXES = [
  [[238, 238, 234], [0.240, 0.065, 0.075], [0.030, 0.0, 0.0]],
  [[238, 238, 234], [0.220, 0.035, 0.040], [-0.180, 0.0, -0.010]],
  [[205, 55, 50], [0.055, 0.060, 0.065], [0.175, 0.0, 0.0]],
  [[238, 238, 234], [0.115, 0.700, 0.014], [0.030, 0.0, -0.045]],
  [[205, 55, 50], [0.117, 0.090, 0.016], [0.030, -0.27, -0.045]],
  [[205, 55, 50], [0.117, 0.090, 0.016], [0.030, 0.27, -0.045]],
  [[48, 76, 160], [0.117, 0.050, 0.016], [0.030, -0.15, -0.045]],
  [[48, 76, 160], [0.117, 0.050, 0.016], [0.030, 0.15, -0.045]],
  [[238, 238, 234], [0.075, 0.220, 0.010], [-0.270, 0.0, -0.020]],
  [[48, 76, 160], [0.080, 0.012, 0.100], [-0.275, 0.0, -0.070]],
  [[50, 50, 52], [0.006, 0.012, 0.190], [0.206, 0.0, 0.0]],
  [[50, 50, 52], [0.050, 0.016, 0.050], [0.050, -0.08, 0.085]],
  [[50, 50, 52], [0.050, 0.016, 0.050], [0.050, 0.08, 0.085]],
  [[50, 50, 52], [0.014, 0.160, 0.010], [0.050, 0.0, 0.060]],
];

// Nine numbers a vertex: position [m], outward normal, colour 0..1; 36 vertices a box.
export function boxTriangles(boxes) {
  const rows = [];
  for (const [colour, size, centre] of boxes) {
    for (let axis = 0; axis < 3; axis += 1) {
      for (const side of [-1, 1]) {
        for (const [a, b] of [[-1, -1], [1, -1], [1, 1], [-1, -1], [1, 1], [-1, 1]]) {
          const at = [0, 0, 0];
          const normal = [0, 0, 0];
          at[axis] = side;
          at[(axis + 1) % 3] = a;
          at[(axis + 2) % 3] = b;
          normal[axis] = side;
          const corner = at.map((value, i) => centre[i] + (value * size[i]) / 2);
          rows.push(...corner, ...normal, ...colour.map((value) => value / 255));
        }
      }
    }
  }
  return Float32Array.from(rows);
}

// "#rrggbb" -> three numbers 0..1.
export function colourFromText(text) {
  return [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16) / 255);
}
