"""Experts: measured state -> commands that land, fly waypoints or follow a leader, without images.

An expert reads `observation.state`, `observation.t` and `observation.past_commands` only. Its own
observer (control/estimate.py) filters the pose of the measured state and estimates velocities and
rates. Here are the paths and the phases of flight; the control law, LQR loops, is in
control/loops.py. The vision policies imitate the experts.
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
from falconwing_kit.control.loops import LINK_DELAY_S, SPEED, Autopilot, Reference, course_axes
from falconwing_kit.core.checks import Array
from falconwing_kit.core.messages import Command, Observation, State

GLIDE = math.radians(4.0)  # gamma, flight path angle of the glide, downwards [rad]
TOUCHDOWN_SLOPE = 0.035  # tan(gamma_touch) of the wheels' path
FLARE_LENGTH = 6.0  # L, distance in which the flare's slope falls to 1/e [m]
AIM = 3.5  # planned touchdown, past the pad's threshold [m]
FINAL = 60.0  # length of the glide before the flare [m]
GAP_GAIN = 0.8  # speed correction per metre of gap error [1/s]
MAX_SPEED_CORRECTION = 1.2  # [m/s]
WALL_MARGIN = 0.8  # of a follower to walls, floor and beams [m]; its half span is 0.35 m
NO_STATE = "no state"


class LeaderTrajectory(Protocol):
    """A leader's motion as a function of time."""

    @property
    def t(self) -> Array:
        """(n,) [s]."""

    @property
    def states(self) -> Array:
        """(n, 12) in the order of STATE_NAMES, SI."""

    def state_at(self, t: float) -> State:
        """The leader's state at a time [s]."""


class EstimatingAutopilot:
    """An autopilot on the estimates of an observer; every expert has one."""

    def __init__(self, model: Model, speed: float, delay: float) -> None:
        self._autopilot = Autopilot(model, speed, delay)
        self._observer = Observer(model, speed, delay)

    def estimate(self, observation: Observation) -> State | None:
        """The estimated state; None where the measured one is missing or not finite."""
        measured, sent = observation.state, observation.past_commands[-1]
        if measured is None or not np.isfinite(measured.vector).all():
            self._observer.reset()
            return None
        return self._observer.update(observation.t, measured, sent)

    def track(
        self, state: State, reference: Reference, observation: Observation, idle: bool = False
    ) -> Command:
        """The autopilot's command towards a reference."""
        return self._autopilot.command(state, reference, observation.past_commands, idle)

    def level(self) -> Command:
        """The control inputs of straight level flight."""
        return self._autopilot.level()


class WaypointExpert:
    """Flies a smooth path through waypoints at one speed."""

    def __init__(
        self, model: Model, airframe: Airframe, waypoints: Array,
        speed: float = SPEED, delay: float = LINK_DELAY_S,
    ) -> None:  # fmt: skip
        """Design the loops and fit the path through waypoints (n, 3) [m].

        Raises:
            InputError: the model cannot be trimmed or stabilised, or the path exceeds the bank or
                climb limit.
        """
        self.path, self.speed, self.mode = ReferencePath(waypoints), speed, "waypoints"
        require_flyable(self.path, speed, airframe.bank_limit)
        self._autopilot, self._s = EstimatingAutopilot(model, speed, delay), 0.0

    def act(self, observation: Observation) -> Command:
        """The command towards the first waypoint and along the path; straight on after its end."""
        state = self._autopilot.estimate(observation)
        if state is None:
            self.mode = NO_STATE
            return self._autopilot.level()
        self._s = self.path.nearest(state.p_world, self._s)
        self.mode = "waypoints" if self._s < self.path.length else "past the end"
        return self._autopilot.track(state, self.path.at(self._s, self.speed), observation)


class LandingExpert:
    """Lands along the pad's centre line: a straight glide, then a flare at idle throttle."""

    def __init__(
        self, model: Model, airframe: Airframe, pad: LandingPad,
        speed: float = SPEED, delay: float = LINK_DELAY_S,
    ) -> None:  # fmt: skip
        """Design loops and approach; InputError: the model cannot be trimmed or stabilised."""
        self.path, self._flare_at = landing_path(airframe, pad)
        self.airframe, self.pad, self.speed, self.mode = airframe, pad, speed, "approach"
        self._autopilot = EstimatingAutopilot(model, speed, delay)

    def act(self, observation: Observation) -> Command:
        """The command for approach and flare; idle and neutral once landed, whatever follows."""
        if self.mode == "landed":
            return Command(0.0, 0.0, 0.0, 0.0)
        state = self._autopilot.estimate(observation)
        if state is None:
            self.mode = NO_STATE
            return self._autopilot.level()
        s = self.path.nearest(state.p_world)
        lowest_wheel = float(np.min(wheel_heights(state.vector, self.airframe, self.pad)))
        if s > self._flare_at and lowest_wheel < 0.0:
            self.mode = "landed"
            return Command(0.0, 0.0, 0.0, 0.0)
        self.mode = "flare" if s > self._flare_at else "approach"
        reference = self.path.at(s, self.speed)
        return self._autopilot.track(state, reference, observation, idle=self.mode == "flare")


