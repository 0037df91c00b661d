"""Hidden effects: seed -> a baseline flight, a flight with an effect, the answer; simulated.

The kit's own aircraft flies: each case is another aircraft (coefficients spread by 15 %), each
flight another day (spread by 1 %). A lab gives one case to each student; tests check that the
hidden effect is found. The simulation shares no integration code with the identification: actuators
in closed form, steps of at most 10 ms between arriving commands.
"""

import hashlib
import hmac
import json
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import atan2, ceil, hypot, inf, pi, radians
from pathlib import Path
from typing import Any, Literal

import numpy as np

from falconwing_kit.aircraft.effect import FLIGHT_RADIUS_M, Effect
from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.model import Model, rates_model, state_rates
from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.files import atomic_write
from falconwing_kit.core.flight_table import FlightTable, write_flight_table
from falconwing_kit.core.frames import wrap_angle

Noise = Literal["marker", "hybrid", "net"]
Pilot = Callable[[float, list[float]], Array]  # t [s], true state (12,) -> commands (4,)
# True states (N, 12) and commands (N, 4) at every row, from LEAD_S before the table begins.
Flown = tuple[Array, Array]
Servo = tuple[Array, Array]  # outputs (4,) of the first lag and of the second lag in series

NOISE: dict[Noise, tuple[float, float]] = {  # standard deviation per axis [m], [rad]
    "marker": (0.03, radians(0.6)), "hybrid": (0.10, radians(1.3)), "net": (0.26, radians(3.0)),
}  # fmt: skip
CORRELATION_S, OUTLIERS, MISSING = 0.5, 0.005, 0.01  # of the slow noise; shares of the poses
AIRCRAFT_SPREAD, DAY_SPREAD = 0.15, 0.01
ROW_S, LEAD_S = 0.05, 2.0  # between rows; flown before the table begins
STEP_S = 0.01  # longest integration step, 2.5 times finer than a fit's
RADIUS, HEIGHT, SPEED = FLIGHT_RADIUS_M, 2.3, 6.9  # of the circles flown [m], [m], [m/s]
# |x|, |y|, height [m]: the arena of 40 x 20 x 5 m with 4 m of margin beyond its long sides.
HALL = (20.0, 14.0, 5.0)
# A size is tried ten times before it is redrawn; otherwise large effects would become rare.
ATTEMPTS, SAME_SIZE = 40, 10


@dataclass(frozen=True)
class HiddenCase:
    """A baseline flight and a flight of one aircraft, and the effect hidden in the second."""

    calm: FlightTable
    flight: FlightTable
    # Effect, its size in the catalogue's parameters, noise and measurement settings, seed.
    truth: dict[str, Any]
    model: Model = field(repr=False)  # of the second flight, with the effect
    # (N, 12) of both flights at their rows, SI.
    true_states: tuple[Array, Array] = field(repr=False)


def hidden_seed(student: str, salt: str) -> int:
    """Seed of a student's case: HMAC-SHA256 of the name keyed by the salt [RFC 2104], 48 bits.

    Without the salt a student cannot compute the seed of any name, their own included.

    Args:
        student: name or number; surrounding spaces are ignored.
        salt: the instructor's secret of this course, at least 16 characters.

    Raises:
        InputError: the student is empty or the salt too short.
    """
    who = unicodedata.normalize("NFC", student).strip()
    if not who:
        raise InputError("student: expected a name or a number, got nothing")
    if len(salt) < 16:
        raise InputError(
            f"salt: expected at least 16 characters, got {len(salt)}; "
            "choose one that cannot be guessed"
        )
    return int.from_bytes(hmac.new(salt.encode(), who.encode(), hashlib.sha256).digest()[:6], "big")


def hidden_case(
    seed: int, effect: str | None = None, *, size: Mapping[str, float] | None = None, **how: Any
) -> HiddenCase:
    """Simulate one case; the same arguments give the same case bit by bit.

    Args:
        seed: of everything that is drawn, >= 0.
        effect: "none", a name of the catalogue, or two joined by "+"; None draws "none" or one of
            the effects with a frozen number, so that an effect added later changes no seed.
        size: all parameters of the effect by their names in the catalogue (those of the other
            effect for one that has `same_as`); None draws them, log-uniform from just visible at
            this noise to plainly visible.
        how: keyword arguments of `hidden_flights`: noise, flight_seconds and others.

    Raises:
        InputError: an argument is out of range, or no flight with this effect stays in the hall.
    """
    return hidden_flights(seed, [effect], sizes=[size], **how)[0]


