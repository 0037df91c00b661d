"""The camera's filter against a hand calculation, SciPy's frequency response and a voltage that is
stepped in time.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import freqs

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.hardware.cameras import load_camera
from falconwing_kit.tools.hardware.power_filter import PowerFilter

LOAD = 24.0  # ohm
PLAIN = PowerFilter(
    inductance_uh=100.0,
    coil_ohm=0.0,
    damping_ohm=0.0,
    capacitance_uf=100.0,
    esr_ohm=0.0,
    switching_khz=24.0,
)


def polynomials(parts, load):
    """Numerator and denominator of the filter in powers of s, worked out on paper from its
    currents.
    """
    L, C, Rs, Re = (
        1e-6 * parts.inductance_uh,
        1e-6 * parts.capacitance_uf,
        parts.series_ohm,
        parts.esr_ohm,
    )
    quadratic = L * C * (1.0 + Re / load)
    linear = C * (Rs + Re + Rs * Re / load) + L / load
    return [C * Re, 1.0], [quadratic, linear, 1.0 + Rs / load]


def test_corner_and_impedance_are_those_by_hand():
    """100 uH and 100 uF: sqrt(L C) = 1e-4 s, so 1 / (2 pi 1e-4) = 1591.5 Hz, and sqrt(L / C) = 1
    ohm.
    """
    assert PLAIN.corner_hz == pytest.approx(1591.549, rel=1e-6)
    assert PLAIN.impedance_ohm == pytest.approx(1.0)


def test_far_above_the_corner_it_falls_by_40_db_a_decade():
    """Without resistances |H| = (f_c / f)^2: 40 dB at ten corners and 80 dB at a hundred, to a
    tenth of a dB.
    """
    far = PLAIN.attenuation_db([10.0 * PLAIN.corner_hz, 100.0 * PLAIN.corner_hz], 1e9)
    assert far == pytest.approx([40.0, 80.0], abs=0.1)


def test_resistance_of_the_capacitor_ends_the_fall():
    """Far above the corner only the coil and the ESR count: |H| = ESR / (2 pi f L), by hand 0.1 /
    628 at 1 MHz.
    """
    leaky = replace(PLAIN, esr_ohm=0.1)
    assert leaky.gain(1e6, 1e9) == pytest.approx(0.1 / (2.0 * math.pi * 1e6 * 1e-4), rel=1e-3)


@pytest.mark.parametrize("damping_ohm", [0.0, 0.22, 1.0])
def test_gain_is_scipys_frequency_response(damping_ohm):
    """SciPy evaluates the polynomials, we add impedances; the tolerance is rounding."""
    parts = replace(load_camera().power_filter, damping_ohm=damping_ohm)
    frequency = np.logspace(1.0, 6.0, 200)
    _, response = freqs(*polynomials(parts, LOAD), worN=2.0 * np.pi * frequency)
    assert parts.gain(frequency, LOAD) == pytest.approx(np.abs(response), rel=1e-9)


@pytest.mark.parametrize("damping_ohm", [0.0, 0.22, 1.0])
def test_damping_is_that_of_the_polynomial(damping_ohm):
    """zeta = b / (2 sqrt(a c)) of a s^2 + b s + c. We leave out products of two resistances over
    the load, 2 % here.
    """
    parts = replace(load_camera().power_filter, damping_ohm=damping_ohm)
    _, (a, b, c) = polynomials(parts, LOAD)
    assert parts.damping(LOAD) == pytest.approx(b / (2.0 * math.sqrt(a * c)), rel=0.05)


def test_shipped_filter_keeps_the_switching_out():
    """The wanted ratio is ours: 30 times less at the speed controller's frequency, under 1 dB more
    anywhere, under 0.1 V lost. The ripple is solved in time by SciPy from the circuit's own two
    equations, far from |H|'s formula.
    """
    camera = load_camera()
    parts, load = camera.power_filter, camera.supply.load_ohm
    L, C, w = (
        1e-6 * parts.inductance_uh,
        1e-6 * parts.capacitance_uf,
        2e3 * math.pi * parts.switching_khz,
    )

    def output(current, charge):
        return (current + charge / C / parts.esr_ohm) / (1.0 / load + 1.0 / parts.esr_ohm)

    def rates(t, x):
        out = output(*x)
        return [(math.sin(w * t) - parts.series_ohm * x[0] - out) / L, x[0] - out / load]

    end = 400.0 * math.pi / w  # 200 periods, in which the start dies away
    flow = solve_ivp(
        rates,
        (0.0, end),
        [0.0, 0.0],
        rtol=1e-6,
        atol=1e-10,
        t_eval=np.linspace(0.9 * end, end, 4001),
    )
    ripple = np.ptp(output(*flow.y)) / 2.0
    assert parts.gain(1e3 * parts.switching_khz, load) == pytest.approx(ripple, rel=0.02)
    assert ripple < 1.0 / 30.0
    assert parts.peak_db(load) < 1.0
    assert parts.series_ohm * camera.supply.current_a < 0.1


@pytest.mark.parametrize(
    ("change", "broken"),
    [
        ({"inductance_uh": 3.3}, "ripple"),
        ({"esr_ohm": 1.5}, "ripple"),
        ({"switching_khz": 8.0}, "ripple"),
        ({"damping_ohm": 0.0}, "peak"),
        ({"damping_ohm": 2.2}, "loss"),
    ],
)
def test_planted_value_breaks_what_is_wanted(change, broken):
    """A coil, a capacitor or a resistor ten times off fails just the figure that it spoils."""
    camera = load_camera()
    parts, load = replace(camera.power_filter, **change), camera.supply.load_ohm
    failed = {
        "ripple": parts.gain(1e3 * parts.switching_khz, load) >= 1.0 / 30.0,
        "peak": parts.peak_db(load) >= 1.0,
        "loss": parts.series_ohm * camera.supply.current_a >= 0.1,
    }
    assert failed[broken]


@pytest.mark.parametrize(
    "change", [{"inductance_uh": 0.0}, {"capacitance_uf": -1.0}, {"esr_ohm": math.nan}]
)
def test_impossible_part_is_refused(change):
    """A value that no part has; the sentence names it."""
    with pytest.raises(InputError, match=next(iter(change))):
        replace(PLAIN, **change)


@pytest.mark.parametrize(
    ("frequency", "load"), [(0.0, LOAD), (math.inf, LOAD), (1e3, 0.0), (1e3, math.nan)]
)
def test_impossible_question_is_refused(frequency, load):
    """No gain at 0 Hz by a logarithm's measure, and none into a short circuit."""
    with pytest.raises(InputError):
        PLAIN.gain(frequency, load)
