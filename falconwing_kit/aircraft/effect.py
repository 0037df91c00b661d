"""Effect: one object per candidate for what the model lacks: its equation, how it is found, and
random parameters for simulated flights.

A file of `aircraft/effects` or of a user defines effects; naming, identification, hidden flights
and reports read the fields below and look up no effect by its name.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from falconwing_kit.aircraft.terms import Flow, Loads, Parameter, Term, WindTerm
from falconwing_kit.core.checks import Array, InputError

FLIGHT_RADIUS_M = 4.5  # of the two circles that a hidden flight flies, centred at x = +-4.5 m

LoadsFunction = Callable[[Flow, Any], Loads]  # (air, K) -> loads
Draw = Callable[[np.random.Generator, float], dict[str, float]]  # (rng, size) -> parameter values


@dataclass(frozen=True)
class Effect:
    """A candidate effect. Exactly one of the hooks under "where it acts" is given.

    K has one field per parameter of model and effects; a field is a number or an array that
    broadcasts against the flow, so a hook computes with NumPy and does not branch on values.
    """

    name: str
    physics: str  # one sentence for a student
    parameters: tuple[Parameter, ...]
    # For the report: the equation with {parameter} where its number stands, as in
    # "D/m -> D/m + {drag_added} V^2" ("->": becomes); symbols as in aircraft/terms.py.
    equation: str = ""

    # Where it acts
    loads: LoadsFunction | None = None  # force and moment: (air, K) -> loads
    # Force and moment made from the model's own terms: terms -> the function (air, K) -> loads.
    loads_of: Callable[[tuple[Term, ...]], LoadsFunction] | None = None
    # Wind in world axes [m/s], as in a WindTerm.
    wind_field: Callable[[Any, Any, Any, Any, Any], tuple[Any, Any, Any]] | None = None
    command_map: Callable[[Array, Array, Any], Array] | None = None  # (t, (N, 4), K) -> (N, 4)
    # Input map, K -> (delay, lag, lag in series) added to the model's own [s].
    input_map: Callable[[Any], tuple[Any, Any, Any]] | None = None
    # Measurement map, (pose (6, ...) in the order x y z roll pitch yaw, K) -> pose (6, ...).
    measurement_map: Callable[[Array, Any], Array] | None = None
    same_as: str = ""  # an effect with the same dynamics: found under its name

    # How a flight is searched for it
    starts: tuple[dict[str, float], ...] = ()  # further points where a scan starts
    # Or points over the area flown: (low (2,), high (2,)) in x, y [m] -> points.
    scan_points: Callable[[Array, Array], Sequence[dict[str, float]]] | None = None
    shape: tuple[str, ...] = ()  # parameters that say where or when: no meaning at zero amplitude
    contains: tuple[str, ...] = ()  # effects that it becomes at some values; they are no rivals
    essential: tuple[str, ...] = ()  # parameters without which it is one of those, or no effect
    gradual: bool = False  # grows from the start of the flight, so it has no onset
    of_propeller: bool = False  # a load that the propeller gives, less of which it gives when weak
    acts_on: tuple[str, ...] = ()  # what it changes; two that share one may be formula errors
    place: tuple[str, str] | None = None  # parameters of its place, world x and y
    same_form: tuple[str, ...] = ()  # sparse terms (`sparse.py`) of its form, for one parameter

    # Which flight separates it from others
    separated_by: Mapping[str, str] = field(default_factory=dict)  # manoeuvre -> why it does
    note: str = ""  # what no flight separates, and what to do instead

    # How it is hidden in a simulated flight
    # Size just visible at marker noise, at pose-net noise, and plainly visible in a stable flight.
    sizes: tuple[float, float, float] | None = None
    draw: Draw | None = None
    hidden_map: Callable[[Array, Any], Array] | None = None  # measurement_map without approximation
    hidden_stamp_delay: Callable[[Any], float] | None = None  # K -> delay of image time stamps [s]
    # Position in the first version of the random draw of an effect; effects added later have none.
    frozen_number: int | None = None

    @property
    def amplitudes(self) -> tuple[Parameter, ...]:
        """The parameters that are zero when the effect is absent."""
        return tuple(p for p in self.parameters if p.name not in self.shape)

    @property
    def changes_flow(self) -> bool:
        """Whether it is a force, a moment or a wind."""
        return any((self.loads, self.loads_of, self.wind_field))

    @property
    def is_kinematic(self) -> bool:
        """Whether its equation is exact: air, time or the camera's place, of no assumed shape."""
        moves = any((self.wind_field, self.input_map, self.measurement_map))
        return moves and not self.shape

    @property
    def has_onset(self) -> bool:
        """Whether it can set in during a flight, at a time of its own."""
        return not self.gradual and (self.changes_flow or self.command_map is not None)

    def term(self, own: tuple[Term, ...] = ()) -> Term | None:
        """The term it adds to a model with these terms, or None where it adds none."""
        loads = self.loads_of(own) if self.loads_of else self.loads
        if loads is None:
            return None
        return Term(self.name, self.parameters, loads, self.of_propeller)

    @property
    def wind_term(self) -> WindTerm | None:
        """The part of the wind that it adds, or None."""
        return WindTerm(self.name, self.parameters, self.wind_field) if self.wind_field else None

    def scan(self, low: Array, high: Array) -> list[dict[str, float]]:
        """Parameter values at which a scan tries it; low and high (2,) bound the area flown [m]."""
        start = {p.name: p.start for p in self.parameters}
        points = self.scan_points(low, high) if self.scan_points else ({}, *self.starts)
        return [{**start, **point} for point in points]


