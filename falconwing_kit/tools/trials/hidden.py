"""Hidden effects: seed -> a baseline flight, a flight with an effect, and the truth. Simulated.

Each case is an aircraft of its own (coefficients spread by 15 %), its second flight on another day
(1 %). The simulation differs from the model that a fit integrates: servos in closed form, steps of
10 ms at most, from one arriving command to the next.
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
Flown = tuple[Array, Array]  # true states (N, 12) and commands (N, 4), from LEAD_S before the table
Servo = tuple[Array, Array]  # positions (4,) of the servos, and after the lag in series

NOISE: dict[Noise, tuple[float, float]] = {  # standard deviation per axis [m], [rad]
    "marker": (0.03, radians(0.6)), "hybrid": (0.10, radians(1.3)), "net": (0.26, radians(3.0)),
}  # fmt: skip
CORRELATION_S, OUTLIERS, MISSING = 0.5, 0.005, 0.01  # of correlated noise; shares of the poses
AIRCRAFT_SPREAD, DAY_SPREAD = 0.15, 0.01
ROW_S, STEP_S, LEAD_S = (
    0.05,
    0.01,
    2.0,
)  # between rows; longest step, 2.5 times finer than a fit's; flown beforehand
RADIUS, HEIGHT, SPEED = FLIGHT_RADIUS_M, 2.3, 6.9  # of the circles flown [m], [m], [m/s]
HALL = (
    20.0,
    14.0,
    5.0,
)  # m, |x|, |y|, height: the arena of 40 x 20 x 5 m with 4 m to spare on its long sides
ATTEMPTS, SAME_SIZE = (
    40,
    10,
)  # a size is tried ten times before it is drawn anew, or large effects would get rare


@dataclass(frozen=True)
class HiddenCase:
    """A pair of flights of one aircraft, and the effect in the second."""

    calm: FlightTable
    flight: FlightTable
    truth: dict[
        str, Any
    ]  # effect, size in the catalogue's parameters, noise, how it was measured, seed, simulated
    model: Model = field(repr=False)  # that flew the second flight, the effect included
    true_states: tuple[Array, Array] = field(
        repr=False
    )  # (N, 12) of both flights at their rows, SI


def hidden_seed(student: str, salt: str) -> int:
    """The seed of a student's case: HMAC-SHA256 of the name under the instructor's salt [RFC 2104].

    Without the salt the seed of a name cannot be computed.

    Args:
        student: name or number; spaces around it do not count.
        salt: the instructor's secret of this course, at least 16 characters.

    Returns:
        A seed of 48 bits.

    Raises:
        InputError: no student, or a salt so short that it could be guessed.
    """
    who = unicodedata.normalize("NFC", student).strip()
    if not who:
        raise InputError("student: expected a name or a number, got nothing")
    if len(salt) < 16:
        raise InputError(
            f"salt: expected at least 16 characters that cannot be guessed, got {len(salt)}"
        )
    return int.from_bytes(hmac.new(salt.encode(), who.encode(), hashlib.sha256).digest()[:6], "big")


def hidden_case(
    seed: int, effect: str | None = None, *, size: Mapping[str, float] | None = None, **how: Any
) -> HiddenCase:
    """Fly one case; the same arguments give the same case to the last bit.

    Args:
        seed: of everything that is drawn, >= 0.
        effect: "none", a name of the catalogue, or two joined by "+"; None draws "none" or one of
            the effects with a frozen number, so that an effect added later changes no seed.
        size: all parameters of the effect by their names in the catalogue (those of the other
            effect for one that is the same as another); None draws them, log-uniform from just
            visible at this noise to plainly visible.
        how: noise, seconds and whatever else `hidden_flights` takes by name.

    Returns:
        The case.

    Raises:
        InputError: an argument is out of range, or no flight with this effect stays in the hall.
    """
    return hidden_flights(seed, [effect], sizes=[size], **how)[0]


def hidden_flights(
    seed: int, effects: Sequence[str | None], *, noise: Noise = "marker", correlated: bool = False,
    sizes: Sequence[Mapping[str, float] | None] | None = None, calm_seconds: float = 120.0,
    flight_seconds: float = 90.0, one_way: bool = False, excitation: float = 1.0, pose_bias: float = 0.0,
    jitter: float = 0.0, catalogue: Sequence[Effect] = CATALOGUE,
) -> tuple[HiddenCase, ...]:  # fmt: skip
    """One aircraft, one calm flight, and for each effect a flight on another day.

    The baseline flight is the same object in every case, so that one identification serves all.
    The first case is that of `hidden_case` for the first effect.

    Args:
        seed: of everything that is drawn, >= 0.
        effects: at least one, each as for `hidden_case`.
        noise: of the poses, white: "marker" (0.03 m, 0.6 deg per axis), "hybrid" (0.10 m, 1.3 deg)
            or "net" (0.26 m, 3 deg); besides, 0.5 % of them are far off and 1 % are missing.
        correlated: half of the noise's variance is AR(1) with 0.5 s instead.
        sizes: one for each effect as for `hidden_case`, or None to draw all.
        calm_seconds: length of the calm flight [s].
        flight_seconds: length of each other flight [s].
        one_way: circle to the left only, in all flights.
        excitation: amplitude of the pilot's excitation; 1 excites every parameter, 0 is none.
        pose_bias: amplitude of a pose error that is a smooth function of place, the same in all
            flights [m]; of angles as many sigmas as of places.
        jitter: stamps are off by up to this much [s].
        catalogue: the effects that may be hidden; those with `sizes` and `draw` can be drawn.

    Returns:
        The cases, in the order of the effects.

    Raises:
        InputError: as for `hidden_case`.
    """
    sizes = [None] * len(effects) if sizes is None else sizes
    _require(effects, sizes, noise, catalogue)
    for name, value, low, high in (
        ("seed", seed, 0.0, inf), ("calm_seconds", calm_seconds, 1.0, 3600.0), ("pose_bias", pose_bias, 0.0, 2.0),
        ("flight_seconds", flight_seconds, 1.0, 3600.0), ("excitation", excitation, 0.0, 2.0),
        ("jitter", jitter, 0.0, 0.02),
    ):  # fmt: skip
        require_range(name, value, low=low, high=high)

    fly = partial(
        _fly_anew, noise=noise, one_way=one_way, excitation=excitation, catalogue=catalogue
    )
    camera = _Camera(seed, noise, correlated, pose_bias, jitter)
    aircraft, _, calm_flown = fly(
        [seed, 0], rates_model(), AIRCRAFT_SPREAD, "none", None, calm_seconds
    )
    calm = camera.table("calm.csv", 0, calm_flown)
    told = {
        "noise": noise, "correlated_noise": correlated, "pose_bias": pose_bias, "jitter": jitter, "one_way": one_way,
        "excitation": excitation, "seed": seed, "simulated": True,
    }  # fmt: skip
    cases = []
    for number, (asked, size) in enumerate(zip(effects, sizes, strict=True), start=1):
        effect = asked or _drawn_name(np.random.default_rng([seed, number]), catalogue)
        model, drawn, flown = fly(
            [seed, number], aircraft, DAY_SPREAD, effect, size, flight_seconds
        )
        stamps = [e.hidden_stamp_delay for e in catalogue if e.name in _names(effect)]
        late = sum(delay(model.K) for delay in stamps if delay)
        flight = camera.table("flight.csv", number, flown, model, late)
        truth = {"effect": effect, "size": drawn, "number": number, **told}
        cases.append(
            HiddenCase(
                calm, flight, truth, model, (_after_lead(calm_flown[0]), _after_lead(flown[0]))
            )
        )
    return tuple(cases)


def write_hidden(
    out: str | Path, cases: Mapping[str, HiddenCase], answers: str | Path | None = None
) -> None:
    """Write OUT/<name>/calm.csv and flight.csv of each case, and the answers if a file is given.

    Args:
        out: folder that is handed out; made where it is missing.
        cases: by the name of their folder.
        answers: JSON file of all truths by name, in a folder that exists; None writes none.

    Raises:
        InputError: a name is no plain folder name, or a file cannot be written.
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


