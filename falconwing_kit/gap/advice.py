"""Advice: a verdict -> one sentence about it, and the test manoeuvre to fly next, from a library
that is simulated leg by leg.

The nominal model flies every manoeuvre of a small library; its Fisher information, added to the
flight's own, predicts how well effects would be separated or sized.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import permutations
from typing import Any

import numpy as np

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.model import Model
from falconwing_kit.aircraft.trim import COMMAND_LIMITS, Trim, trim
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.messages import COMMAND_NAMES
from falconwing_kit.gap.baseline import VERY_STRONG_EVIDENCE, NominalModel
from falconwing_kit.gap.name import EffectCandidate, Naming
from falconwing_kit.gap.noise import whiten
from falconwing_kit.sysid.fit import FitResult, Prior, prior_rows
from falconwing_kit.sysid.prepare import PreparedFlight
from falconwing_kit.sysid.shooting import (
    FIRST_ROW,
    WARMUP_ROWS,
    Windows,
    cut_windows,
    finite_differences,
    fly_windows,
    jacobian,
)
from falconwing_kit.sysid.uncertainty import ordinary_size

# Chi2 to be added: an effect ahead by one margin may have to fall behind by one.
SEPARATION_CHI2 = 2.0 * VERY_STRONG_EVIDENCE
COMPARISON_S = 30.0  # flight time after which manoeuvres are compared
SECONDS = np.geomspace(2.0, 600.0, 16)  # flight times at which the growth of evidence is computed
MAX_ANGLE = math.radians(75.0)  # of pitch and roll in a leg; a pilot would end a steeper one
# Share of the descent angle that idle throttle gives: at all of it rounding and curvature can ask
# for a throttle below 0, which `trim` refuses.
ALMOST_IDLE = 0.97
# Centres of successive legs, in quarters of the area flown.
LEG_OFFSETS = np.array([[0, 0], [1, 1], [-1, -1], [1, -1], [-1, 1]])

InputSignal = Callable[[Array], Any]  # time since the start of a leg [s] -> added to the trim


def doublet_input(size: float) -> InputSignal:
    """0, +size, -size for 0.3 s each, repeated."""
    return lambda t: np.array([0.0, size, -size])[np.round(t / 0.3 - 0.4).astype(int) % 3]


def step_input(size: float) -> InputSignal:
    """A step after half a second."""
    return lambda t: size * (t >= 0.5)


def sine_input(size: float, frequency_hz: float) -> InputSignal:
    """A sine."""
    return lambda t: size * np.sin(2.0 * np.pi * frequency_hz * t)


@dataclass(frozen=True)
class Leg:
    """Two seconds of a manoeuvre: a trimmed initial state, and the control inputs from there."""

    sticks: Mapping[str, InputSignal] = field(default_factory=dict)  # names of COMMAND_NAMES
    speed: float = 1.0  # relative to the median speed of the baseline flight
    height: float = 2.0  # [m]
    bank: float = 0.0  # [rad], positive right wing down
    heading: float = 0.0  # of the flight over the floor [rad], from x to the left
    glide: bool = False  # throttle closed, descending at constant speed
    beside: float | None = None  # passes the place this far to its left [m]; None: any place
    later: float = 0.0  # delay after the other legs [s]


@dataclass(frozen=True)
class DiagnosisManoeuvre:
    """A test manoeuvre that a student pilot can fly in a hall."""

    name: str
    how: str  # completes the sentence "fly ..."
    legs: tuple[Leg, ...]


def _both_directions(*legs: Leg) -> tuple[Leg, ...]:
    return (*legs, *(replace(leg, heading=leg.heading + math.pi) for leg in legs))


_POWER = (
    *(Leg({"throttle": step_input(s)}, speed=v) for v in (0.9, 1.1) for s in (0.3, -0.15)),
    Leg(height=3.5, glide=True),
)
_STEPS = (("aileron", 0.15), ("elevator", 0.2), ("rudder", 0.3))
DIAGNOSIS_MANOEUVRES = (
    DiagnosisManoeuvre(
        "aileron doublets", "quick aileron doublets, half and full, without rudder",
        _both_directions(*(Leg({"aileron": doublet_input(s)}) for s in (0.4, -0.4, 0.8, -0.8))),
    ),
    DiagnosisManoeuvre(
        "elevator doublets", "elevator doublets at a slow and at a fast speed",
        _both_directions(*(
            Leg({"elevator": doublet_input(s)}, v) for v in (0.85, 1.2) for s in (0.25, -0.25)
        )),
    ),
    DiagnosisManoeuvre(
        "rudder doublets", "rudder doublets without aileron",
        _both_directions(*(Leg({"rudder": doublet_input(s)}) for s in (0.5, -0.5))),
    ),
    DiagnosisManoeuvre(
        "throttle steps", "throttle steps with the wings level and no other control input",
        _both_directions(*_POWER[:4]),
    ),
    DiagnosisManoeuvre(
        "glides",
        "glides with the throttle closed, slow and fast, and throttle steps at the same speeds",
        _both_directions(
            *(Leg(speed=v, height=3.5, glide=True) for v in (0.85, 1.0, 1.2)), *_POWER[:4]
        ),
    ),
    DiagnosisManoeuvre(
        "low passes",
        "low passes at 0.4 m right after level flight at 2 m, at the same speed and throttle",
        _both_directions(
            Leg(height=0.4), Leg(height=2.0), Leg({"elevator": doublet_input(0.1)}, height=0.6)
        ),
    ),
    DiagnosisManoeuvre(
        "slow flight", "slow flight, wings level, down to the first signs of a stall",
        _both_directions(*(
            Leg({"elevator": doublet_input(s)}, v) for v in (0.85, 0.75, 0.68) for s in (0.1, -0.1)
        )),
    ),
    DiagnosisManoeuvre(
        "fast flight", "fast flight, wings level",
        _both_directions(*(Leg(speed=v) for v in (1.2, 1.35))),
    ),
    DiagnosisManoeuvre(
        "speed sweep", "a sweep from the slowest safe speed to the fastest, wings level",
        _both_directions(*(Leg(speed=v) for v in (0.75, 0.9, 1.05, 1.2, 1.35))),
    ),
    DiagnosisManoeuvre(
        "steep turns", "steep turns to the left and to the right at one speed",
        _both_directions(*(Leg(bank=math.radians(b)) for b in (-50.0, -35.0, 35.0, 50.0))),
    ),
    DiagnosisManoeuvre(
        "circles", "wide circles through all headings, to the left and to the right",
        tuple(
            Leg(bank=math.radians(b), heading=k * math.pi / 2.0)
            for b in (-25.0, 25.0) for k in range(4)
        ),
    ),
    DiagnosisManoeuvre(
        "passes",
        "repeated passes through one place of the hall in both directions, and beside it",
        tuple(
            Leg(heading=k * math.pi / 2.0, beside=b) for k in range(4) for b in (-1.5, 0.0, 1.5)
        ),
    ),
    DiagnosisManoeuvre(
        "shaking", "fast sine inputs, up to 2 Hz, and single steps of each control",
        (
            *(Leg({c: sine_input(0.4, f)}) for c in COMMAND_NAMES[1:] for f in (1.0, 2.0)),
            *(Leg({channel: step_input(s)}) for channel, s in _STEPS),
        ),
    ),
    DiagnosisManoeuvre(
        "hands off", "straight flight with the hands off the sticks, slow and fast",
        _both_directions(*(Leg(speed=v) for v in (0.8, 1.2))),
    ),
    DiagnosisManoeuvre(
        "small movements", "small movements of aileron, elevator and rudder beside large ones",
        tuple(Leg({c: sine_input(s, 0.7)}) for c in COMMAND_NAMES[1:] for s in (0.06, 0.12, 0.5)),
    ),
    DiagnosisManoeuvre(
        "early and late",
        "the same throttle steps and glides early in a flight and again two minutes later",
        (*_POWER, *(replace(leg, later=120.0) for leg in _POWER)),
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Advice:
    """What a manoeuvre would add to the flight that was flown."""

    manoeuvre: DiagnosisManoeuvre
    chi2: float = math.nan  # by which the alternatives differ after COMPARISON_S
    seconds: float = math.nan  # until they differ by SEPARATION_CHI2; inf: beyond SECONDS
    shrinkage: float = math.nan  # share by which the widest interval shrinks in COMPARISON_S
    widest: str = ""  # parameter with that 95 % interval


def manoeuvre_windows(
    base: NominalModel,
    like: Windows,
    place: Array | None = None,
    manoeuvres: Sequence[DiagnosisManoeuvre] = DIAGNOSIS_MANOEUVRES,
) -> tuple[Windows, tuple[DiagnosisManoeuvre, ...]]:
    """Manoeuvres as windows, one per leg, with poses of the nominal model and the baseline's noise.

    Args:
        base: the nominal model.
        like: windows of a flight: the area flown, and the rate of poses.
        place: (2,) that passes lead through [m]; None: as the other legs.
        manoeuvres: what to fly.

    Returns:
        The windows, and the manoeuvres that this aircraft can fly; windows.flight is their index.

    Raises:
        InputError: it can fly none of them.
    """
    model = base.result.model
    rows, interval = like.nodes.shape[1], float(np.median(np.diff(like.nodes)))
    low, high = np.percentile(like.initial_guess[:, :2], [5.0, 95.0], axis=0)
    usual = float(np.median(np.linalg.norm(base.windows.initial_guess[:, 6:9], axis=1)))

    @cache
    def trimmed(speed: float, bank: float, height: float, glide: bool) -> Trim:
        return (
            _trim_glide(model, speed * usual, height)
            if glide
            else trim(model, speed * usual, 0.0, bank, height)
        )

    flights, flown = [], []
    for m in manoeuvres:
        try:
            trims = [trimmed(leg.speed, leg.bank, leg.height, leg.glide) for leg in m.legs]
        except InputError:
            continue  # beyond a limit of this aircraft
        middles = (
            0.5 * (low + high)
            + 0.25 * (high - low) * LEG_OFFSETS[np.arange(len(m.legs)) % len(LEG_OFFSETS)]
        )
        at = [
            q if leg.beside is None or place is None else place
            for q, leg in zip(middles, m.legs, strict=True)
        ]
        flights.append(_build_flight(m, trims, at, rows, interval, base.found.sigma))
        flown.append(m)
    if not flown:
        raise InputError(
            "manoeuvres: expected one that the model can be trimmed for, got none: check the model"
        )
    windows = whiten(cut_windows(flights, model, rows * interval), base.noise)
    return replace(
        windows, pose=fly_windows(model, windows, windows.initial_guess[:, : model.n_states])
    ), tuple(flown)


def _build_flight(
    manoeuvre: DiagnosisManoeuvre,
    trims: Sequence[Trim],
    middles: Sequence[Array],
    rows: int,
    interval: float,
    sigma: Array,
) -> PreparedFlight:
    """One manoeuvre: its legs, each from its own trim and after a pause at that trim."""
    count = FIRST_ROW + rows * len(trims)
    t, state_estimate, commands = (
        interval * np.arange(count, dtype=np.float64),
        np.zeros((count, 12)),
        np.empty((count, 4)),
    )
    commands[:FIRST_ROW] = trims[0].command
    for k, (leg, steady, middle) in enumerate(zip(manoeuvre.legs, trims, middles, strict=True)):
        mine = slice(FIRST_ROW + k * rows, FIRST_ROW + (k + 1) * rows)
        # The row before the leg acts until its first command.
        commands[mine.start - 1 : mine.stop] = steady.command
        for channel, move in leg.sticks.items():
            commands[mine, COMMAND_NAMES.index(channel)] += move(
                interval * np.arange(rows, dtype=np.float64)
            )
        state_estimate[mine.start] = _leg_start(steady.state, leg, middle, 0.5 * rows * interval)
        t[mine] += leg.later + k * WARMUP_ROWS * interval
    np.clip(commands, *np.transpose(COMMAND_LIMITS), out=commands)
    return PreparedFlight(
        manoeuvre.name,
        t,
        np.zeros((count, 6)),
        commands,
        sigma,
        state_estimate,
        np.zeros_like(state_estimate),
    )


def _leg_start(state: Array, leg: Leg, middle: Array, half_time: float) -> Array:
    """(12,) a trimmed state at the leg's heading, on a straight line through its centre."""
    x = np.zeros(12)
    x[: len(state)] = state
    along = np.array([math.cos(leg.heading), math.sin(leg.heading)])
    left = np.array([-along[1], along[0]])
    x[4] -= leg.heading  # yaw is positive to the right
    x[6:8] = state[6] * along + state[7] * left
    x[:2] = middle + (leg.beside or 0.0) * left - half_time * x[6:8]
    return x