def hidden_flights(
    seed: int, effects: Sequence[str | None], *, noise: Noise = "marker",
    correlated: bool = False, sizes: Sequence[Mapping[str, float] | None] | None = None,
    calm_seconds: float = 120.0, flight_seconds: float = 90.0, one_way: bool = False,
    excitation: float = 1.0, pose_bias: float = 0.0, jitter: float = 0.0,
    catalogue: Sequence[Effect] = CATALOGUE,
) -> tuple[HiddenCase, ...]:  # fmt: skip
    """One aircraft, one baseline flight, and for each effect a flight on another day.

    The baseline flight is the same object in every case, so one identification serves all. The
    first case equals that of `hidden_case` for the first effect.

    Args:
        seed: of everything that is drawn, >= 0.
        effects: at least one, each as for `hidden_case`.
        noise: white noise of the poses: "marker" (0.03 m, 0.6 deg per axis), "hybrid" (0.10 m,
            1.3 deg) or "net" (0.26 m, 3 deg); 0.5 % of the poses are outliers, 1 % are missing.
        correlated: half of the noise variance is AR(1) with a time constant of 0.5 s instead.
        sizes: one for each effect as for `hidden_case`; None draws all.
        calm_seconds: length of the baseline flight [s].
        flight_seconds: length of each other flight [s].
        one_way: circle to the left only, in all flights.
        excitation: amplitude of the added control inputs; 1 excites every parameter, 0 adds none.
        pose_bias: amplitude of a pose error that is a smooth function of position, the same in
            all flights [m]; angles get the same multiple of their noise.
        jitter: largest error of a time stamp [s].
        catalogue: the effects that may be hidden; those with `sizes` and `draw` can be drawn.

    Returns:
        The cases, in the order of the effects.

    Raises:
        InputError: as for `hidden_case`.
    """
    sizes = [None] * len(effects) if sizes is None else sizes
    _require(effects, sizes, noise, catalogue)
    for name, value, low, high in (
        ("seed", seed, 0.0, inf),
        ("calm_seconds", calm_seconds, 1.0, 3600.0),
        ("flight_seconds", flight_seconds, 1.0, 3600.0),
        ("pose_bias", pose_bias, 0.0, 2.0),
        ("excitation", excitation, 0.0, 2.0),
        ("jitter", jitter, 0.0, 0.02),
    ):
        require_range(name, value, low=low, high=high)

    fly = partial(
        _simulate, noise=noise, one_way=one_way, excitation=excitation, catalogue=catalogue
    )
    camera = _Camera(seed, noise, correlated, pose_bias, jitter)
    aircraft, _, calm_flown = fly(
        [seed, 0], rates_model(), AIRCRAFT_SPREAD, "none", None, calm_seconds
    )
    calm = camera.table("calm.csv", 0, calm_flown)
    settings = {
        "noise": noise, "correlated_noise": correlated, "pose_bias": pose_bias, "jitter": jitter,
        "one_way": one_way, "excitation": excitation, "seed": seed, "simulated": True,
    }  # fmt: skip
    cases = []
    for number, (chosen, size) in enumerate(zip(effects, sizes, strict=True), start=1):
        effect = chosen or _drawn_name(np.random.default_rng([seed, number]), catalogue)
        model, drawn, flown = fly(
            [seed, number], aircraft, DAY_SPREAD, effect, size, flight_seconds
        )
        stamps = [e.hidden_stamp_delay for e in catalogue if e.name in _names(effect)]
        stamp_delay = sum(delay(model.K) for delay in stamps if delay)
        flight = camera.table("flight.csv", number, flown, model, stamp_delay)
        truth = {"effect": effect, "size": drawn, "number": number, **settings}
        cases.append(
            HiddenCase(
                calm, flight, truth, model, (_after_lead(calm_flown[0]), _after_lead(flown[0]))
            )
        )
    return tuple(cases)