# What is hidden
# -------------------------------------------------------------------------------------------------------


def _drawn_name(rng: np.random.Generator, catalogue: Sequence[Effect]) -> str:
    """ "none" or an effect of the first version of this draw, each as likely as the others."""
    frozen = dict.fromkeys(e.name for e in catalogue if e.frozen_number is not None)
    return str(rng.choice(["none", *frozen]))


def _require(
    effects: Sequence[str | None],
    sizes: Sequence[Mapping[str, float] | None],
    noise: str,
    catalogue: Sequence[Effect],
) -> None:
    """Refuse what cannot be flown."""
    if noise not in NOISE:
        raise InputError(f"noise: expected one of {', '.join(NOISE)}, got {noise!r}")
    if not effects or len(sizes) != len(effects):
        raise InputError(
            f"effects: expected at least one and a size for each, got {len(effects)} and {len(sizes)} sizes"
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
                f"effect: expected effects with dynamics of their own, got {effect!r}: choose others"
            )
        if size is not None:
            _entries(names, size, catalogue)
        elif undrawn := [name for name in names if not _drawable(name, catalogue)]:
            raise InputError(
                f"effect {undrawn[0]!r}: expected sizes and draw, or a size, got neither: give one"
            )


def _names(effect: str) -> list[str]:
    return [] if effect == "none" else effect.split("+")


