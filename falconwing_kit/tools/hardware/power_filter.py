"""The camera's power filter: coil, capacitor, resistances, load -> corner, damping, and what is
left of the noise.

battery + --- damping resistor --- coil ---+------ camera +
                                           |
                                       capacitor (with its inner resistance, the ESR)
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
    """The parts as they are bought, units in the names."""

    inductance_uh: float
    coil_ohm: float  # resistance of the coil's wire
    damping_ohm: float  # resistor in series; 0 for none
    capacitance_uf: float
    esr_ohm: float  # equivalent series resistance of the capacitor
    switching_khz: (
        float  # how often the motor's speed controller switches: the noise to be kept out
    )

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
        """All that the camera's current flows through."""
        return self.coil_ohm + self.damping_ohm

    @property
    def corner_hz(self) -> float:
        """f_c = 1 / (2 pi sqrt(L C))      [textbook]."""
        return 1.0 / (2.0 * math.pi * math.sqrt(1e-12 * self.inductance_uh * self.capacitance_uf))

    @property
    def impedance_ohm(self) -> float:
        """Z_0 = sqrt(L / C), what the resistances are measured against      [textbook]."""
        return math.sqrt(self.inductance_uh / self.capacitance_uf)

    def damping(self, load_ohm: float) -> float:
        """Damping ratio: at 0 the filter rings for ever, from 1 on it does not ring.

        zeta = (R_series + R_ESR) / (2 Z_0) + Z_0 / (2 R_load)
            [denominator s^2 L C + s (C (R_series + R_ESR) + L / R_load) + 1, for resistances far
            below the load]

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
        """Size of the ripple behind the filter over the ripple before it.

        H = Z_p / (Z_s + Z_p),  Z_s = R_series + j w L,  1 / Z_p = 1 / R_load + 1 / (R_ESR + 1 / (j
        w C))

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
        """How much weaker the ripple is behind the filter: -20 log10 |H|.

        Args:
            frequency_hz: (...) > 0.
            load_ohm: the camera as a resistor.

        Returns:
            (...) [dB]; negative where the filter makes it stronger.

        Raises:
            InputError: a frequency or the load is not a positive number.
        """
        return np.asarray(-20.0 * np.log10(self.gain(frequency_hz, load_ohm)))

    def peak_db(self, load_ohm: float) -> float:
        """The most that any ripple is made stronger, near the corner; 0 where none is.

        Args:
            load_ohm: the camera as a resistor.

        Returns:
            [dB], from a thousand frequencies between a hundredth and a hundred corners.

        Raises:
            InputError: the load is not a positive number.
        """
        frequency = self.corner_hz * np.logspace(-2.0, 2.0, 1000)
        return max(0.0, float(20.0 * np.log10(np.max(self.gain(frequency, load_ohm)))))
