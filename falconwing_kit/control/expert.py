"""Experts: the measured state -> sticks that land, follow waypoints or follow a leader. By state
alone, no image.

An expert looks at `observation.state`, `observation.t` and `observation.past_commands` only. Of the
state it takes the pose; velocities and rates are those of its own observer. It is what the vision
policies imitate.
"""

import math
from dataclasses import replace
from typing import Protocol

import numpy as np

from falconwing_kit.aircraft.airframe import Airframe
from falconwing_kit.aircraft.model import Model
from falconwing_kit.aircraft.touchdown import LandingPad, wheel_heights
from falconwing_kit.control.estimate import Observer
from falconwing_kit.control.guidance import Hall, ReferencePath, require_flyable
from falconwing_kit.control.loops import LINK_DELAY_S, SPEED, Autopilot, course_axes
from falconwing_kit.core.checks import Array
from falconwing_kit.core.messages import Command, Observation, State

GLIDE, TOUCH_SLOPE = (
    math.radians(4.0),
    0.035,
)  # slope of the approach [rad], and of the path where the wheels touch
FLARE_LENGTH = 6.0  # way in which the flare's slope falls to 1/e [m]
AIM = 3.5  # where the wheels should touch, past the pad's threshold [m]
FINAL = 60.0  # length of the approach that is laid out before the pad [m]
GAP_GAIN, GAP_SPEED = 0.8, 1.2  # speed for each metre behind its place [1/s], and at most [m/s]
WALL_MARGIN = 0.8  # m from walls, floor and ceiling that a follower keeps; its half span is 0.35 m
NO_STATE = "no state"


class LeaderTrajectory(Protocol):
    """What a follower knows of its leader: where it was and is at any time."""

    @property
    def t(self) -> Array:
        """(n,) [s]."""

    @property
    def states(self) -> Array:
        """(n, 12) in the order of STATE_NAMES, SI."""

    def state(self, t: float) -> State:
        """The leader's state at a time [s]."""


class WaypointExpert:
    """Flies a smooth path through waypoints at one speed."""

    def __init__(
        self,
        model: Model,
        airframe: Airframe,
        waypoints: Array,
        speed: float = SPEED,
        delay: float = LINK_DELAY_S,
    ) -> None:
        """Design the loops and lay the path through waypoints (n, 3) [m].

        Raises:
            InputError: the model cannot be trimmed or held, or the path turns or climbs more than
                the aircraft can.
        """
        self.path, self.speed, self.mode = ReferencePath(waypoints), speed, "waypoints"
        require_flyable(self.path, speed, airframe.bank_limit)
        self._autopilot, self._s = _EstimatingAutopilot(model, speed, delay), 0.0

    def act(self, observation: Observation) -> Command:
        """Sticks that bring the aircraft to the first waypoint and along the path; straight on
        after its end.
        """
        state = self._autopilot.state(observation)
        if state is None:
            self.mode = NO_STATE
            return self._autopilot.autopilot.level()
        self._s = self.path.nearest(state.p_world, self._s)
        self.mode = "waypoints" if self._s < self.path.length else "past the end"
        return self._autopilot.autopilot.command(
            state, self.path.at(self._s, self.speed), observation.past_commands
        )


class LandingExpert:
    """Lands on the pad along its centre line: a straight glide, then a flare with the throttle
    idle.
    """

    def __init__(
        self,
        model: Model,
        airframe: Airframe,
        pad: LandingPad,
        speed: float = SPEED,
        delay: float = LINK_DELAY_S,
    ) -> None:
        """Design the loops and lay the approach; InputError where the model cannot be trimmed or
        held.
        """
        self.path, self._flare_at = landing_path(airframe, pad)
        self.airframe, self.pad, self.speed, self.mode = airframe, pad, speed, "approach"
        self._autopilot = _EstimatingAutopilot(model, speed, delay)

    def act(self, observation: Observation) -> Command:
        """Sticks for the approach, the flare and the pad; once landed idle, whatever is seen."""
        if self.mode == "landed":
            return Command(0.0, 0.0, 0.0, 0.0)
        state = self._autopilot.state(observation)
        if state is None:
            self.mode = NO_STATE
            return self._autopilot.autopilot.level()
        s = self.path.nearest(state.p_world)
        wheels = float(np.min(wheel_heights(state.vector, self.airframe, self.pad)))
        if s > self._flare_at and wheels < 0.0:
            self.mode = "landed"
            return Command(0.0, 0.0, 0.0, 0.0)
        self.mode = "flare" if s > self._flare_at else "approach"
        wanted = self.path.at(s, self.speed)
        return self._autopilot.autopilot.command(
            state, wanted, observation.past_commands, idle=self.mode == "flare"
        )


