"""Linearised responses: the same derivatives as flying each effect through the windows."""

from functools import cache

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.sparse import SPARSE_EFFECTS
from falconwing_kit.gap.evidence import EffectVariant, Sensitivities, sensitivities
from falconwing_kit.gap.linear_response import linear_response
from falconwing_kit.gap.noise import PoseNoiseModel, whiten
from falconwing_kit.sysid.prepare import prepare
from falconwing_kit.sysid.shooting import cut_windows
from tests.gap.studies import own_aircraft, own_flight

NAMES = (
    "wind",
    "fan_jet",
    "propeller_torque",
    "trim_bias",
    "control_delay",
    "camera_offset",
    "cg_shift",
    "roll moment with rudder times airspeed",
    "drag with nearness to the ground",
    "updraught in waves over y",
    "gain of the aileron",
)
SMALL = 1e-3  # of an amplitude, so that flying it is linear too


@cache
def both() -> tuple[list[Sensitivities], list[Sensitivities]]:
    """Flown and linearised derivatives of small amplitudes, with coloured noise."""
    model = own_aircraft()
    windows = cut_windows(prepare(own_flight(None, 24.0, 31)).flights, model)
    windows = whiten(windows, PoseNoiseModel((0.4, 0.2), (0.5, 0.3)))
    effects = {e.name: e for e in reversed((*CATALOGUE, *SPARSE_EFFECTS))}
    tried = []
    for name in NAMES:
        start = {p.name: p.start for p in effects[name].parameters}
        small = {p.name: SMALL * p.start for p in effects[name].amplitudes}
        tried.append(EffectVariant(effects[name], {**start, **small}))
    states = windows.initial_guess
    flown = sensitivities(model, windows, states, tried)
    return flown, list(linear_response(model, windows, states).sensitivities(tried))


@pytest.mark.parametrize("number", range(len(NAMES)), ids=NAMES)
def test_response_equals_that_of_flying_the_effect(number):
    """Independent code: the whole window integrated with the effect. What remains, 5 %, is that an
    effect's drive is taken half-way between rows of 50 ms, and the sticks' mean over the row.
    """
    flown, linear = (part[number].derivative for part in both())
    assert flown.shape == linear.shape
    for column in range(flown.shape[2]):
        size = np.linalg.norm(flown[..., column])
        assert size > 0.0
        assert np.linalg.norm(linear[..., column] - flown[..., column]) < 0.05 * size


def test_blocks_do_not_change_the_response(monkeypatch):
    """Columns are computed apart: the same to the last digit but rounding in blocks of two."""
    model = own_aircraft()
    windows = cut_windows(prepare(own_flight(None, 24.0, 31)).flights, model)
    tried = [s.variant for s in both()[0][:4]]
    response = linear_response(model, windows, windows.initial_guess)
    together = [s.derivative for s in response.sensitivities(tried)]
    monkeypatch.setattr("falconwing_kit.gap.linear_response.COLUMNS", 2)
    for whole, part in zip(together, response.sensitivities(tried), strict=True):
        assert part.derivative == pytest.approx(whole, rel=1e-9, abs=1e-9)