def _trim_glide(model: Model, speed: float, height: float) -> Trim:
    """Trim of a descent at constant speed with the throttle at idle.

    The throttle that a descent needs is almost linear in its angle: two trims, level and slightly
    down, give the angle at which it is 0. The trim just before that angle is found, and its small
    remaining throttle closed.

    Args:
        speed: through the air [m/s].
        height: [m].

    Raises:
        InputError: the aircraft has no such trim.
    """
    slightly_down = 0.03  # [rad]
    level, down = (
        trim(model, speed, climb_angle=climb, bank=0.0, height=height)
        for climb in (0.0, -slightly_down)
    )
    to_idle = slightly_down * level.command[0] / (level.command[0] - down.command[0])
    glide_trim = trim(model, speed, climb_angle=-ALMOST_IDLE * to_idle, bank=0.0, height=height)
    return replace(glide_trim, command=glide_trim.command * np.array([0.0, 1.0, 1.0, 1.0]))


def noncentrality(gram: Array, signal: Array, free: np.ndarray, prior: Array) -> Array:
    """Expected chi2 of a signal after the best fit by free columns [Wald 1943].

    min over b of |C s + C_f b|^2 + b' P b = s' G s - s' G_f (G_ff + P_ff)^-1 G_f' s,  G = C' C

    Args:
        gram: (..., C, C) G, products of all columns; those of flights add.
        signal: (C,) s, the signal as a combination of columns.
        free: (F,) which columns are free.
        prior: (P, P) prior precision of the first P columns, all free ones among them.

    Returns:
        (...) chi2.
    """
    seen = gram @ signal
    pulled = seen[..., free]
    normal = gram[..., free[:, None], free] + prior[np.ix_(free, free)]
    normal = normal + 1e-9 * np.einsum("...ii->...i", normal)[..., None] * np.eye(len(free))
    taken = np.einsum("...f,...f->...", pulled, np.linalg.solve(normal, pulled[..., None])[..., 0])
    return np.asarray(np.maximum(seen @ signal - taken, 0.0))