class FollowExpert:
    """Follows the path that the leader flew, in the place behind it where it was at first sight."""

    def __init__(
        self,
        model: Model,
        airframe: Airframe,
        leader_path: LeaderTrajectory,
        speed: float = SPEED,
        delay: float = LINK_DELAY_S,
    ) -> None:
        """Design the loops and lay the leader's path; InputError where the model cannot be trimmed
        or held.
        """
        self.path, self.leader, self.mode = (
            ReferencePath(leader_path.states[:, 0:3]),
            leader_path,
            "follow",
        )
        self.place: Array | None = (
            None  # (3,) behind the leader along its path, left of the path, above it [m]
        )
        steps = np.linalg.norm(np.diff(leader_path.states[:, 0:3], axis=0), axis=1)
        self._s_leader = np.concatenate([[0.0], np.cumsum(steps)])
        self._speeds = np.linalg.norm(leader_path.states[:, 6:9], axis=1)
        self._autopilot = _EstimatingAutopilot(model, speed, delay)
        self._s: float | None = None

    def act(self, observation: Observation) -> Command:
        """Sticks that keep the aircraft on the leader's path, in its place behind the leader."""
        state = self._autopilot.state(observation)
        if state is None:
            self.mode = NO_STATE
            return self._autopilot.autopilot.level()
        self.mode = "follow"
        s_leader = float(np.interp(observation.t, self.leader.t, self._s_leader))
        if self._s is None:
            self._s = s_leader - float(
                np.linalg.norm(self.leader.state(observation.t).p_world - state.p_world)
            )
        self._s = s = self.path.nearest(state.p_world, self._s)
        flown = float(np.interp(s, self._s_leader, self._speeds))
        if self.place is None:
            on_path = self.path.at(s, flown)
            offset = state.p_world - on_path.p_world
            self.place = np.array([s_leader - s, offset @ course_axes(on_path.yaw)[1], offset[2]])
        gap_error = s_leader - self.place[0] - s
        wanted = self.path.at(s, flown + min(max(GAP_GAIN * gap_error, -GAP_SPEED), GAP_SPEED))
        aside = self.place[1] * course_axes(wanted.yaw)[1] + (0.0, 0.0, self.place[2])
        # A place beside the path may lie behind a wall where the path itself does not.
        target = Hall().inside(wanted.p_world + aside, WALL_MARGIN)
        return self._autopilot.autopilot.command(
            state, replace(wanted, p_world=target), observation.past_commands
        )


class _EstimatingAutopilot:
    """What all experts have in common: an observer, and an autopilot that acts on what it says."""

    def __init__(self, model: Model, speed: float, delay: float) -> None:
        self.autopilot, self._observer = (
            Autopilot(model, speed, delay),
            Observer(model, speed, delay),
        )

    def state(self, observation: Observation) -> State | None:
        """The estimate; None where no state was measured or not all of it is finite."""
        measured, sent = observation.state, observation.past_commands[-1]
        if measured is None or not np.isfinite(measured.vector).all():
            self._observer.reset()
            return None
        return self._observer.update(observation.t, measured, sent)


def landing_path(airframe: Airframe, pad: LandingPad) -> tuple[ReferencePath, float]:
    """The way of the centre of gravity down to the pad, along its centre line in the direction of
    world x.

    The height above the pad falls on a straight line, then from its flare on exponentially towards
    a level a little below the pad, so that the wheels touch at a slope of their own: h = L
    (tan(glide) e^(-x/L) - slope) [Stevens, Lewis & Johnson, Aircraft Control and Simulation, 3rd
    ed., sec. 4.5: exponential flare].

    Args:
        airframe: where the wheels sit.
        pad: the pad.

    Returns:
        The path, and where on it the flare begins [m].
    """
    slope = math.tan(GLIDE)
    x_flare = pad.x_start + AIM - FLARE_LENGTH * math.log(slope / TOUCH_SLOPE)
    x = np.arange(-FINAL, pad.length, 0.25)
    glide, flare = (
        -slope * np.minimum(x, 0.0),
        slope * np.exp(-np.maximum(x, 0.0) / FLARE_LENGTH) - TOUCH_SLOPE,
    )
    standing = pad.height + max(airframe.wheels.main_left[2], airframe.wheels.main_right[2])
    path = ReferencePath(
        np.column_stack(
            [x_flare + x, np.full(len(x), pad.y_centre), standing + glide + FLARE_LENGTH * flare]
        )
    )
    return path, path.nearest(np.array([x_flare, pad.y_centre, 0.0]))
