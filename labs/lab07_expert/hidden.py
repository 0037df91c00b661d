"""Lab 7, hidden: vector and rotation references, and the kit's simulated aircraft as the plant.

In a trial the student's one function flies the aircraft together with references of the others.
"""

import cmath
import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from given import (
    AIM,
    APPROACH,
    ASIDE,
    BANK_LIMIT,
    FLARE_TIME,
    GLIDE,
    GLIDE_THROTTLE,
    GRAVITY,
    HARDER_BY,
    HEIGHT,
    KI,
    KINDS,
    KP,
    LANDING_S,
    LEVEL_THROTTLE,
    LIFT_0,
    LIFT_SLOPE,
    PAD_HEIGHT,
    PAD_START,
    PULL,
    SLOPE_GAIN,
    SPEED,
    STEEPEST,
    STEP,
    TURN_AHEAD,
    TURN_GAIN,
    WAYPOINTS,
    WHEELS_BELOW,
    Autopilot,
    draw_start,
    is_answer,
)

from falconwing_kit.aircraft import LandingPad, load_airframe, rates_model, trim
from falconwing_kit.core import Command, State, rotation_world_body
from falconwing_kit.flight import SimulatedWorld, Spread
from falconwing_kit.tools.grading import Course, Function, Judge, Trials, Values

MODEL, AIRFRAME, PAD = rates_model(), load_airframe(), LandingPad()
STEADY = State.from_vector(trim(MODEL, SPEED).state)
SCATTER = Spread(position=0.4, angle=math.radians(4.0), speed=0.4)
LEGS, LEGS_TIME = 3, 8.5  # of the circuit, and the time for them [s]; the reference takes 7
SOFTER_BY = (
    0.25  # a flare may touch down so much harder than commanded [m/s]; without one it is 0.5 harder
)

Pilot = Callable[
    [Any], Command | None
]  # measured state -> command; None where an answer was no number


def judges(course: Course) -> Mapping[str, tuple[Judge, ...]]:
    """The judges of each exercise.

    Args:
        course: its angles and its sink rate at touchdown.

    Returns:
        By exercise.
    """
    stall_alpha = math.radians(course.constants["stall_alpha_deg"])
    approach = math.radians(course.constants["approach_deg"])
    touch_sink = course.constants["touch_sink"]

    def bank_and_margin(speed: float, climb: float, radius: float) -> tuple[float, float]:
        """Lift as a vector: what the path bends, less gravity, square to the path."""
        along = np.array([math.cos(climb), 0.0, math.sin(climb)])
        bends = np.array([0.0, -((speed * math.cos(climb)) ** 2) / radius, 0.0])  # y is to the left
        lift = np.add(bends, (0.0, 0.0, GRAVITY))
        lift = lift - (lift @ along) * along
        above = np.array([-math.sin(climb), 0.0, math.cos(climb)])
        alpha = (float(np.linalg.norm(lift)) / speed**2 - LIFT_0) / LIFT_SLOPE
        margin = math.sqrt((LIFT_0 + LIFT_SLOPE * stall_alpha) / (LIFT_0 + LIFT_SLOPE * alpha))
        return math.atan2(-lift[1], lift @ above), margin

    def climb_rate(height: float, distance: float, speed: float) -> tuple[float, bool]:
        slope = speed * math.sin(GLIDE) + SLOPE_GAIN * (height - distance * math.tan(GLIDE))
        rates = {False: -float(np.clip(slope, 0.0, speed * math.sin(STEEPEST))), True: -touch_sink}
        rates[True] -= max(height, 0.0) / FLARE_TIME
        idle = rates[True] > rates[False]
        return rates[idle], idle

    def landing(student: Function, rng: np.random.Generator) -> bool:
        return _lands(student, rng, touch_sink + SOFTER_BY)

    def line(rng: np.random.Generator) -> tuple[Any, ...]:
        return _draw_line(rng, approach)

    def bank(*arguments: Any) -> float:
        return _bank(*arguments, approach=approach)

    return {
        "turn": (Values(_draw_turn, bank_and_margin),),
        "turn_rates": (Values(_draw_attitude, _rates),),
        "guidance": (Values(line, bank), Trials(_flies_the_legs, trials=2)),
        "hold_speed": (Values(_draw_speed, _throttle),),
        "flare": (Values(_draw_height, climb_rate), Trials(landing, trials=3)),
        "LandingExpert": tuple(
            Trials(partial(_lands_from, kind=kind, hardest=touch_sink + HARDER_BY), trials=1)
            for kind in KINDS
        ),
    }


def _draw_turn(rng: np.random.Generator) -> tuple[Any, ...]:
    return (
        rng.uniform(5.0, 12.0),
        rng.uniform(-0.5, 0.5),
        rng.uniform(3.0, 25.0) * rng.choice([-1.0, 1.0]),
    )


