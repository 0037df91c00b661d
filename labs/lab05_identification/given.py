"""Lab 5, given: flight in a vertical plane, the logs, derivatives, and the paper's own fit."""

import json
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np

Array = np.ndarray

HERE = Path(__file__).parent
COHORT: dict[str, float] = json.loads((HERE / "cohort.json").read_text(encoding="utf-8"))
FAR = COHORT["far_sigmas"]  # residuals beyond this many standard deviations lose weight
LEVEL = COHORT["level_percent"] / 100.0  # of the intervals
Z = NormalDist().inv_cdf(
    0.5 + 0.5 * LEVEL
)  # a Gaussian lies within Z sigmas of its mean with this probability

GRAVITY, DT, K_TV = (
    9.8,
    0.05,
    0.5,
)  # m/s^2; s between frames; thrust lost with speed [1/s], known from a bench
SIGMA = np.array([0.03, 0.03, np.radians(0.6)])  # noise of px, pz [m] and pitch [rad]: marker poses
NAMES = ("cL_0", "cL_alpha", "cD_0", "cD_induced", "kT", "M_0", "M_de", "M_alpha")
UNITS = ("1/m", "1/(m rad)", "1/m", "m", "m/s^2", "1/m", "1/m", "1/(m rad)")
GUESS = np.array(
    [0.06, 1.1, 0.03, 0.3, 7.0, 0.08, 0.25, -0.8]
)  # from a drawing of the aircraft: 30 % off or so
PRIOR_SIGMA = 0.5 * np.abs(GUESS)  # how well the guess is known
STEPS = np.array(
    [0.05, 0.05, 0.01, 0.1, 0.1]
)  # of derivatives to a initial state: m, m, rad, m/s, m/s
FARTHEST = 20.0 * STEPS  # that a initial state may move in one round
ROWS, FIRST = 41, 4  # rows of a window: 2 s and one row; where the first window of a pass begins
BLUE, ORANGE, GREEN, GREY = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#777777",
)  # distinguishable for colour-blind readers


def plane_rate(x: Array, command: Array, K: Array) -> Array:
    """dx/dt of the aircraft in a vertical plane, wings level: lab 4's longitudinal model.

    Args:
        x: (5, ...) px, pz [m], pitch [rad], vx, vz [m/s]; z up.
        command: (2, ...) throttle 0..1, elevator -1..1.
        K: (8,) or (8, ...) in the order of NAMES.

    Returns:
        (5, ...) the time derivative.
    """
    cL_0, cL_alpha, cD_0, cD_induced, kT, M_0, M_de, M_alpha = K
    _, _, pitch, vx, vz = x
    V, path = np.hypot(vx, vz), np.arctan2(vz, vx)
    alpha = pitch - path
    c = cL_0 + cL_alpha * alpha
    lift, drag = V**2 * c, V**2 * (cD_0 + cD_induced * c**2)
    thrust = (kT - K_TV * V) * command[0]
    along, across = thrust * np.cos(alpha) - drag, thrust * np.sin(alpha) + lift
    ax = along * np.cos(path) - across * np.sin(path)
    az = along * np.sin(path) + across * np.cos(path) - GRAVITY
    return np.stack(
        np.broadcast_arrays(vx, vz, V * (M_0 + M_de * command[1] + M_alpha * alpha), ax, az)
    )


def step(x: Array, command: Array, K: Array) -> Array:
    """One Runge-Kutta step of DT with the command held; arguments as for `plane_rate`."""
    k1 = plane_rate(x, command, K)
    k2 = plane_rate(x + 0.5 * DT * k1, command, K)
    k3 = plane_rate(x + 0.5 * DT * k2, command, K)
    k4 = plane_rate(x + DT * k3, command, K)
    return x + DT / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def predict(K: Array, starts: Array, commands: Array) -> Array:
    """Fly every window from its initial state.

    Args:
        K: (8,), or (8, W) with numbers of its own for each window.
        starts: (W, 5) px, pz, pitch, vx, vz.
        commands: (W, L, 2) mean position of throttle and elevator during each step.

    Returns:
        (W, L, 3) px, pz [m], pitch [rad] at every row.
    """
    x, poses = starts.T, [starts[:, :3]]
    for k in range(commands.shape[1] - 1):
        x = step(x, commands[:, k].T, K)
        poses.append(x[:3].T)
    return np.stack(poses, axis=1)


