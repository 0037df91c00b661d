// Movements of a gamepad, asked for one by one -> which of its axes is which stick, and which way round.

import { STICK_MODES, movedAxis } from "./sticks.js";

const ASSIGN_STEPS = [
  "Push the LEFT stick to the RIGHT.",
  "Pull the LEFT stick BACK, towards you.",
  "Push the RIGHT stick to the RIGHT.",
  "Pull the RIGHT stick BACK, towards you.",
];
const ASSIGN_POLL_MS = 50;
const ASSIGN_REST = 0.3; // travel below which a stick has been let go
const ASSIGN_LIMIT_MS = 30000;

/** The first gamepad's axes now; null without one. */
export function gamepadAxes() {
  const all = navigator.getGamepads ? Array.from(navigator.getGamepads()) : [];
  const pad = all.find((one) => one && one.connected !== false && one.axes.length >= 2);
  return pad ? [...pad.axes] : null;
}

/**
 * Ask for four movements; `say(text)` shows what to do. Resolves to the change of the settings
 * {axes, reversed}, or to null where the gamepad is missing or nothing moves for half a minute.
 */
export async function assignGamepad(mode, say) {
  const pause = () => new Promise((resolve) => setTimeout(resolve, ASSIGN_POLL_MS));
  const rest = gamepadAxes();
  if (!rest) return null;
  const change = { axes: [], reversed: {} };
  const end = performance.now() + ASSIGN_LIMIT_MS;
  for (const [place, step] of ASSIGN_STEPS.entries()) {
    say(`${place + 1} of ${ASSIGN_STEPS.length}: ${step}`);
    let moved = null;
    while (!moved || change.axes.includes(moved.index)) {
      if (performance.now() > end) return null;
      await pause();
      moved = movedAxis(rest, gamepadAxes() || rest);
    }
    change.axes.push(moved.index);
    change.reversed[STICK_MODES[mode][place]] = moved.sign < 0;
    say("Let go.");
    for (let now = gamepadAxes(); now; now = gamepadAxes()) {
      if (Math.abs(now[moved.index] - rest[moved.index]) < ASSIGN_REST || performance.now() > end) break;
      await pause();
    }
  }
  return change;
}