def _draw_attitude(rng: np.random.Generator) -> tuple[Any, ...]:
    return (
        rng.uniform(0.1, 1.1) * rng.choice([-1.0, 1.0]),
        rng.uniform(-0.6, 0.6),
        rng.uniform(5.0, 12.0),
    )


def _rates(bank: float, pitch: float, speed: float) -> tuple[float, ...]:
    """The turn is a vector that points down in the world.

    The kit's rotation writes it in body axes.
    """
    turn_world = np.array([0.0, 0.0, -GRAVITY * math.tan(bank) / speed])
    return tuple(float(rate) for rate in rotation_world_body(bank, pitch, 0.7).T @ turn_world)


def _draw_line(rng: np.random.Generator, approach: float) -> tuple[Any, ...]:
    """Any line and any heading, but no error near half a turn, where left and right are alike."""
    while True:
        start, p = rng.uniform(-8.0, 8.0, (2, 2))
        line, course = rng.uniform(-math.pi, math.pi, 2)
        end = start + rng.uniform(3.0, 15.0) * np.array([math.cos(line), -math.sin(line)])
        v = rng.uniform(4.0, 10.0) * np.array([math.cos(course), -math.sin(course)])
        arguments = p, v, start, end, rng.uniform(0.25, 1.1)
        if abs(_course_error(*arguments[:4], approach)) < math.radians(170.0):
            return arguments


def _course_error(p: Any, v: Any, start: Any, end: Any, approach: float) -> float:
    """Angle from the flown to the commanded course, by complex numbers x + i y, right positive."""
    line, flown, off = (complex(*each) for each in (end - start, v, p - start))
    left = (off * line.conjugate()).imag / abs(line)
    commanded = line * cmath.exp(-1j * approach * math.atan(PULL * left) * 2.0 / math.pi)
    return -cmath.phase(commanded * flown.conjugate())


def _bank(
    p: Any, v: Any, start: Any, end: Any, bank_limit: float, approach: float = APPROACH
) -> float:
    commanded = math.atan(
        math.hypot(*v) * TURN_GAIN * _course_error(p, v, start, end, approach) / GRAVITY
    )
    return float(np.clip(commanded, -bank_limit, bank_limit))


def _draw_speed(rng: np.random.Generator) -> tuple[Any, ...]:
    """A third each: unlimited, pushed into a limit, at a limit while the error leads back."""
    error, base = rng.uniform(0.2, 0.8) * rng.choice([-1.0, 1.0]), rng.uniform(0.3, 0.6)
    kind = rng.choice(["between", "pushed", "back"])
    if kind == "between":
        return error, rng.uniform(-0.05, 0.05) / KI, base
    if kind == "pushed":
        return 8.0 * error / abs(error) + error, rng.uniform(-0.5, 0.5), base
    return error, -rng.uniform(4.0, 9.0) * error / abs(error) / KI, base


def _throttle(error: float, integral: float, base: float) -> tuple[float, float]:
    """The sign of the clipped part shows whether the error pushes into the limit."""
    after = integral + STEP * error
    commanded = base + KP * error + KI * after
    cut = commanded - float(np.clip(commanded, 0.0, 1.0))
    after = integral if cut * error > 0.0 else after
    return float(np.clip(base + KP * error + KI * after, 0.0, 1.0)), after


def _draw_height(rng: np.random.Generator) -> tuple[Any, ...]:
    """High and low, on the slope and off it, both far enough for the approach's limits."""
    height = rng.choice([rng.uniform(1.5, 3.0), rng.uniform(0.0, 0.5), rng.uniform(-0.1, 0.0)])
    return height, height / math.tan(GLIDE) + rng.uniform(-12.0, 12.0), rng.uniform(5.5, 9.0)


def _flies_the_legs(guidance: Function, rng: np.random.Generator) -> bool:
    """Whether three legs are flown in time, to the left or right, without touching anything."""
    mirrored = bool(rng.random() < 0.5)
    points = WAYPOINTS * (1.0, -1.0) - (0.0, 4.0) if mirrored else WAYPOINTS
    autopilot, legs, integral = Autopilot(), 0, 0.0

    def pilot(state: Any) -> Command | None:
        nonlocal legs, integral
        p, speed = state.p_world, float(np.linalg.norm(state.v_world))
        start, end = points[legs % 4], points[(legs + 1) % 4]
        if (end - p[:2]) @ (end - start) < TURN_AHEAD * np.linalg.norm(end - start):
            legs += 1
            start, end = points[legs % 4], points[(legs + 1) % 4]
        bank = _number(guidance(p[:2], state.v_world[:2], start, end, BANK_LIMIT))
        if bank is None or abs(bank) > BANK_LIMIT + 1e-9:
            return None
        throttle, integral = _throttle(SPEED - speed, integral, LEVEL_THROTTLE)
        sticks = autopilot.sticks(state, bank, HEIGHT - p[2], _rates(bank, state.pitch, speed))
        return Command.clip(throttle, *sticks)

    world = _flown(pilot, (*points[0], HEIGHT), rng, LEGS_TIME)
    return world is not None and world.contact is None and legs >= LEGS