def _drawable(name: str, catalogue: Sequence[Effect]) -> list[Effect]:
    """Entries of a name whose size can be drawn."""
    return [e for e in catalogue if e.name == name and e.sizes and e.draw]


def _entries(
    names: Sequence[str], size: Mapping[str, float], catalogue: Sequence[Effect]
) -> list[Effect]:
    """The catalogue's entry of each name that has these parameters; together all of them and no
    others.
    """
    classes = {e.same_as or e.name for e in catalogue if e.name in names}
    possible = [e for e in catalogue if e.name in classes]
    entries = [e for e in possible if all(p.name in size for p in e.parameters)]
    if len(entries) != len(names) or {p.name for e in entries for p in e.parameters} != set(size):
        expected = " or ".join(", ".join(p.name for p in e.parameters) for e in possible)
        raise InputError(
            f"size: expected the parameters {expected or 'of no effect'}, got {', '.join(size) or 'none'}"
        )
    return entries


def _drawn_size(
    names: Sequence[str], rng: np.random.Generator, noise: Noise, catalogue: Sequence[Effect]
) -> dict[str, float]:
    """Parameters of all effects, each size log-uniform between just and plainly visible."""
    size: dict[str, float] = {}
    for name in names:
        effect = _drawable(name, catalogue)[0]
        assert effect.sizes is not None and effect.draw is not None
        marker, net, plain = effect.sizes
        small = {"marker": marker, "hybrid": float(np.sqrt(marker * net)), "net": net}[noise]
        size |= effect.draw(rng, float(np.exp(rng.uniform(np.log(small), np.log(plain)))))
    return size


# Flying
# ---------------------------------------------------------------------------------------------------------------


