"""Scores: a model + windows it was not fitted to -> how well it predicts two seconds ahead, in
sigmas and in metres.
"""

from dataclasses import dataclass, replace

import numpy as np

from falconwing_kit.aircraft.model import Model
from falconwing_kit.core.checks import Array
from falconwing_kit.sysid.fit import fit_initial_states
from falconwing_kit.sysid.shooting import Windows, pose_residuals

BLOCK_S = (
    10.0  # neighbouring samples are alike: whole blocks of time are held out, never single rows
)


@dataclass(frozen=True)
class PredictionScore:
    """How well windows are predicted over their whole length when only their start states may
    adapt.
    """

    chi2: float  # chi2 per degree of freedom, 1 where only noise is left
    channels: Array  # (6,) the same per channel
    # root mean square, over all measured rows, of the distance between predicted and measured
    position_m: float
    attitude_deg: (
        float  # root mean square over all measured rows and the three angles, so that of one angle
    )
    windows: int
    residual: Array  # (W, L, 6) predicted minus measured, weighted
    initial_states: Array  # (W, n_states)


def score(model: Model, windows: Windows, initial_states: Array | None = None) -> PredictionScore:
    """Predict each window from its re-estimated start state and compare with what was measured.

    Args:
        model: the aircraft; its parameters are held.
        windows: W windows, L rows each.
        starts: (W, n_states) first guess of the start states, or None for the windows' own.

    Returns:
        The score. Degrees of freedom: measured components less one start state per window.
    """
    initial_guess = (
        windows.initial_guess[:, : model.n_states] if initial_states is None else initial_states
    )
    initial_states, residual = fit_initial_states(model, windows, initial_guess)
    residual = pose_residuals(residual, windows)
    share = 1.0 - len(windows) * model.n_states / max(windows.count, 1)
    squares = residual**2
    seen = np.maximum(np.count_nonzero(windows.weight, axis=(0, 1)), 1)
    channels = squares.sum(axis=(0, 1)) / seen / share
    error = np.divide(
        residual, windows.weight, out=np.zeros_like(residual), where=windows.weight > 0
    )
    position = np.sqrt((error[..., :3] ** 2).sum() / max(seen[:3].mean(), 1.0))
    attitude = np.sqrt((error[..., 3:] ** 2).sum() / max(seen[3:].sum(), 1.0))
    return PredictionScore(
        float(squares.sum() / max(windows.count, 1) / share), channels, float(position), float(np.degrees(attitude)),
        len(windows), residual, initial_states,
    )  # fmt: skip


def split_blocks(
    windows: Windows, share: float = 0.3, block_s: float = BLOCK_S
) -> tuple[np.ndarray, np.ndarray]:
    """Which windows to fit and which to keep for scoring, by whole blocks of time.

    Blocks are counted from the start of each flight. With the usual share and block the fourth is
    the first to be kept, so that flights up to about 30 s keep nothing back, however many there
    are.

    Args:
        windows: W windows.
        share: about this part of the blocks is kept for scoring.
        block_s: length of a block [s].

    Returns:
        indices for fitting and indices for scoring; the latter is empty where no window begins so
        late.
    """
    block = np.floor((windows.nodes[:, 0] - windows.nodes[:, 0].min()) / block_s).astype(int)
    kept = np.floor((block + 1) * share) > np.floor(block * share)
    return np.flatnonzero(~kept), np.flatnonzero(kept)


def select_windows(windows: Windows, index: np.ndarray) -> Windows:
    """The windows at these indices."""
    return replace(
        windows,
        nodes=windows.nodes[index],
        pose=windows.pose[index],
        weight=windows.weight[index],
        edges=windows.edges[index],
        flight=windows.flight[index],
        initial_guess=windows.initial_guess[index],
    )
