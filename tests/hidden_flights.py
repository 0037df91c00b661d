"""Hidden cases: seed -> a calm flight and a flight with an effect in it, flown by the JSBSim
aircraft, and the answer.

Each case is another aircraft (coefficients spread by 15 %), the flight on another day (redrawn by 1
%). Simulated, not measured. `python -m tests.hidden_flights OUT --cases 20 --seed 7` writes flight
tables as in the labelled gap cases.
"""

import argparse
import json
from dataclasses import dataclass, field
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import atomic_write
from falconwing_kit.core.flight_table import FlightTable, write_flight_table
from falconwing_kit.core.frames import euler_from_rotation, rotation_world_body, wrap_angle
from tests.hidden_effects import EFFECTS, IN_CATALOGUE, LEAD, OUTSIDE, Acting, HiddenEffect
from tests.jsbsim_aircraft import (
    HEIGHT,
    ROW,
    SPEED,
    Array,
    JsbsimAircraft,
    Pilot,
    figure_eights,
    fly_jsbsim,
)

NOISE = {  # standard deviation per axis [m], [rad]
    "marker": (0.03, np.radians(0.6)),
    "hybrid": (0.10, np.radians(1.3)),
    "net": (0.26, np.radians(3.0)),
}
CORRELATION, OUTLIERS, MISSING = 0.5, 0.005, 0.01  # s, shares of the poses
HALL = np.array(
    [19.5, 14.5, 8.0]
)  # m: a flight that leaves it, or touches the floor, is flown anew
LARGE_HALL = np.array([25.0, 20.0, 8.0])  # m: a manoeuvre of straight legs takes more room
ATTEMPTS, SAME_SIZE = (
    40,
    10,
)  # a size is tried ten times before it is drawn anew, or large effects would get rare
Flown = tuple[
    Array, Array, Array
]  # t (N,), true states (N, 12), sticks (N, 4); LEAD comes before the table


@dataclass(frozen=True)
class HiddenCase:
    """One case."""

    calm: FlightTable
    flight: FlightTable
    truth: dict[
        str, Any
    ]  # effect, noise, correlated_noise, size, kit (the kit's parameters), measurement, seed
    true_states: tuple[Array, Array] = field(repr=False)  # (N, 12) of both flights, as they were
    aircraft: JsbsimAircraft  # of the flight, without the effect