@dataclass(frozen=True)
class _ExperimentDesign:
    """Information of a flight and each manoeuvre on C columns: P parameters, then the effects."""

    manoeuvres: tuple[DiagnosisManoeuvre, ...]
    known: Array  # (C, C) products of the columns over the flight
    rates: Array  # (M, C, C) the same per second of each manoeuvre
    prior: Array  # (P, P) precision of what was known before
    names: tuple[str, ...]  # (P,) parameters, the aircraft's and then the effects'
    sizes: Array  # (P,) ordinary sizes of these
    effects: tuple[Effect, ...]
    reduced_chi2: float  # unit of chi2

    @classmethod
    def of(
        cls,
        base: NominalModel,
        flown: FitResult,
        windows: Windows,
        prior: Prior | None,
        found: Sequence[EffectCandidate] = (),
    ) -> "_ExperimentDesign":
        """From a fit of a flight without the effects, and the effects as found."""
        model, free = base.result.model, flown.free
        # Values of a linear scan may lie outside their bounds.
        bounds = {p.name: (p.low, p.high) for c in found for p in c.effect.parameters}
        found = [
            replace(c, values={n: float(np.clip(v, *bounds[n])) for n, v in c.values.items()})
            for c in found
        ]
        places = [np.array([c.values[n] for n in c.effect.place]) for c in found if c.effect.place]
        ahead, manoeuvres = manoeuvre_windows(base, windows, places[0] if places else None)
        initial_states = ahead.initial_guess[:, : model.n_states]
        legs = _gram_matrices(
            model, ahead, initial_states, *jacobian(model, ahead, initial_states, free)[1:], found
        )
        rates = np.stack(
            [
                legs[ahead.flight == k].sum(axis=0) / (2.0 * len(m.legs))
                for k, m in enumerate(manoeuvres)
            ]
        )
        gentle = np.all(np.abs(ahead.pose[..., 3:5]) < MAX_ANGLE, axis=(1, 2))
        can = np.array([k for k in range(len(rates)) if gentle[ahead.flight == k].all()], dtype=int)
        known = _gram_matrices(
            flown.model,
            windows,
            flown.initial_states,
            flown.parameter_jacobian,
            flown.initial_state_jacobian,
            found,
        ).sum(axis=0)
        own = [(model.parameters[i], model.vector[i]) for i in free]
        all_of = own + [(p, c.values[p.name]) for c in found for p in c.effect.parameters]
        rows, _ = prior_rows(model, free, prior)
        return cls(
            tuple(manoeuvres[k] for k in can), known, rates[can],
            np.pad(rows.T @ rows, (0, len(all_of) - len(own))),
            tuple(p.name for p, _ in all_of),
            np.array([ordinary_size(*pair) for pair in all_of]),
            tuple(c.effect for c in found), base.reduced_chi2,
        )  # fmt: skip

    def discriminability(self) -> tuple[Advice, ...]:
        """How soon each effect would be separated from the others, the worst of all pairs."""
        times = np.append(SECONDS, COMPARISON_S)
        ahead = self.known + times[:, None, None] * self.rates[:, None]
        added = [
            self._difference(true, fitted, ahead) - self._difference(true, fitted, self.known)
            for true, fitted in permutations(range(len(self.effects)), 2)
            if self.effects[true].name
            not in self.effects[fitted].contains  # a more general form of it always fits
        ]
        worst = np.min(added, axis=0)
        reached = [
            float(np.interp(SEPARATION_CHI2, np.maximum.accumulate(c[:-1]), SECONDS, right=np.inf))
            for c in worst
        ]
        table = [
            Advice(m, float(c[-1]), s)
            for m, c, s in zip(self.manoeuvres, worst, reached, strict=True)
        ]
        return tuple(sorted(table, key=lambda a: (a.seconds, -a.chi2)))

    def _difference(self, true: int, fitted: int, gram: Array) -> Array:
        """Expected chi2 (...) by which an effect is fitted worse by another one than by itself."""
        signal = np.zeros(gram.shape[-1])
        signal[len(self.names) + true], signal[len(self.names) + fitted] = 1.0, -1.0
        others = {p.name for k, e in enumerate(self.effects) if k != fitted for p in e.parameters}
        free = np.array([i for i, name in enumerate(self.names) if name not in others])
        return noncentrality(gram, signal, free, self.prior) / self.reduced_chi2

    def interval_reduction(self, wanted: Sequence[str]) -> tuple[Advice, ...]:
        """By which share the widest interval of these parameters shrinks."""
        at = [self.names.index(name) for name in wanted]
        now, after = (
            self._widths(self.known)[at],
            self._widths(self.known + COMPARISON_S * self.rates)[:, at].max(axis=1),
        )
        widest = wanted[int(np.argmax(now))]
        shrinkage = (1.0 - after / now.max()).tolist()
        table = [
            Advice(m, shrinkage=n, widest=widest)
            for m, n in zip(self.manoeuvres, shrinkage, strict=True)
        ]
        return tuple(sorted(table, key=lambda a: -a.shrinkage))

    def _widths(self, gram: Array) -> Array:
        """(..., P) half 95 % intervals in ordinary sizes."""
        n = len(self.names)
        normal = gram[..., :n, :n] / self.reduced_chi2 + self.prior
        scale = 1.0 / np.sqrt(np.maximum(np.einsum("...ii->...i", normal), 1e-30))
        even = normal * scale[..., :, None] * scale[..., None, :] + 1e-9 * np.eye(n)
        return np.asarray(
            1.96 * np.sqrt(np.einsum("...ii->...i", np.linalg.inv(even))) * scale / self.sizes
        )


