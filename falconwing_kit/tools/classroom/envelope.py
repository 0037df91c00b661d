"""Envelope: the state of the aircraft -> why a student may not fly on from here, or nothing.

A student keeps the sticks as long as the autopilot could still turn away: of the two turns at
TURN_RADIUS, to the left and to the right, one must stay inside the hall. On the way down to the pad
the walls at the side do not count.
"""

import math

import numpy as np

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.control.guidance import Hall
from falconwing_kit.core.messages import State

TURN_RADIUS = 4.5  # at 7 m/s and 48 deg of bank [m]
REACTION_S = 0.35  # flown straight on before the turn
WALL, CEILING = 0.6, 4.2  # distance to walls, and greatest height [m]
ROLL, PITCH = math.radians(75.0), math.radians(50.0)  # largest angles
ON_LINE, ON_COURSE, LOW = 2.5, math.radians(30.0), 1.8  # of an approach [m, rad, m]
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
    if state.p_world[2] > CEILING:
        return f"higher than {CEILING:.1f} m"
    hall, speed = Hall(), float(np.hypot(*state.v_world[:2]))
    course = math.atan2(-state.v_world[1], state.v_world[0])
    if is_landing and _is_on_approach(state, course):
        return ""
    ahead = np.array([math.cos(course), -math.sin(course)])
    right = np.array([-math.sin(course), -math.cos(course)])
    start = state.p_world[:2] + REACTION_S * speed * ahead
    for side in (1.0, -1.0):
        arc = TURN_RADIUS * (
            np.sin(ARC)[:, None] * ahead + side * (1.0 - np.cos(ARC))[:, None] * right
        )
        points = np.column_stack([start + arc, np.full(len(ARC), 1.0)])
        if hall.margin(points).min() > WALL:
            return ""
    return "too near a wall"


def _is_on_approach(state: State, course: float) -> bool:
    """Whether the aircraft is low over the pad's centre line, before the pad's end."""
    pad = LandingPad()
    x, y, z = state.p_world
    return bool(
        abs(y - pad.y_centre) < ON_LINE
        and abs(course) < ON_COURSE
        and z < LOW
        and x < pad.x_start + pad.length
    )