class FollowExpert:
    """Follows the leader's path: station keeping at the initial relative position."""

    def __init__(
        self, model: Model, airframe: Airframe, leader_path: LeaderTrajectory,
        speed: float = SPEED, delay: float = LINK_DELAY_S,
    ) -> None:  # fmt: skip
        """Design the loops; InputError where the model cannot be trimmed or stabilised."""
        positions = leader_path.states[:, 0:3]
        self.path, self.leader, self.mode = ReferencePath(positions), leader_path, "follow"
        # (3,) behind the leader along its path, left of the path, above it [m]
        self.station: Array | None = None
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        self._s_leader = np.concatenate([[0.0], np.cumsum(steps)])
        self._speeds = np.linalg.norm(leader_path.states[:, 6:9], axis=1)
        self._autopilot = EstimatingAutopilot(model, speed, delay)
        self._s: float | None = None

    def act(self, observation: Observation) -> Command:
        """The command that keeps the aircraft at its station behind the leader."""
        state = self._autopilot.estimate(observation)
        if state is None:
            self.mode = NO_STATE
            return self._autopilot.level()
        self.mode = "follow"
        s_leader = float(np.interp(observation.t, self.leader.t, self._s_leader))
        if self._s is None:
            leader = self.leader.state_at(observation.t)
            self._s = s_leader - float(np.linalg.norm(leader.p_world - state.p_world))
        self._s = s = self.path.nearest(state.p_world, self._s)
        leader_speed = float(np.interp(s, self._s_leader, self._speeds))
        if self.station is None:
            on_path = self.path.at(s, leader_speed)
            offset = state.p_world - on_path.p_world
            self.station = np.array([s_leader - s, offset @ course_axes(on_path.yaw)[1], offset[2]])
        gap_error = s_leader - self.station[0] - s
        correction = min(max(GAP_GAIN * gap_error, -MAX_SPEED_CORRECTION), MAX_SPEED_CORRECTION)
        reference = self.path.at(s, leader_speed + correction)
        aside = self.station[1] * course_axes(reference.yaw)[1] + (0.0, 0.0, self.station[2])
        # A station beside the path may lie behind a wall although the path does not.
        target = Hall().clamp(reference.p_world + aside, WALL_MARGIN)
        return self._autopilot.track(state, replace(reference, p_world=target), observation)


def landing_path(airframe: Airframe, pad: LandingPad) -> tuple[ReferencePath, float]:
    """Path of the centre of gravity down to the pad, and the arc length where its flare begins [m].

    It runs along the pad's centre line in the direction of world x. The height above the pad falls
    linearly, then exponentially towards a level slightly below the pad, so that the wheels touch at
    the slope tan(gamma_touch): h = L (tan(gamma) e^(-x/L) - tan(gamma_touch)), x from the start of
    the flare [Stevens, Lewis & Johnson, Aircraft Control and Simulation, 3rd ed., sec. 4.5:
    exponential flare].
    """
    glide_slope, touchdown_slope = math.tan(GLIDE), TOUCHDOWN_SLOPE
    x_flare = pad.x_start + AIM - FLARE_LENGTH * math.log(glide_slope / touchdown_slope)
    x = np.arange(-FINAL, pad.length, 0.25)
    glide = -glide_slope * np.minimum(x, 0.0)
    flare = glide_slope * np.exp(-np.maximum(x, 0.0) / FLARE_LENGTH) - touchdown_slope
    # Height of the centre of gravity with the main wheels on the pad.
    standing = pad.height + max(airframe.wheels.main_left[2], airframe.wheels.main_right[2])
    z = standing + glide + FLARE_LENGTH * flare
    path = ReferencePath(np.column_stack([x_flare + x, np.full(len(x), pad.y_centre), z]))
    return path, path.nearest(np.array([x_flare, pad.y_centre, 0.0]))