def make_case(
    seed: int, effect: str | None = None, noise: str = "marker", correlated: bool = False,
    size: dict[str, Any] | None = None, calm_seconds: float = 120.0, flight_seconds: float = 90.0,
    one_way: bool = False, excitation: float = 1.0, pose_bias: float = 0.0, jitter: float = 0.0,
) -> HiddenCase:  # fmt: skip
    """Fly a case; the same arguments give the same case to the last bit.

    Args:
        seed: of everything that is drawn.
        effect: a name of EFFECTS, or several joined by "+"; None draws one of the catalogue, or
            none.
        noise: a name of NOISE.
        correlated: half of the noise's variance is AR(1) with 0.5 s.
        size: sizes by name, as in truth["size"]; None draws them, log-uniform from just visible to
            plain.
        calm_seconds: length of the calm flight [s].
        flight_seconds: length of the flight with the effect [s].
        one_way: circle to the left only, in both flights.
        excitation: how much the pilot shakes the sticks; 1 excites everything.
        pose_bias: amplitude of a pose error that is a smooth function of place and the same in both
            flights [m]; of angles as many radians as the noise has for so many metres.
        jitter: stamps are off by up to this much [s].
    """
    if effect is None:
        effect = str(np.random.default_rng([seed, 99]).choice(["none", *IN_CATALOGUE]))
    names = effect.split("+")
    if unknown := [name for name in names if name not in EFFECTS]:
        raise InputError(
            f"effect: expected names of {', '.join(EFFECTS)}, or some joined by +, "
            f"got {unknown[0]!r}"
        )
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([seed, attempt])
        calm_aircraft = JsbsimAircraft().redrawn(rng, 0.15)
        aircraft = calm_aircraft.redrawn(rng, 0.01)
        of_size = np.random.default_rng([seed, 98, attempt // SAME_SIZE])
        sizes = [_drawn_size(EFFECTS[name], of_size, noise, aircraft) for name in names]
        if size is not None:
            sizes = [{key: size[key] for key in drawn} for drawn in sizes]
        acting = Acting(calm_aircraft), _together(aircraft, names, sizes)
        calm = _fly(acting[0], rng, calm_seconds, one_way, excitation)
        flight = _fly(acting[1], rng, flight_seconds, one_way, excitation) if calm else None
        if calm and flight:
            break
    else:
        raise InputError(
            f"seed {seed}: expected a flight with {effect} that stays in the hall, "
            f"got none in {ATTEMPTS}; take a smaller size"
        )
    camera = _Camera(rng, noise, correlated, pose_bias, jitter)
    kit = [EFFECTS[name].in_kit(aircraft, one) for name, one in zip(names, sizes, strict=True)]
    truth = {
        "effect": effect,
        "noise": noise,
        "correlated_noise": correlated,
        "size": _merged(sizes),
        "kit": _merged(kit),
        "measurement": {
            "pose_bias": pose_bias,
            "jitter": jitter,
            "one_way": one_way,
            "excitation": excitation,
        },
        "outside": any(name in OUTSIDE for name in names),
        "seed": seed,
    }
    tables = (
        camera.table("calm.csv", calm, acting[0]),
        camera.table("flight.csv", flight, acting[1]),
    )
    return HiddenCase(*tables, truth, (_after_lead(calm[1]), _after_lead(flight[1])), aircraft)


def fly_on(
    case: HiddenCase, pilot: Pilot, seconds: float, rng: np.random.Generator, pause: float = 5.0
) -> FlightTable | None:
    """Fly the aircraft of a case on, with its effect, by another pilot, measured by a like camera.

    The battery and the clock go on: the second table begins a pause [s] after the end of the first.

    Args:
        case: its flight is the one before.
        pilot: flies from 10 s before the table begins.
        seconds: length of the table [s].
        rng: of the measurement noise.
        pause: between the two tables [s].

    Returns:
        Both tables as one, with a gap in time; None where the flight leaves a hall of 50 x 40 m.
    """
    truth, first = case.truth, case.flight
    names = truth["effect"].split("+")
    acting = _together(case.aircraft, names, [truth["size"]] * len(names))
    begin, before_step = float(first.t[-1]) + pause, acting.before_step
    later = None if before_step is None else lambda t, fdm: before_step(t + begin, fdm)
    flown = _inside(
        fly_jsbsim(acting.aircraft, pilot, LEAD + seconds, before_step=later), LARGE_HALL
    )
    if flown is None:
        return None
    kept = {key: truth["measurement"][key] for key in ("pose_bias", "jitter")}
    camera = _Camera(rng, truth["noise"], truth["correlated_noise"], **kept)
    second = camera.table(first.name, flown, acting)
    return FlightTable(
        first.name,
        np.concatenate([first.t, begin + second.t - second.t[0]]),
        np.concatenate([first.p_world, second.p_world]),
        np.concatenate([first.attitude, second.attitude]),
        np.concatenate([first.commands, second.commands]),
    )


def _merged(parts: list[dict[str, Any]]) -> dict[str, Any]:
    return {key: value for part in parts for key, value in part.items()}


def _after_lead(rows: Array) -> Array:
    return rows[round(LEAD / ROW) :]


def _drawn_size(
    effect: HiddenEffect, rng: np.random.Generator, noise: str, aircraft: JsbsimAircraft
) -> dict[str, Any]:
    marker, net = effect.small
    small = {"marker": marker, "hybrid": np.sqrt(marker * net), "net": net}[noise]
    return effect.draw(
        rng, float(np.exp(rng.uniform(np.log(small), np.log(effect.plain)))), aircraft
    )


def _together(aircraft: JsbsimAircraft, names: list[str], sizes: list[dict[str, Any]]) -> Acting:
    """All effects at once; the later sees the aircraft that the earlier has changed."""
    steps, tilt, late = [], np.zeros(2), 0.0
    for name, size in zip(names, sizes, strict=True):
        acting = EFFECTS[name].act(aircraft, size)
        aircraft, tilt, late = acting.aircraft, tilt + acting.tilt, late + acting.late
        steps += [acting.before_step] if acting.before_step else []

    def before_step(t: float, fdm: Any) -> None:
        for step in steps:
            step(t, fdm)

    return Acting(aircraft, before_step if steps else None, (float(tilt[0]), float(tilt[1])), late)


# Flying
# --------------------------------------------------------------------------------------------------


def _fly(
    acting: Acting, rng: np.random.Generator, seconds: float, one_way: bool, shake: float
) -> Flown | None:
    """The flight, or None if it left the hall."""
    pilot = _up_and_down(figure_eights(rng, shake, one_way), rng, seconds + LEAD)
    return _inside(
        fly_jsbsim(acting.aircraft, pilot, LEAD + seconds, before_step=acting.before_step)
    )


def _inside(flown: Flown, hall: Array = HALL) -> Flown | None:
    """The flight, or None if it left the hall after LEAD."""
    states = flown[1]
    place = _after_lead(states)[:, :3]
    inside = np.isfinite(states).all() and (np.abs(place) < hall).all() and place[:, 2].min() > 0.05
    return flown if inside else None


def _up_and_down(pilot: Pilot, rng: np.random.Generator, seconds: float) -> Pilot:
    """The pilot with changing wishes: a low pass (0.4 to 1 m) every 12 s or so, slower and faster
    times.

    He is shown a height and a speed that are off by what they shall differ from the ones he holds.
    """
    passes = np.arange(10.0, seconds + 20.0, 12.0)
    passes += rng.uniform(-3.0, 3.0, len(passes))
    down = HEIGHT - rng.uniform(0.7, 1.2, len(passes))
    period, phase = rng.uniform(14.0, 22.0), rng.uniform(0.0, 2.0 * np.pi)

    def shown(t: float, state: Array) -> Array:
        seen = state.copy()
        soon = state[2] + 0.6 * state[8]  # height in 0.6 s: the floor must not be touched
        seen[2] += (
            np.max(down * np.exp(-(((t - passes) / 3.0) ** 2))) - 0.3 - 2.0 * max(0.8 - soon, 0.0)
        )
        seen[6:8] *= SPEED / (SPEED + 0.3 + 0.7 * np.sin(2.0 * np.pi * t / period + phase))
        return pilot(t, seen)

    return shown


# Measuring
# --------------------------------------------------------------------------------------------------


class _Camera:
    """Measures poses with errors of its own, the same map of place-dependent errors for every
    flight.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        noise: str,
        correlated: bool,
        pose_bias: float,
        jitter: float,
    ) -> None:
        self.rng, self.correlated, self.jitter = rng, correlated, jitter
        self.sigma = np.repeat(NOISE[noise], 3)
        self.bias = pose_bias * self.sigma / self.sigma[0]
        directions = rng.normal(size=(3, 6))
        self.waves = (
            2.0
            * np.pi
            / rng.uniform(5.0, 15.0, 6)
            * directions
            / np.linalg.norm(directions, axis=0)
        )
        self.phase = rng.uniform(0.0, 2.0 * np.pi, 6)

    def table(self, name: str, flown: Flown, acting: Acting) -> FlightTable:
        """The flight's table after LEAD, with stamps from zero on."""
        t, states, sticks = flown
        when = _after_lead(t)
        poses = CubicSpline(t, states[:, :6])(when - acting.late)
        turned = rotation_world_body(acting.tilt[1], acting.tilt[0], 0.0)
        R_body_camera = rotation_world_body(0.0, 0.0, 0.0).T @ turned
        R_world_camera = rotation_world_body(poses[:, 5], poses[:, 3], poses[:, 4]) @ R_body_camera
        error, stamps = (
            self._error(poses[:, :3]),
            self.rng.uniform(-self.jitter, self.jitter, len(when)),
        )
        attitude = wrap_angle(np.stack(euler_from_rotation(R_world_camera), axis=1) + error[:, 3:])
        return FlightTable(
            name,
            np.round(when - when[0] + stamps, 5),
            poses[:, :3] + error[:, :3],
            attitude,
            _after_lead(sticks),
        )

    def _error(self, p_world: Array) -> Array:
        """(N, 6) of positions and of roll, pitch, yaw; nan where no pose is measured."""
        rng, count = self.rng, len(p_world)
        error = rng.normal(size=(count, 6))
        if self.correlated:
            error = np.sqrt(0.5) * (error + _slow(count, rng))
        error = error * self.sigma + self.bias * np.sin(p_world @ self.waves + self.phase)
        off, lost = rng.random(count) < OUTLIERS, rng.random(count) < MISSING
        error[off, :3] += rng.normal(0.0, 3.0, (int(off.sum()), 3))
        error[lost] = np.nan
        return error


def _slow(count: int, rng: np.random.Generator) -> Array:
    """(count, 6) AR(1) noise of unit variance whose correlation falls to 1/e within CORRELATION."""
    kept = np.exp(-ROW / CORRELATION)
    error = rng.normal(size=(count, 6))
    for k in range(1, count):
        error[k] = kept * error[k - 1] + np.sqrt(1.0 - kept**2) * error[k]
    return error


# Command line
# --------------------------------------------------------------------------------------------------


def write_cases(out: Path, cases: dict[str, HiddenCase]) -> None:
    """Write OUT/<name>/calm.csv and flight.csv of each case and OUT/truth.json."""
    for name, case in cases.items():
        (out / name).mkdir(parents=True, exist_ok=True)
        write_flight_table(out / name / "calm.csv", case.calm)
        write_flight_table(out / name / "flight.csv", case.flight)
    with atomic_write(out / "truth.json", text=True) as file:
        json.dump({name: case.truth for name, case in cases.items()}, file, indent=1)


def main() -> None:
    """Write a folder of hidden cases."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--cases", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--effect", nargs="*", default=[None], help="in turn; two at once as a+b; default: drawn"
    )
    parser.add_argument(
        "--noise", nargs="*", default=["marker", "hybrid"], choices=list(NOISE), help="in turn"
    )
    parser.add_argument(
        "--correlated", type=float, default=1 / 3, help="share of cases with correlated noise"
    )
    parser.add_argument("--pose-bias", type=float, default=0.0, help="[m]")
    parser.add_argument("--jitter", type=float, default=0.0, help="[s]")
    parser.add_argument("--one-way", action="store_true")
    parser.add_argument("--excitation", type=float, default=1.0)
    asked = parser.parse_args()
    cases = {}
    for k, noise, effect in zip(
        range(asked.cases), cycle(asked.noise), cycle(asked.effect), strict=False
    ):
        cases[f"case{k:02d}"] = make_case(
            asked.seed + k,
            effect,
            noise,
            (k * asked.correlated) % 1.0 + asked.correlated >= 1.0 - 1e-9,
            one_way=asked.one_way,
            excitation=asked.excitation,
            pose_bias=asked.pose_bias,
            jitter=asked.jitter,
        )
    write_cases(asked.out, cases)


if __name__ == "__main__":
    main()
