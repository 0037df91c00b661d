"""Scores: a model + windows it was not fitted to -> errors of its predictions over two seconds."""

from dataclasses import dataclass

import numpy as np

from falconwing_kit.aircraft.model import Model
from falconwing_kit.core.checks import Array
from falconwing_kit.core.frames import GRAVITY, wrap_angle
from falconwing_kit.sysid.fit import fit_initial_states
from falconwing_kit.sysid.shooting import Windows, pose_residuals

BLOCK_S = 10.0  # neighbouring samples are correlated, so whole blocks of time are held out
DIVERGED_RESIDUAL = 1e4  # [sigma] at most of a residual in a score, which stays finite


@dataclass(frozen=True)
class PredictionScore:
    """Prediction errors over whole windows, with the initial states fitted."""

    chi2: float  # per degree of freedom; on held-out windows 1 if model and sigma are right
    channels: Array  # (6,) the same per channel
    position_m: float  # root mean square distance over all measured rows
    attitude_deg: float  # root mean square over all measured rows and the three angles
    windows: int
    residual: Array  # (W, L, 6) predicted minus measured, weighted; at most DIVERGED_RESIDUAL
    initial_states: Array  # (W, n_states)

    @property
    def diverged(self) -> int:
        """How many windows have residuals of DIVERGED_RESIDUAL and more, which count as that."""
        return int(np.count_nonzero(np.abs(self.residual).max(axis=(1, 2)) >= DIVERGED_RESIDUAL))


def score(model: Model, windows: Windows, initial_states: Array | None = None) -> PredictionScore:
    """Predict each window from its fitted initial state and compare with the measured poses.

    Degrees of freedom: measured components less one initial state per window.

    Args:
        model: the aircraft; its parameters are fixed.
        windows: W windows, L rows each.
        initial_states: (W, n_states) first guess, or None for the windows' own.
    """
    guess = windows.initial_guess[:, : model.n_states] if initial_states is None else initial_states
    initial_states, residual = fit_initial_states(model, windows, guess)
    return score_residual(windows, initial_states, residual)


def score_constant_turn(windows: Windows, initial_states: Array) -> PredictionScore:
    """The same for a forecast without a model: a constant turn from each initial state.

    Speed, climb, roll and pitch stay; the yaw rate is that of a coordinated turn, g tan(roll) / V
    [Beard & McLain, eq. 9.14].

    Args:
        windows: W windows, L rows each.
        initial_states: (W, n_states), as a model's score found them.
    """
    since = windows.nodes - windows.nodes[:, :1]  # (W, L)
    px, py, pz, pitch, yaw, roll, vx, vy, vz = initial_states[:, :9].T[..., None]
    speed = np.maximum(np.hypot(vx, vy), 0.1)
    yaw_rate = GRAVITY * np.tan(np.clip(roll, -1.4, 1.4)) / speed
    # The chord of the arc: its length, and its course halfway through the turn; y is to the left.
    turn = -yaw_rate * since
    chord = speed * since * np.sinc(turn / (2.0 * np.pi))
    course = np.arctan2(vy, vx) + 0.5 * turn
    rows = (
        px + chord * np.cos(course), py + chord * np.sin(course), pz + vz * since,
        roll + 0.0 * since, pitch + 0.0 * since, yaw + yaw_rate * since,
    )  # fmt: skip
    difference = np.stack(rows, axis=-1) - windows.pose
    difference[..., 3:] = wrap_angle(difference[..., 3:])
    return score_residual(windows, initial_states, difference * windows.weight)


def score_residual(windows: Windows, initial_states: Array, residual: Array) -> PredictionScore:
    """The score of residuals (W, L, 6) or (W, R), weighted, without whitening.

    The other arguments are those of `score`.
    """
    if residual.ndim == 2:
        residual = pose_residuals(residual, windows)
    measured_only = np.where(windows.weight > 0.0, residual, 0.0)
    no_number = np.nan_to_num(measured_only, nan=DIVERGED_RESIDUAL)
    residual = np.clip(no_number, -DIVERGED_RESIDUAL, DIVERGED_RESIDUAL)
    squares = residual**2
    # chi2 per degree of freedom, in all and per channel: the fitted states are shared out evenly.
    share = 1.0 - len(windows) * initial_states.shape[1] / max(windows.count, 1)
    measured = np.maximum(np.count_nonzero(windows.weight, axis=(0, 1)), 1)  # (6,)
    channels = squares.sum(axis=(0, 1)) / measured / share
    chi2 = squares.sum() / max(windows.count, 1) / share
    # Errors in metres and radians: the weights divided out, zero where nothing was measured.
    zeros = np.zeros_like(residual)
    error = np.divide(residual, windows.weight, out=zeros, where=windows.weight > 0)
    position = np.sqrt((error[..., :3] ** 2).sum() / max(measured[:3].mean(), 1.0))
    attitude = np.sqrt((error[..., 3:] ** 2).sum() / max(measured[3:].sum(), 1.0))
    return PredictionScore(
        chi2=float(chi2),
        channels=channels,
        position_m=float(position),
        attitude_deg=float(np.degrees(attitude)),
        windows=len(windows),
        residual=residual,
        initial_states=initial_states,
    )


def split_blocks(
    windows: Windows, share: float = 0.3, block_s: float = BLOCK_S
) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the windows to fit and of those to hold out, by whole blocks of time.

    Blocks are counted from the start of each flight. By default the fourth is the first to be held
    out, so flights up to about 30 s hold nothing out, however many there are.

    Args:
        windows: W windows.
        share: approximate share of the blocks that is held out.
        block_s: length of a block [s].
    """
    block = np.floor((windows.nodes[:, 0] - windows.nodes[:, 0].min()) / block_s).astype(int)
    held_out = np.floor((block + 1) * share) > np.floor(block * share)
    return np.flatnonzero(~held_out), np.flatnonzero(held_out)
