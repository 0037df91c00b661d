"""The camera's power filter: inductor, capacitor, resistances, load -> corner, damping, ripple.

battery + --- damping resistor --- coil ---+------ camera +
                                           |
                                       capacitor (with its equivalent series resistance, ESR)
                                           |
battery - ---------------------------------+------ camera -
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from falconwing_kit.core.checks import Array, InputError, require_range


@dataclass(frozen=True)
class PowerFilter:
    """Values of the parts, units in the names."""

    inductance_uh: float
    coil_ohm: float  # resistance of the inductor
    damping_ohm: float  # resistor in series; 0 for none
    capacitance_uf: float
    esr_ohm: float  # equivalent series resistance of the capacitor
    switching_khz: float  # of the motor's speed controller, the source of the ripple

    def __post_init__(self) -> None:
        for name, low in (
            ("inductance_uh", 0.01),
            ("capacitance_uf", 0.01),
            ("switching_khz", 0.1),
        ):
            require_range(name, getattr(self, name), low=low, high=1e5)
        for name in ("coil_ohm", "damping_ohm", "esr_ohm"):
            require_range(name, getattr(self, name), low=0.0, high=100.0)

    @property
    def series_ohm(self) -> float:
        """Total series resistance."""
        return self.coil_ohm + self.damping_ohm

    @property
    def corner_hz(self) -> float:
        """f_c = 1 / (2 pi sqrt(L C))      [textbook]."""
        return 1.0 / (2.0 * math.pi * math.sqrt(1e-12 * self.inductance_uh * self.capacitance_uf))

    @property
    def impedance_ohm(self) -> float:
        """Characteristic impedance Z_0 = sqrt(L / C)      [textbook]."""
        return math.sqrt(self.inductance_uh / self.capacitance_uf)

    def damping(self, load_ohm: float) -> float:
        """Damping ratio: 0 is undamped, 1 critically damped.

        zeta = (R_series + R_ESR) / (2 Z_0) + Z_0 / (2 R_load)
            [denominator s^2 L C + s (C (R_series + R_ESR) + L / R_load) + 1, for resistances much
            smaller than the load]

        Args:
            load_ohm: the camera as a resistor.

        Returns:
            [-].

        Raises:
            InputError: the load is not a positive number.
        """
        load = require_range("load_ohm", load_ohm, low=1e-3, high=1e9)
        return (self.series_ohm + self.esr_ohm) / (
            2.0 * self.impedance_ohm
        ) + self.impedance_ohm / (2.0 * load)

    def gain(self, frequency_hz: ArrayLike, load_ohm: float) -> Array:
        """Ripple behind the filter over ripple before it, |H|.

        H = Z_p / (Z_s + Z_p),  Z_s = R_series + j w L,
        1 / Z_p = 1 / R_load + 1 / (R_ESR + 1 / (j w C))

        Args:
            frequency_hz: (...) > 0.
            load_ohm: the camera as a resistor.

        Returns:
            |H| (...) [-].

        Raises:
            InputError: a frequency or the load is not a positive number.
        """
        frequency = np.asarray(frequency_hz, np.float64)
        if not np.all(np.isfinite(frequency) & (frequency > 0.0)):
            raise InputError(f"frequency_hz: expected positive numbers, got {frequency}")
        load = require_range("load_ohm", load_ohm, low=1e-3, high=1e9)
        jw = 2j * np.pi * frequency
        series = self.series_ohm + jw * 1e-6 * self.inductance_uh
        across = 1.0 / (1.0 / load + 1.0 / (self.esr_ohm + 1.0 / (jw * 1e-6 * self.capacitance_uf)))
        return np.asarray(np.abs(across / (series + across)))

    def attenuation_db(self, frequency_hz: ArrayLike, load_ohm: float) -> Array:
        """Attenuation of the ripple, -20 log10 |H|.

        Args:
            frequency_hz: (...) > 0.
            load_ohm: the camera as a resistor.

        Returns:
            (...) [dB]; negative for amplification.

        Raises:
            InputError: a frequency or the load is not a positive number.
        """
        return np.asarray(-20.0 * np.log10(self.gain(frequency_hz, load_ohm)))

    def peak_db(self, load_ohm: float) -> float:
        """Maximum amplification, near the corner; 0 without any.

        Args:
            load_ohm: the camera as a resistor.

        Returns:
            [dB], over a thousand frequencies from 0.01 to 100 times the corner.

        Raises:
            InputError: the load is not a positive number.
        """
        frequency = self.corner_hz * np.logspace(-2.0, 2.0, 1000)
        return max(0.0, float(20.0 * np.log10(np.max(self.gain(frequency, load_ohm)))))