def effect_catalogue(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Effects in a stable order: those with a frozen number by it, later ones by their names.

    Raises:
        InputError: two different effects have the same number.
    """
    ordered = sorted(effects, key=lambda e: (e.frozen_number is None, e.frozen_number or 0, e.name))
    numbers: dict[int, str] = {}
    for effect in ordered:
        if effect.frozen_number is None:
            continue
        other = numbers.setdefault(effect.frozen_number, effect.name)
        if other != effect.name:
            raise InputError(
                f"effect {effect.name}: frozen_number: expected a new one, got that of {other} "
                f"({effect.frozen_number}): remove it"
            )
    return tuple(ordered)


STANDING = "standing_"


def standing_effect(effect: Effect) -> Effect:
    """The same effect as a part of the aircraft or its surroundings that is there in every flight.

    Its parameters get the prefix standing_, so that a change of the effect can be added to it.
    """
    names = {p.name: STANDING + p.name for p in effect.parameters}

    def rename(function: Callable[..., Any] | None) -> Callable[..., Any] | None:
        """The hook with the parameter record, its last argument, under the effect's own names."""
        if function is None:
            return None
        return lambda *arguments: function(*arguments[:-1], _RenamedRecord(arguments[-1], names))

    loads_of = effect.loads_of
    return replace(
        effect,
        name=STANDING + effect.name,
        parameters=tuple(replace(p, name=names[p.name]) for p in effect.parameters),
        loads=rename(effect.loads),
        loads_of=(lambda terms: rename(loads_of(terms))) if loads_of else None,  # type: ignore
        wind_field=rename(effect.wind_field),
        command_map=rename(effect.command_map),
        input_map=rename(effect.input_map),
        measurement_map=rename(effect.measurement_map),
        shape=tuple(names[name] for name in effect.shape),
        essential=tuple(names[name] for name in effect.essential),
        starts=tuple({names[n]: v for n, v in start.items()} for start in effect.starts),
        scan_points=None,
        sizes=None,
        draw=None,
        frozen_number=None,
    )


class _RenamedRecord:
    """A parameter record that shows some fields under other names."""

    def __init__(self, record: Any, names: Mapping[str, str]) -> None:
        self._record, self._names = record, names

    def __getattr__(self, name: str) -> Any:
        return getattr(self._record, self._names.get(name, name))


def draw_size(name: str) -> Draw:
    """A draw that sets one parameter to the given size; nothing is random."""
    return lambda rng, size: {name: size}


def draw_direction(*names: str) -> Draw:
    """A vector of these components with the size as its length and a random direction."""

    def draw(rng: np.random.Generator, size: float) -> dict[str, float]:
        drawn = rng.normal(size=len(names))
        return dict(zip(names, (size * drawn / np.linalg.norm(drawn)).tolist(), strict=True))

    return draw