def _lands(flare: Function, rng: np.random.Generator, hardest: float) -> bool:
    """Whether the wheels meet the pad softly."""
    autopilot, integral, idle = Autopilot(), 0.0, False

    def pilot(state: Any) -> Command | None:
        nonlocal integral, idle
        p, speed = state.p_world, float(np.linalg.norm(state.v_world))
        answer = flare(p[2] - PAD_HEIGHT - WHEELS_BELOW, AIM[0] - p[0], speed)
        if (
            not isinstance(answer, tuple | list)
            or len(answer) != 2
            or (climb := _number(answer[0])) is None
        ):
            return None
        idle = idle or bool(answer[1] is True or answer[1] == 1)
        bank = _bank(p[:2], state.v_world[:2], AIM - (40.0, 0.0), AIM, 0.5 * BANK_LIMIT)
        throttle, integral = _throttle(SPEED - speed, integral, GLIDE_THROTTLE)
        sticks = autopilot.sticks(state, bank, climb, _rates(bank, state.pitch, speed))
        return Command.clip(0.0 if idle else throttle, *sticks)

    world = _flown(pilot, (PAD_START - 20.0, AIM[1], 1.5), rng, 10.0, PAD)
    touchdown = world.contact.touchdown if world is not None and world.contact is not None else None
    return touchdown is not None and touchdown.on_pad and touchdown.sink_rate <= hardest


def _lands_from(expert: Function, rng: np.random.Generator, kind: str, hardest: float) -> bool:
    """Whether a landing from a drawn start of this kind counts."""
    autopilot, throttle = Autopilot(), 1.0
    _fly_before(expert, kind)
    expert("reset")

    def pilot(state: Any) -> Command | None:
        nonlocal throttle
        answer = expert("act", state.p_world, state.v_world, float(state.roll), float(state.pitch))
        if not is_answer(answer):
            return None
        bank, climb, throttle = (float(each) for each in answer)
        rates = _rates(bank, state.pitch, float(np.linalg.norm(state.v_world)))
        return Command.clip(throttle, *autopilot.sticks(state, bank, climb, rates))

    p, yaw = draw_start(kind, rng)
    seed = int(rng.integers(1, 10_000))
    spread = Spread(position=0.1, angle=math.radians(3.0), speed=0.3)
    start = spread.start_near(STEADY, p, seed, yaw)
    world = SimulatedWorld(MODEL, AIRFRAME, start, seed=seed, pad=PAD)
    while world.contact is None and world.t < LANDING_S:
        command = pilot(world.measured())
        if command is None:
            return False
        world.send(world.t, command)
        world.advance(world.t + STEP)
    touch = world.contact.touchdown if world.contact is not None else None
    return (
        touch is not None
        and touch.on_pad
        and throttle == 0.0
        and touch.absolute_lateral_deviation <= ASIDE
        and touch.sink_rate <= hardest
    )


def _fly_before(expert: Function, kind: str) -> None:
    """Two seconds of another landing, too slow, with its flare, which `reset` must forget."""
    expert("reset")
    ahead = -1.0 if kind == KINDS[0] else 1.0
    for step in range(40):
        p = np.array([0.1 * ahead * step, AIM[1] + 7.0, 2.0 - 0.045 * step])
        expert("act", p, np.array([5.0 * ahead, 0.0, -0.9]), 0.0, 0.05)


def _flown(
    pilot: Pilot,
    start: Any,
    rng: np.random.Generator,
    seconds: float,
    pad: LandingPad | None = None,
) -> SimulatedWorld | None:
    """The world after a flight, 20 commands a second; None where the pilot gave none."""
    seed = int(rng.integers(1, 10_000))
    world = SimulatedWorld(MODEL, AIRFRAME, SCATTER.start(MODEL, start, seed), seed=seed, pad=pad)
    while world.contact is None and world.t < seconds:
        command = pilot(world.measured())
        if command is None:
            return None
        world.send(world.t, command)
        world.advance(world.t + STEP)
    return world


def _number(answer: Any) -> float | None:
    """The answer as a number, if it is a finite one."""
    if (
        not isinstance(answer, int | float | np.number | np.ndarray)
        or np.ndim(answer)
        or not np.isfinite(answer)
    ):
        return None
    return float(answer)