def sensitivities(K: Array, starts: Array, commands: Array) -> tuple[Array, Array]:
    """Derivatives of `predict` by small differences.

    Args:
        K: (8,).
        starts: (W, 5).
        commands: (W, L, 2).

    Returns:
        to K (W, L, 3, 8), and of each window to its own initial state (W, L, 3, 5).
    """
    moves = np.concatenate([np.diag(1e-4 * np.maximum(np.abs(K), 0.1)), np.zeros((5, 8))])
    shifts = np.concatenate([np.zeros((8, 5)), np.diag(1e-3 * STEPS)])
    sizes, count = (moves.sum(axis=1) + shifts.sum(axis=1)), len(starts)
    # All thirteen moved copies of all windows fly at once: that is what makes NumPy fast.
    all_K = np.repeat(K + moves, count, axis=0).T
    all_starts = (starts + shifts[:, None, :]).reshape(-1, 5)
    moved = predict(all_K, all_starts, np.tile(commands, (13, 1, 1))).reshape(13, count, -1, 3)
    slopes = np.moveaxis((moved - predict(K, starts, commands)) / sizes[:, None, None, None], 0, -1)
    return slopes[..., :8], slopes[..., 8:]


def read_passes() -> tuple[Array, Array]:
    """The logs: straight passes through the hall, simulated, a row every DT.

    Returns:
        poses (passes, rows, 3) px, pz [m], pitch [rad], nan where a frame gave none; inputs
        (passes, rows, 2).
    """
    with np.load(HERE / "data" / "passes.npz") as file:
        return file["poses"], file["sticks"]


def delayed(inputs: Array, delay: float) -> Array:
    """Mean inputs during each step, after a delay.

    Args:
        inputs: (..., rows, 2) as logged (zero-order hold).
        delay: [s], 0 to 0.2.

    Returns:
        (..., rows, 2).
    """
    whole, part = divmod(delay / DT, 1.0)
    at = np.arange(inputs.shape[-2]) - int(whole)
    now, before = np.maximum(at, 0), np.maximum(at - 1, 0)
    return part * inputs[..., before, :] + (1.0 - part) * inputs[..., now, :]


def windows(values: Array) -> Array:
    """Cut passes (passes, rows, ...) into windows of ROWS rows, two per pass."""
    pairs = (values[:, FIRST : FIRST + ROWS], values[:, FIRST + ROWS - 1 : FIRST + 2 * ROWS - 1])
    return np.stack(pairs, axis=1).reshape(-1, ROWS, *values.shape[2:])


def start_guess(measured: Array) -> Array:
    """A first guess of each window's initial state from its first frames: (W, L, 3) -> (W, 5)."""
    t, early = DT * np.arange(13), measured[:, :13]
    guess = np.empty((len(measured), 5))
    for w, rows in enumerate(early):
        for channel in range(3):
            x = rows[:, channel]
            good = np.abs(x - np.nanmedian(x)) < (4.0 if channel == 0 else 0.6)
            line = np.polyfit(t[good], x[good], 1)
            guess[w, channel] = line[1]
            if channel < 2:
                guess[w, 3 + channel] = line[0]
    return guess


def past_velocity(t: Array, p: Array, rows: int = 7) -> Array:
    """Velocity of each row, from a parabola through the last few positions: nothing of the future.

    Args:
        t: (N,) [s].
        p: (N, 3) measured positions, precise to a millimetre [m], nan where missing.
        rows: that enter, the present one included.

    Returns:
        (N, 3) [m/s], nan where one of the rows is missing.
    """
    v = np.full(p.shape, np.nan)
    for k in range(rows - 1, len(t)):
        near = slice(k - rows + 1, k + 1)
        if np.isfinite(p[near]).all():
            v[k] = np.polyfit(t[near] - t[k], p[near], 2)[1]
    return v