def _gram_matrices(
    model: Model,
    windows: Windows,
    initial_states: Array,
    parameter_jacobian: Array,
    initial_state_jacobian: Array,
    found: Sequence[EffectCandidate],
) -> Array:
    """(W, C, C) products of the columns of each window, its initial state eliminated."""
    of_effects = [_effect_sensitivities(model, windows, initial_states, c) for c in found]
    sensitivities = np.concatenate(
        [parameter_jacobian, *(c[..., 1:] for c in of_effects), *(c[..., :1] for c in of_effects)],
        axis=-1,
    )
    sensitivities, initial_state_jacobian = (
        np.nan_to_num(c, posinf=0.0, neginf=0.0) for c in (sensitivities, initial_state_jacobian)
    )
    Q, _ = np.linalg.qr(initial_state_jacobian)
    sensitivities = sensitivities - Q @ (Q.transpose(0, 2, 1) @ sensitivities)
    return np.asarray(sensitivities.transpose(0, 2, 1) @ sensitivities)


def _effect_sensitivities(
    model: Model, windows: Windows, initial_states: Array, found: EffectCandidate
) -> Array:
    """(W, R, 1 + A) signal of an effect as found, and its derivative to each parameter there.

    A force acts at a tenth of its size: with free initial states it is far more linear than from
    fixed ones. An input map keeps its size: it is not linear, as half a dead band is another one.
    """
    effect, share = found.effect, 0.1 if found.effect.changes_flow else 1.0
    absent = model.with_effect(effect).with_values({p.name: 0.0 for p in effect.amplitudes})
    small = {p.name: share * found.values[p.name] for p in effect.amplitudes}
    there = absent.with_values({**found.values, **small})
    v, steps = (
        there.values,
        {p.name: 0.1 * ordinary_size(p, found.values[p.name]) for p in effect.parameters},
    )
    beside = [
        there.with_values({n: v[n] + h * (share if n in small else 1.0)}).vector
        for n, h in steps.items()
    ]
    with np.errstate(invalid="ignore"):  # a prediction that diverged
        at, *moved = (
            finite_differences(
                absent, windows, initial_states, np.stack([there.vector, *beside], axis=1)
            )
            / share
        )
        return np.stack(
            [at, *((m - at) / h for m, h in zip(moved, steps.values(), strict=True))], axis=-1
        )