def write_hidden(
    out: str | Path, cases: Mapping[str, HiddenCase], answers: str | Path | None = None
) -> None:
    """Write OUT/<name>/calm.csv and flight.csv of each case, and the answers to their own file.

    Args:
        out: folder for the students; made where it is missing.
        cases: by the name of their folder.
        answers: JSON file of all truths by name, in an existing folder; None writes none.

    Raises:
        InputError: a name is not a plain folder name, or a file cannot be written.
        FileNotFoundError: the folder of the answers does not exist.
    """
    for name in cases:
        if name in ("", ".", "..") or set(name) & set("/\\:"):
            raise InputError(f"case {name!r}: expected a plain folder name such as case00")
    for name, case in cases.items():
        (folder := Path(out) / name).mkdir(parents=True, exist_ok=True)
        for table in (case.calm, case.flight):
            write_flight_table(folder / table.name, table)
    if answers is not None:
        with atomic_write(answers, text=True) as file:
            json.dump({name: case.truth for name, case in cases.items()}, file, indent=1)


# The hidden effect
# -----------------


def _drawn_name(rng: np.random.Generator, catalogue: Sequence[Effect]) -> str:
    """Draw "none" or an effect with a frozen number, all equally likely."""
    frozen = dict.fromkeys(e.name for e in catalogue if e.frozen_number is not None)
    return str(rng.choice(["none", *frozen]))


def _require(
    effects: Sequence[str | None],
    sizes: Sequence[Mapping[str, float] | None],
    noise: str,
    catalogue: Sequence[Effect],
) -> None:
    """Raise InputError for effects, sizes and noise that cannot be simulated."""
    if noise not in NOISE:
        raise InputError(f"noise: expected one of {', '.join(NOISE)}, got {noise!r}")
    if not effects or len(sizes) != len(effects):
        raise InputError(
            f"effects: expected at least one and a size for each, "
            f"got {len(effects)} and {len(sizes)} sizes"
        )
    known = {e.name: e.same_as or e.name for e in catalogue}
    for effect, size in zip(effects, sizes, strict=True):
        names = _names(effect or "none")
        if unknown := [name for name in names if name not in known]:
            raise InputError(
                f"effect: expected none, or some of {', '.join(known)}, got {unknown[0]!r}"
            )
        if len({known[name] for name in names}) < len(names):
            raise InputError(
                f"effect: expected effects whose dynamics differ, got {effect!r}; choose others"
            )
        if size is not None:
            _entries(names, size, catalogue)
        elif undrawn := [name for name in names if not _drawable(name, catalogue)]:
            raise InputError(
                f"effect {undrawn[0]!r}: expected a size, as the effect has no sizes and draw; "
                "give one"
            )


def _names(effect: str) -> list[str]:
    return [] if effect == "none" else effect.split("+")


def _drawable(name: str, catalogue: Sequence[Effect]) -> list[Effect]:
    """The catalogue's entries of this name whose size can be drawn."""
    return [e for e in catalogue if e.name == name and e.sizes and e.draw]


def _entries(
    names: Sequence[str], size: Mapping[str, float], catalogue: Sequence[Effect]
) -> list[Effect]:
    """The catalogue's entry for each name; together they have exactly these parameters."""
    classes = {e.same_as or e.name for e in catalogue if e.name in names}
    possible = [e for e in catalogue if e.name in classes]
    entries = [e for e in possible if all(p.name in size for p in e.parameters)]
    if len(entries) != len(names) or {p.name for e in entries for p in e.parameters} != set(size):
        expected = " or ".join(", ".join(p.name for p in e.parameters) for e in possible)
        raise InputError(
            f"size: expected the parameters {expected or 'of no effect'}, "
            f"got {', '.join(size) or 'none'}"
        )
    return entries