def _fly_anew(
    seeds: list[int], aircraft: Model, spread: float, effect: str, size: Mapping[str, float] | None, seconds: float,
    noise: Noise, one_way: bool, excitation: float, catalogue: Sequence[Effect],
) -> tuple[Model, dict[str, float], Flown]:  # fmt: skip
    """An aircraft near this one with the effect: model, size, and a flight that stays inside."""
    names = _names(effect)
    for attempt in range(ATTEMPTS):
        rng = np.random.default_rng([*seeds, 1, attempt])
        of_size = np.random.default_rng([*seeds, 2, attempt // SAME_SIZE])
        drawn = (
            _drawn_size(names, of_size, noise, catalogue)
            if size is None
            else {k: float(v) for k, v in size.items()}
        )
        model = _redrawn(aircraft, rng, spread)
        entries = _entries(names, drawn, catalogue)
        for entry in entries:
            model = model.with_effect(entry)
        model = model.with_values(drawn)
        # An effect found under another's name acts on the images only: the aircraft flies without.
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
    wanted = f"seed {seeds[0]}: expected a flight with {effect} that stays in the hall"
    raise InputError(f"{wanted}, got none in {ATTEMPTS}; take a smaller size or another seed")


def _redrawn(model: Model, rng: np.random.Generator, spread: float) -> Model:
    """Each parameter times exp(spread * normal); where it is zero, 0.1 * spread * normal."""
    drawn = dict(zip(model.names, spread * rng.normal(size=len(model.names)), strict=True))
    return model.with_values(
        {name: model.values[name] * np.exp(d) or 0.1 * d for name, d in drawn.items()}
    )


def _fly(model: Model, pilot: Pilot, seconds: float) -> Flown | None:
    """Fly the lead and the flight; None if the aircraft left the hall."""
    rows, K, advance = round((LEAD_S + seconds) / ROW_S) + 1, model.K, _stepper(model)
    delay = max(K.delay + model.added_input_map(K)[0], 0.0)
    whole = int((delay + 1e-9) / ROW_S)  # rows that a command comes late, and the rest of its delay
    rest = max(delay - whole * ROW_S, 0.0)
    states, sticks, sent = np.empty((rows, 12)), np.empty((rows, 4)), np.empty((rows, 4))
    times = ROW_S * np.arange(rows) - LEAD_S
    x = [0.0, 0.0, HEIGHT, 0.1, 0.0, 0.0, SPEED, 0.0, 0.0, 0.0, 0.0, 0.0]
    servo: Servo | None = None
    for k in range(rows):
        states[k], t = x, times[k]
        if not (abs(x[0]) < HALL[0] and abs(x[1]) < HALL[1] and 0.05 < x[2] < HALL[2]):
            return None
        sticks[k] = pilot(t, x)
        passed = sticks[: k + 1]  # a command map may depend on earlier commands
        for effect in model.effects:
            if effect.command_map:
                passed = effect.command_map(times[: k + 1], passed, K)
        sent[k] = passed[-1]
        servo = servo or (sent[0], sent[0])
        x, servo = advance(x, servo, sent[max(k - whole - 1, 0)], t, rest)
        x, servo = advance(x, servo, sent[max(k - whole, 0)], t + rest, ROW_S - rest)
    return states, sticks


def _stepper(
    model: Model,
) -> Callable[[list[float], Servo, Array, float, float], tuple[list[float], Servo]]:
    """A function (state, servo, command, t, seconds) -> state and servo after that time."""
    rates, K = state_rates(model.form, model.terms, model.winds), model.K
    _, lag, series = model.added_input_map(K)
    # Both time constants above zero and apart, as the closed form needs [s].
    first, second = max(K.lag + lag, 1e-6), max(series, 1e-7)
    second *= 1.0001 if abs(first / second - 1.0) < 1e-4 else 1.0

    def advance(
        x: list[float], servo: Servo, command: Array, t: float, seconds: float
    ) -> tuple[list[float], Servo]:
        steps = ceil(seconds / STEP_S - 1e-6)
        h, state = seconds / max(steps, 1), np.array(x)
        for now in t + h * np.arange(steps):
            now = max(float(now), 0.0)  # the flight's time starts with the table
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
    """Two lags in series some time after a command, a dy/dt = u - y, b dz/dt = y - z, solved."""
    behind = servo[0] - command
    kept, share = behind * np.exp(-after / a), a / (a - b)
    return command + kept, command + share * kept + (servo[1] - command - share * behind) * np.exp(
        -after / b
    )


def _figure_eights(
    rng: np.random.Generator, seconds: float, one_way: bool, excitation: float
) -> Pilot:
    """A pilot: left around the circle at +x, right around that at -x, with excitation of all inputs.

    Speed changes, so that slow turns show a stall; a low pass every 12 s or so shows ground effect.
    """
    frequency, phase = 2.0 * pi * rng.uniform(0.15, 1.6, (6, 4)), rng.uniform(0.0, 2.0 * pi, (6, 4))
    amplitude = excitation * np.array([0.035, 0.07, 0.06, 0.08])
    passes = np.arange(7.0, seconds + 12.0, 12.0)
    passes = passes + rng.uniform(-3.0, 3.0, len(passes))
    down = HEIGHT - rng.uniform(0.4, 0.9, len(passes))
    period, begin = rng.uniform(14.0, 22.0), rng.uniform(0.0, 2.0 * pi)
    side, far, trim = (
        1.0,
        False,
        0.05,
    )  # the elevator's trim is found on the way, so that each aircraft holds height

    def pilot(t: float, state: list[float]) -> Array:
        nonlocal side, far, trim
        px, py, height, pitch, _, roll, vx, vy, vz = state[:9]
        far = far or side * px > RADIUS + 1.0
        if far and side * px < 3.5 and not one_way:
            side, far = -side, False
        outside = min(max(0.15 * (hypot(px - RADIUS * side, py) - RADIUS), -1.2), 1.2)
        course = atan2(py, px - RADIUS * side) + side * (0.5 * pi + outside)
        to_the_right = (atan2(vy, vx) - course + pi) % (2.0 * pi) - pi
        most = min(
            0.85, 0.4 + 0.6 * max(height + 0.4 * vz, 0.0)
        )  # a steep turn sinks: less of it near the floor
        bank = min(max(-0.75 * side + 1.4 * to_the_right, -most), most)
        wish = HEIGHT - float(np.max(down * np.exp(-(((t - passes) / 2.5) ** 2))))
        wish += 3.0 * max(0.8 - height - 0.6 * vz, 0.0)  # in 0.6 s the floor would be near
        climb = min(max(0.9 * (wish - height), -0.8), 0.8)
        trim += 0.1 * ROW_S * (wish - height)
        speed = SPEED + 0.6 * np.sin(2.0 * pi * t / period + begin)
        sticks = (
            0.4 + 0.3 * (speed - hypot(vx, vy, vz)) + 0.15 * climb,
            1.1 * (bank - roll),
            trim
            + 2.0 * (0.1 + 0.2 * (climb - vz) + 0.1 * roll**2 - pitch)
            + 0.55 * min(roll**2, 1.2),
            0.25 * bank,
        )
        return np.clip(
            sticks + amplitude * np.sin(frequency * t + phase).sum(axis=0),
            [0.0, -1.0, -1.0, -1.0],
            1.0,
        )

    return pilot


def _after_lead(rows: Array) -> Array:
    return rows[round(LEAD_S / ROW_S) :]


# Measuring
# ------------------------------------------------------------------------------------------------------------


class _Camera:
    """Measures poses; the place-dependent errors are the same map for all flights of a seed."""

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
        self, name: str, number: int, flown: Flown, model: Model | None = None, late: float = 0.0
    ) -> FlightTable:
        """The flight's table after the lead, time from zero; images are `late` [s] older than that."""
        from scipy.interpolate import CubicSpline

        rng, (states, sticks), K = (
            np.random.default_rng([self.seed, number, 3]),
            flown,
            model.K if model else None,
        )
        t = np.arange(float(len(states))) * ROW_S - LEAD_S
        poses = _after_lead(CubicSpline(t, states[:, :6])(t - late) if late else states[:, :6])
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
            _after_lead(sticks),
            labels={"source": ("simulated",) * len(t)},
        )

    def _error(self, rng: np.random.Generator, p_world: Array) -> Array:
        """(N, 6) of px, py, pz, roll, pitch, yaw; nan where no pose is measured."""
        count = len(p_world)
        error = rng.normal(size=(count, 6))
        if self.correlated:
            slow, kept = rng.normal(size=(count, 6)), np.exp(-ROW_S / CORRELATION_S)
            for k in range(1, count):
                slow[k] = kept * slow[k - 1] + np.sqrt(1.0 - kept**2) * slow[k]
            error = np.sqrt(0.5) * (error + slow)
        error = self.sigma * (error + self.bias * np.sin(p_world @ self.waves + self.phase))
        off, lost = rng.random(count) < OUTLIERS, rng.random(count) < MISSING
        error[off] += rng.normal(size=(int(off.sum()), 6)) * np.repeat([3.0, 0.8], 3)  # m, rad
        error[lost] = np.nan
        return error