def advise(base: NominalModel, naming: Naming) -> tuple[Advice, ...]:
    """What every manoeuvre of the library would add to a flight, the best first.

    Ambiguous: how soon the alternatives are separated. Named: how far the interval of the effect's
    size shrinks. None: the same for parameters that the baseline flight excites weakly. Empty where
    no flight can help, or the model can fly no manoeuvre.
    """
    found, weak = naming.chosen, _weakly_excited(base) if naming.verdict == "none" else []
    if not (weak or naming.verdict in ("named", "ambiguous")) or _is_indistinguishable(found):
        return ()
    try:
        if weak:
            return _ExperimentDesign.of(base, base.result, base.windows, None).interval_reduction(
                weak
            )
        design = _ExperimentDesign.of(base, naming.before, naming.windows, base.prior, found)
    except InputError:
        return ()
    wanted = [p.name for c in found for p in c.effect.parameters]
    return (
        design.discriminability()
        if naming.verdict == "ambiguous"
        else design.interval_reduction(wanted)
    )


def next_flight(base: NominalModel, naming: Naming) -> str:
    """What to fly next, in one sentence."""
    if naming.verdict == "outside":
        return (
            "fly the calm flight again with nothing changed, to confirm the nominal model; if it "
            "still fits, change one thing at a time and look up in the map of residuals which "
            "variable the excess depends on"
        )
    best = next(iter(advise(base, naming)), None)
    if naming.verdict == "none":
        shy = (
            f"; the calm flight hardly excited {_join_names(_weakly_excited(base)[:4])}: fly "
            f"{_shrinkage_text(best)}"
            if best
            else ""
        )
        return (
            "nothing needs to be separated; a smaller effect would show in a longer flight with "
            "larger and faster movements of every control, a sweep of speed, low passes and turns "
            f"both ways{shy}"
        )
    if _is_indistinguishable(naming.chosen):
        return _notes(naming.chosen)
    if best is None:
        return (
            "fly the same again, longer, with larger movements of every control and at more speeds "
            "and heights"
        )
    if naming.verdict == "ambiguous":
        return _discrimination_text([c.effect for c in naming.chosen], best)
    notes = _notes(naming.chosen)
    return f"to know the size better, fly {_shrinkage_text(best)}{'; ' if notes else ''}{notes}"