def reduce(weighted_to_K: Array, weighted_to_start: Array) -> Array:
    """Sensitivities to K with initial states eliminated: (W, R, 8) and (W, R, 5) -> (W * R, 8)."""
    Q, _ = np.linalg.qr(weighted_to_start)
    return (weighted_to_K - Q @ (Q.transpose(0, 2, 1) @ weighted_to_K)).reshape(
        -1, weighted_to_K.shape[-1]
    )


def plausible(poses: Array) -> Array:
    """Poses (passes, rows, 3) with frames far off their neighbours' median set to nan."""
    spans = np.lib.stride_tricks.sliding_window_view(
        np.pad(poses, ((0, 0), (3, 3), (0, 0)), "edge"), 7, axis=1
    )
    off = np.abs(poses - np.nanmedian(spans, axis=3)) > np.array([0.6, 0.3, 0.2])
    return np.where(off.any(axis=2, keepdims=True), np.nan, poses)


def fit_one_step(states: Array, commands: Array) -> Array:
    """The paper's fit: K that predicts each next state from the previous one [paper, Section IV-B].

    Args:
        states: (passes, rows, 5) with velocities from differentiated poses; rows with nan are left
            out.
        commands: (passes, rows, 2).

    Returns:
        (8,) K.
    """
    from scipy.optimize import least_squares

    good = np.isfinite(states[:, :-1]).all(axis=2) & np.isfinite(states[:, 1:]).all(axis=2)
    now, after, command = states[:, :-1][good].T, states[:, 1:][good].T, commands[:, :-1][good].T

    def mismatch(K: Array) -> Array:
        return (step(now, command, K) - after).ravel()

    bounds = (
        np.minimum(0.0, 10.0 * GUESS),
        np.maximum(0.0, 10.0 * GUESS),
    )  # beyond them is no aircraft
    return np.asarray(least_squares(mismatch, GUESS, bounds=bounds, x_scale=np.abs(GUESS)).x)


def moving_pass(number: int = 0) -> Any:
    """A film of one pass from the side: what the camera measured, frame by frame, and the inputs.

    Args:
        number: of the pass.
    """
    from matplotlib.figure import Figure

    from falconwing_kit.tools.grading import moving_figure, side_view

    poses, inputs = (each[number] for each in read_passes())
    t = DT * np.arange(len(poses))
    figure = Figure(figsize=(8.4, 4.2), layout="constrained")
    axes: Any = figure.subplots(2, 1, height_ratios=(1.6, 1.0))
    side, below = axes
    dots = side.plot([], [], ".", color=BLUE, label="measured poses")[0]
    outline = side.fill([0], [0], color=ORANGE)[0]
    seen = np.isfinite(poses[:, 0])
    low, high = np.percentile(poses[seen, 0], [2, 98])
    side.set(xlabel="x along the runway [m]", ylabel="height [m]", xlim=(low - 2, high + 2))
    side.set(ylim=(0.0, 4.0), aspect="equal")
    side.legend(fontsize=7, loc="lower right")
    lines = [
        below.plot([], [], line, color=colour, label=name)[0]
        for name, colour, line in (("throttle", GREEN, "-"), ("elevator", ORANGE, "--"))
    ]
    below.set(xlabel="time [s]", ylabel="input [-]", xlim=(0, t[-1]), ylim=(-1.05, 1.05))
    below.legend(fontsize=7, loc="lower right")

    def draw(frame: int) -> None:
        dots.set_data(poses[: frame + 1, 0], poses[: frame + 1, 1])
        x, z, pitch = poses[frame]
        if np.isfinite([x, z, pitch]).all():
            outline.set_xy(side_view(x, z, pitch, length=1.5).T)
        state = "" if np.isfinite([x, z, pitch]).all() else ", no pose in this frame"
        side.set_title(f"A pass of {t[frame]:.2f} s (simulated){state}", fontsize=9)
        for column, line in enumerate(lines):
            line.set_data(t[: frame + 1], inputs[: frame + 1, column])

    words = "An aircraft flies to the right, leaves a row of dots, and now and then one far off it."
    return moving_figure(figure, draw, len(poses), DT, words)
