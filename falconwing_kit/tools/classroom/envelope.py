"""Envelope: the state of the aircraft -> why a student may not fly on from here, or nothing.

A student keeps the sticks as long as the autopilot could still turn away: of the two turns at
TURN_RADIUS, to the left and to the right, one must stay inside the hall. On the way down to the pad
the walls at the side do not count.
"""

import math

import numpy as np

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.control.guidance import Hall
from falconwing_kit.core.checks import Array
from falconwing_kit.core.messages import State

TURN_RADIUS = 5.5  # at 7 m/s and 42 deg of bank [m]
REACTION_S = 0.4  # flown straight on before the turn
ROLL_S = 0.5  # more of it for each radian of bank to the other side
WALL, CEILING = 0.8, 4.2  # distance to walls, and greatest height [m]
ROLL, PITCH = math.radians(75.0), math.radians(50.0)  # largest angles
ON_LINE, ON_COURSE, LOW = 2.5, math.radians(30.0), 1.8  # of an approach [m, rad, m]
CLIMB_S = 0.7  # that a climb goes on before it ends
ARC = np.linspace(0.0, math.pi / 2.0, 7)[1:]  # of a turn away [rad]


def envelope_problem(state: State, *, is_landing: bool = True) -> str:
    """Why the aircraft is to be handed back; empty where the student may fly on.

    Args:
        state: of the aircraft.
        is_landing: whether there is a pad to land on.
    """
    if not np.isfinite(state.vector).all():
        return "the state is not known"
    if abs(state.roll) > ROLL or abs(state.pitch) > PITCH:
        return f"the attitude is beyond {math.degrees(ROLL):.0f} deg of bank or " + (
            f"{math.degrees(PITCH):.0f} deg of pitch"
        )
    if state.p_world[2] + CLIMB_S * state.v_world[2] > CEILING:
        return f"higher than {CEILING:.1f} m"
    if is_landing and _is_on_approach(state):
        return ""
    return "" if max(turn_margins(state)) > WALL else "too near a wall"


def turn_margins(state: State) -> tuple[float, float]:
    """Distance to the walls [m] that turns away to the right and to the left keep; < 0 outside."""
    speed, (ahead, right) = float(np.hypot(*state.v_world[:2])), _axes(state)
    found = []
    for side in (1.0, -1.0):
        reaction = REACTION_S + ROLL_S * max(-side * state.roll, 0.0)
        start = state.p_world[:2] + reaction * speed * ahead
        arc = TURN_RADIUS * (
            np.sin(ARC)[:, None] * ahead + side * (1.0 - np.cos(ARC))[:, None] * right
        )
        points = np.column_stack([start + arc, np.full(len(ARC), 1.0)])
        found.append(float(Hall().margin(points).min()))
    return found[0], found[1]


def room_ahead(state: State) -> float:
    """Way to the next wall straight on [m]; negative outside."""
    ahead, _ = _axes(state)
    hall = Hall()
    ways = []
    for axis, (low, high) in enumerate((hall.x, hall.y)):
        wall = high if ahead[axis] > 0.0 else low
        if abs(ahead[axis]) > 1e-6:
            ways.append((wall - float(state.p_world[axis])) / float(ahead[axis]))
    return min(ways)


def _axes(state: State) -> tuple[Array, Array]:
    """Level unit vectors (2,) of the course and to its right."""
    course = math.atan2(-state.v_world[1], state.v_world[0])
    c, s = math.cos(course), math.sin(course)
    return np.array([c, -s]), np.array([-s, -c])


def _is_on_approach(state: State) -> bool:
    """Whether the aircraft is low over the pad's centre line, before the pad's end."""
    pad = LandingPad()
    x, y, z = state.p_world
    course = math.atan2(-state.v_world[1], state.v_world[0])
    return bool(
        abs(y - pad.y_centre) < ON_LINE
        and abs(course) < ON_COURSE
        and z < LOW
        and x < pad.x_start + pad.length
    )