def headline(naming: Naming) -> str:
    """The verdict in one line."""
    names = [c.effect.name for c in naming.chosen]
    return {
        "named": f"Missing: {_join_names(names, 'and')}",
        "ambiguous": f"Missing: {_join_names(names, 'or')}; this flight does not separate them",
        "none": f"Nothing is missing that this flight could show{_but_incidents(naming)}",
        "outside": "Something is missing, and it is not in the catalogue",
    }[naming.verdict]


def _but_incidents(naming: Naming) -> str:
    times = _join_names([f"{begin:.1f} to {end:.1f} s" for begin, end in naming.incidents], "and")
    return f", but for incidents (such as a stall) at {times}" if times else ""


def _discrimination_text(effects: Sequence[Effect], best: Advice) -> str:
    names, at = [e.name for e in effects], best.manoeuvre.name
    reasons = ", ".join(e.separated_by[at] for e in effects if at in e.separated_by)
    fly = f"fly {best.manoeuvre.how}{': ' if reasons else ''}{reasons}"
    if math.isinf(best.seconds):
        return (
            f"{SECONDS[-1] / 60.0:.0f} min of one manoeuvre would not separate "
            f"{_join_names(names)}; the best of all, {fly}"
        )
    seconds = 10 * math.ceil(best.seconds / 10.0)
    return f"to separate {_join_names(names)}, {seconds} s should be enough: {fly}"