def _drawn_size(
    names: Sequence[str], rng: np.random.Generator, noise: Noise, catalogue: Sequence[Effect]
) -> dict[str, float]:
    """Draw the parameters of all effects: log-uniform size from just to plainly visible."""
    size: dict[str, float] = {}
    for name in names:
        effect = _drawable(name, catalogue)[0]
        assert effect.sizes is not None and effect.draw is not None
        marker, net, plain = effect.sizes
        small = {"marker": marker, "hybrid": float(np.sqrt(marker * net)), "net": net}[noise]
        size |= effect.draw(rng, float(np.exp(rng.uniform(np.log(small), np.log(plain)))))
    return size


# Flight
# ------


def _simulate(
    seeds: list[int], aircraft: Model, spread: float, effect: str, size: Mapping[str, float] | None,
    seconds: float, noise: Noise, one_way: bool, excitation: float, catalogue: Sequence[Effect],
) -> tuple[Model, dict[str, float], Flown]:  # fmt: skip
    """Redraw the aircraft, add the effect and fly until a flight stays in the hall.

    Returns:
        The model with the effect, the effect's size, and the flight.
    """
    names = _names(effect)
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([*seeds, 1, attempt])
        size_rng = np.random.default_rng([*seeds, 2, attempt // SAME_SIZE])
        drawn = (
            _drawn_size(names, size_rng, noise, catalogue)
            if size is None
            else {k: float(v) for k, v in size.items()}
        )
        model = _redrawn(aircraft, rng, spread)
        entries = _entries(names, drawn, catalogue)
        for entry in entries:
            model = model.with_effect(entry)
        model = model.with_values(drawn)
        # An entry with `same_as` is found under another name and acts on the images only: its
        # amplitudes are zero in flight.
        in_flight = {
            p.name: drawn[p.name] if entry.name in names else 0.0
            for entry in entries
            for p in entry.amplitudes
        }
        flown = _fly(
            model.with_values(in_flight), _figure_eights(rng, seconds, one_way, excitation), seconds
        )
        if flown is not None:
            return model, drawn, flown
    raise InputError(
        f"seed {seeds[0]}: expected a flight with {effect} that stays in the hall, "
        f"got none in {ATTEMPTS}; take a smaller size or another seed"
    )


def _redrawn(model: Model, rng: np.random.Generator, spread: float) -> Model:
    """Each parameter times exp(spread * normal); where it is zero, 0.1 * spread * normal."""
    drawn = dict(zip(model.names, spread * rng.normal(size=len(model.names)), strict=True))
    return model.with_values(
        {name: model.values[name] * np.exp(d) or 0.1 * d for name, d in drawn.items()}
    )


def _fly(model: Model, pilot: Pilot, seconds: float) -> Flown | None:
    """Fly the lead time and the flight; None if the aircraft left the hall."""
    rows, K, advance = round((LEAD_S + seconds) / ROW_S) + 1, model.K, _stepper(model)
    delay = max(K.delay + model.added_input_map(K)[0], 0.0)
    whole = int((delay + 1e-9) / ROW_S)  # the delay in whole rows, and its remainder
    rest = max(delay - whole * ROW_S, 0.0)
    states, commands, mapped = np.empty((rows, 12)), np.empty((rows, 4)), np.empty((rows, 4))
    times = ROW_S * np.arange(float(rows)) - LEAD_S
    x = [0.0, 0.0, HEIGHT, 0.1, 0.0, 0.0, SPEED, 0.0, 0.0, 0.0, 0.0, 0.0]
    servo: Servo | None = None
    for k in range(rows):
        states[k], t = x, times[k]
        if not (abs(x[0]) < HALL[0] and abs(x[1]) < HALL[1] and 0.05 < x[2] < HALL[2]):
            return None
        commands[k] = pilot(t, x)
        history = commands[: k + 1]  # a command map may depend on earlier commands
        for effect in model.effects:
            if effect.command_map:
                history = effect.command_map(times[: k + 1], history, K)
        mapped[k] = history[-1]
        servo = servo or (mapped[0], mapped[0])
        # Within a row the delayed command changes once, after the remainder of the delay.
        x, servo = advance(x, servo, mapped[max(k - whole - 1, 0)], t, rest)
        x, servo = advance(x, servo, mapped[max(k - whole, 0)], t + rest, ROW_S - rest)
    return states, commands


def _stepper(
    model: Model,
) -> Callable[[list[float], Servo, Array, float, float], tuple[list[float], Servo]]:
    """A function (state, servo, command, t, seconds) -> state and servo after these seconds.

    Runge-Kutta 4 for the state, closed form for the actuators under a constant command.
    """
    rates, K = state_rates(model.form, model.terms, model.winds), model.K
    _, lag, series = model.added_input_map(K)
    # The closed form requires two positive and distinct time constants [s].
    first, second = max(K.lag + lag, 1e-6), max(series, 1e-7)
    second *= 1.0001 if abs(first / second - 1.0) < 1e-4 else 1.0

    def advance(
        x: list[float], servo: Servo, command: Array, t: float, seconds: float
    ) -> tuple[list[float], Servo]:
        steps = ceil(seconds / STEP_S - 1e-6)
        h, state = seconds / max(steps, 1), np.array(x)
        for now in t + h * np.arange(steps):
            now = max(float(now), 0.0)  # effects that grow with time start with the table
            half, full = (_follow(servo, command, after, first, second) for after in (0.5 * h, h))
            k1 = np.array(rates(now, state.tolist(), servo[1].tolist(), K))
            k2 = np.array(
                rates(now + 0.5 * h, (state + 0.5 * h * k1).tolist(), half[1].tolist(), K)
            )
            k3 = np.array(
                rates(now + 0.5 * h, (state + 0.5 * h * k2).tolist(), half[1].tolist(), K)
            )
            k4 = np.array(rates(now + h, (state + h * k3).tolist(), full[1].tolist(), K))
            state, servo = state + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4), full
        return state.tolist(), servo

    return advance


def _follow(servo: Servo, command: Array, after: float, a: float, b: float) -> Servo:
    """Step response of two lags in series: a dy/dt = u - y, b dz/dt = y - z, constant u."""
    initial = servo[0] - command
    decayed, share = initial * np.exp(-after / a), a / (a - b)
    own_mode = (servo[1] - command - share * initial) * np.exp(-after / b)  # homogeneous part of z
    return command + decayed, command + share * decayed + own_mode


def _figure_eights(
    rng: np.random.Generator, seconds: float, one_way: bool, excitation: float
) -> Pilot:
    """A pilot for one flight: left around the circle at +x, right around that at -x, multisines.

    The speed varies, so that slow turns excite a stall; about every 12 s a low pass excites the
    ground effect.
    """
    frequency, phase = 2.0 * pi * rng.uniform(0.15, 1.6, (6, 4)), rng.uniform(0.0, 2.0 * pi, (6, 4))
    amplitude = excitation * np.array([0.035, 0.07, 0.06, 0.08])
    passes = np.arange(7.0, seconds + 12.0, 12.0)
    passes = passes + rng.uniform(-3.0, 3.0, len(passes))
    down = HEIGHT - rng.uniform(0.4, 0.9, len(passes))
    period, begin = rng.uniform(14.0, 22.0), rng.uniform(0.0, 2.0 * pi)
    side, far = 1.0, False  # which circle, and whether its outer end was passed
    trim = 0.05  # elevator trim, integrated in flight so that each aircraft keeps its height

    def pilot(t: float, state: list[float]) -> Array:
        nonlocal side, far, trim
        px, py, height, pitch, _, roll, vx, vy, vz = state[:9]
        far = far or side * px > RADIUS + 1.0
        if far and side * px < 3.5 and not one_way:
            side, far = -side, False
        outside = min(max(0.15 * (hypot(px - RADIUS * side, py) - RADIUS), -1.2), 1.2)
        course = atan2(py, px - RADIUS * side) + side * (0.5 * pi + outside)
        to_the_right = (atan2(vy, vx) - course + pi) % (2.0 * pi) - pi
        # A steep turn loses height: limit the bank near the floor.
        most = min(0.85, 0.4 + 0.6 * max(height + 0.4 * vz, 0.0))
        bank = min(max(-0.75 * side + 1.4 * to_the_right, -most), most)
        target = HEIGHT - float(np.max(down * np.exp(-(((t - passes) / 2.5) ** 2))))
        target += 3.0 * max(0.8 - height - 0.6 * vz, 0.0)  # near the floor within 0.6 s
        climb = min(max(0.9 * (target - height), -0.8), 0.8)
        trim += 0.1 * ROW_S * (target - height)
        speed = SPEED + 0.6 * np.sin(2.0 * pi * t / period + begin)
        commands = (
            0.4 + 0.3 * (speed - hypot(vx, vy, vz)) + 0.15 * climb,
            1.1 * (bank - roll),
            trim
            + 2.0 * (0.1 + 0.2 * (climb - vz) + 0.1 * roll**2 - pitch)
            + 0.55 * min(roll**2, 1.2),
            0.25 * bank,
        )
        return np.clip(
            commands + amplitude * np.sin(frequency * t + phase).sum(axis=0),
            [0.0, -1.0, -1.0, -1.0],
            1.0,
        )

    return pilot


def _after_lead(rows: Array) -> Array:
    return rows[round(LEAD_S / ROW_S) :]


# Measurement
# -----------


class _Camera:
    """Measures poses; its position-dependent error map is the same for every flight."""

    def __init__(
        self, seed: int, noise: Noise, correlated: bool, pose_bias: float, jitter: float
    ) -> None:
        rng = np.random.default_rng(seed)
        self.seed, self.correlated, self.jitter = seed, correlated, jitter
        self.sigma: Array = np.repeat(np.array(NOISE[noise]), 3)
        self.bias = pose_bias / self.sigma[0]
        directions = rng.normal(size=(3, 6))
        self.waves = (
            2.0 * pi / rng.uniform(5.0, 15.0, 6) * directions / np.linalg.norm(directions, axis=0)
        )
        self.phase = rng.uniform(0.0, 2.0 * pi, 6)

    def table(
        self,
        name: str,
        number: int,
        flown: Flown,
        model: Model | None = None,
        stamp_delay: float = 0.0,
    ) -> FlightTable:
        """Flight table from time zero; images are older than their stamps by stamp_delay [s]."""
        from scipy.interpolate import CubicSpline

        rng = np.random.default_rng([self.seed, number, 3])
        (states, commands), K = flown, model.K if model else None
        t = np.arange(float(len(states))) * ROW_S - LEAD_S
        poses = _after_lead(
            CubicSpline(t, states[:, :6])(t - stamp_delay) if stamp_delay else states[:, :6]
        )
        pose = poses[:, [0, 1, 2, 5, 3, 4]].T  # channels first: x y z roll pitch yaw
        for effect in model.effects if model else ():
            if measure := effect.hidden_map or effect.measurement_map:
                pose = measure(pose, K)
        error = self._error(rng, poses[:, :3])
        stamps = rng.uniform(-self.jitter, self.jitter, len(poses))
        attitude = wrap_angle(pose[3:].T + error[:, 3:])
        t, p_world = np.round(_after_lead(t) + stamps, 5), pose[:3].T + error[:, :3]
        return FlightTable(
            name,
            t,
            p_world,
            attitude,
            _after_lead(commands),
            labels={"source": ("simulated",) * len(t)},
        )

    def _error(self, rng: np.random.Generator, p_world: Array) -> Array:
        """Errors (N, 6) of px, py, pz, roll, pitch, yaw; nan where the pose is missing."""
        count = len(p_world)
        error = rng.normal(size=(count, 6))
        if self.correlated:
            slow, decay = rng.normal(size=(count, 6)), np.exp(-ROW_S / CORRELATION_S)
            for k in range(1, count):
                slow[k] = decay * slow[k - 1] + np.sqrt(1.0 - decay**2) * slow[k]
            error = np.sqrt(0.5) * (error + slow)
        error = self.sigma * (error + self.bias * np.sin(p_world @ self.waves + self.phase))
        outlier, missing = rng.random(count) < OUTLIERS, rng.random(count) < MISSING
        error[outlier] += rng.normal(size=(int(outlier.sum()), 6)) * np.repeat([3.0, 0.8], 3)
        error[missing] = np.nan
        return error