def _shrinkage_text(best: Advice) -> str:
    name = best.widest.replace("_", " ")
    return (
        f"{best.manoeuvre.how}; {COMPARISON_S:.0f} s narrow the 95 % interval of {name} by "
        f"{100.0 * best.shrinkage:.0f} %"
    )


def _is_indistinguishable(found: Sequence[EffectCandidate]) -> bool:
    """Whether one of the effects has the dynamics of another."""
    return any(c.effect.same_as for c in found)


def _notes(found: Sequence[EffectCandidate]) -> str:
    """What no flight separates, of all effects found."""
    twins = (f"no flight separates {c.effect.name} from {c.effect.same_as}" for c in found)
    notes = (
        c.effect.note or (twin if c.effect.same_as else "")
        for c, twin in zip(found, twins, strict=True)
    )
    return "; ".join(dict.fromkeys(filter(None, notes)))


def _weakly_excited(base: NominalModel) -> list[str]:
    return [n for n in base.found.uncertainty.not_excited if n not in ("delay", "lag")]


def _join_names(names: Sequence[str], word: str = "and") -> str:
    plain = [name.replace("_", " ") for name in names]
    return (
        f" {word} ".join([", ".join(plain[:-1]), plain[-1]]) if len(plain) > 1 else "".join(plain)
    )
