"""Experts: measured state -> commands that land, fly waypoints or follow a leader, without images.

An expert reads `observation.state`, `observation.t` and `observation.past_commands` only. Its own
observer (control/estimate.py) filters the pose of the measured state and estimates velocities and
rates; another observer may take its place, such as one that reads the image. Here are the paths and
the phases of flight; the control law, LQR loops, is in control/loops.py, another in
control/successive_loops.py. The vision policies imitate the experts.

An expert is designed on a model, which need not be the aircraft that flies. The model's effects
count: its wind gives the crab angle, its delays and lags are part of the loops, a trim bias is fed
forward, a camera tilt is taken out of the measured attitude (control/inverse.py).
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Protocol

import numpy as np

from falconwing_kit.aircraft.airframe import Airframe
from falconwing_kit.aircraft.model import Model, rates_model
from falconwing_kit.aircraft.touchdown import LandingPad, wheel_heights
from falconwing_kit.aircraft.trim import trim
from falconwing_kit.control.estimate import Observer
from falconwing_kit.control.guidance import Hall, ReferencePath, require_flyable
from falconwing_kit.control.inverse import (
    design_model,
    ground_speed,
    similar_speed,
    wind_velocity,
)
from falconwing_kit.control.loops import LINK_DELAY_S, SPEED, Autopilot, Reference, course_axes
from falconwing_kit.control.successive_loops import SuccessiveAutopilot
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.messages import Command, Observation, State

GLIDE = math.radians(4.0)  # gamma, flight path angle of the glide, downwards [rad]
TOUCHDOWN_SLOPE = 0.035  # tan(gamma_touch) of the wheels' path
FLARE_LENGTH = 6.0  # L, distance in which the flare's slope falls to 1/e [m]
AIM = 3.5  # planned touchdown, past the pad's threshold [m]
# Flare length and aim are for 7 m/s and go with the speed, so that a flare takes the same time: the
# loop's delays do not scale with the aircraft. A faster one touches at the same sink rate.
APPROACH_S = 2.0  # of straight flight before the threshold: the lateral loop settles in about one
LANDING_SPEEDS = 0.3, 1.4  # slowest and fastest, in shares of the kit's 7 m/s
MAX_CRAB = math.radians(30.0)  # of an approach: half of the airspeed across the runway
MIN_GROUND_SHARE = 0.4  # of the airspeed, over the floor, in a headwind
FINAL = 60.0  # length of the glide before the flare [m]
GAP_GAIN = 0.8  # speed correction per metre of gap error [1/s]
MAX_SPEED_CORRECTION = 1.2  # [m/s]
WALL_MARGIN = 0.8  # of a follower to walls, floor and beams [m]; its half span is 0.35 m
SAME_COMMAND = 1e-3  # of a command that comes back from a log or a network [stick]
NO_STATE = "no state"
AutopilotType = Callable[[Model, float, float], Autopilot | SuccessiveAutopilot]
# of landings, which begin beside the glide path and have about three seconds to come back to it
LANDING_AUTOPILOT = partial(Autopilot, begins_beside=True)


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


class StateObserver(Protocol):
    """Source of an expert's state: `Observer`, or one that reads something else."""

    @property
    def effectiveness(self) -> Array:
        """(4,) Of the aircraft's controls in shares of the model's, around level flight."""

    def estimate(self, observation: Observation) -> State | None:
        """The estimated state, finite; None where there is none."""


class EstimatingAutopilot:
    """An autopilot on the estimates of an observer; every expert has one."""

    def __init__(
        self, model: Model, speed: float, delay: float, observer: StateObserver | None = None,
        autopilot: AutopilotType = Autopilot,
    ) -> None:  # fmt: skip
        self._autopilot = autopilot(model, speed, delay)
        self._observer = observer or Observer(model, speed, delay)
        self._sent: Array | None = None  # (4,) the newest command of `track`

    def estimate(self, observation: Observation) -> State | None:
        """The estimated state; None where the observer has none."""
        return self._observer.estimate(observation)

    def track(
        self, state: State, reference: Reference, observation: Observation, idle: bool = False
    ) -> Command:
        """The autopilot's command towards a reference.

        Where the aircraft's controls are e times as effective as the model's, a command that is
        level + (u - level) / e acts on it as u would on the model. Where the newest of the past
        commands is not the one before, another has flown meanwhile.
        """
        past, e = observation.past_commands, self._observer.effectiveness
        if self._sent is not None and not np.allclose(past[-1], self._sent, atol=SAME_COMMAND):
            self._autopilot.begin_return()
        command = self._command(state, reference, past, e, idle, observation.t)
        self._sent = command.vector
        return command

    def _command(
        self, state: State, reference: Reference, past: Array, e: Array, idle: bool, t: float
    ) -> Command:
        if np.all(e == 1.0):
            return self._autopilot.command(state, reference, past, idle, t)
        level = self.level().vector
        sent = np.any(past, axis=1, keepdims=True)  # rows of zeros count as never sent
        past = np.where(sent, level + e * (past - level), past)
        wanted = self._autopilot.command(state, reference, past, idle, t)
        command = Command.clip(*(level + (wanted.vector - level) / e))
        return replace(command, saturated=command.saturated or wanted.saturated)

    def reference(
        self, path: ReferencePath, s: float, airspeed: float, state: State, t: float
    ) -> Reference:
        """The reference at arc length s [m] of a path that is flown at an airspeed [m/s]."""
        still = path.at(s, airspeed)
        wind = self._autopilot.wind_at(state.p_world, t)
        if not wind.any():
            return still
        along = math.cos(still.climb) * course_axes(still.yaw)[0]
        along[2] = math.sin(still.climb)
        return path.at(s, ground_speed(airspeed, along, wind))

    def level(self) -> Command:
        """The control inputs of straight level flight."""
        return self._autopilot.level()


class WaypointExpert:
    """Flies a smooth path through waypoints at one speed."""

    def __init__(
        self, model: Model, airframe: Airframe, waypoints: Array,
        speed: float = SPEED, delay: float = LINK_DELAY_S,
    ) -> None:  # fmt: skip
        """Design the loops and fit the path through waypoints (n, 3) [m]; speed is the airspeed.

        Raises:
            InputError: the model cannot be stabilised or trimmed at the path's steepest climb, or
                the path exceeds the bank or climb limit.
        """
        self.path, self.speed, self.mode = ReferencePath(waypoints), speed, "waypoints"
        require_flyable(self.path, speed, airframe.bank_limit)
        if model.form == "rates":  # the loops refuse the other with a sentence of their own
            trim(design_model(model), speed, max(float(self.path.climb.max()), 0.0))
        self._autopilot, self._s = EstimatingAutopilot(model, speed, delay), 0.0

    def act(self, observation: Observation) -> Command:
        """The command towards the first waypoint and along the path; straight on after its end."""
        state = self._autopilot.estimate(observation)
        if state is None:
            self.mode = NO_STATE
            return self._autopilot.level()
        self._s = self.path.nearest(state.p_world, self._s)
        self.mode = "waypoints" if self._s < self.path.length else "past the end"
        reference = self._autopilot.reference(self.path, self._s, self.speed, state, observation.t)
        return self._autopilot.track(state, reference, observation)


class LandingExpert:
    """Lands along the pad's centre line: a straight glide, then a flare at idle throttle."""

    def __init__(
        self, model: Model, airframe: Airframe, pad: LandingPad,
        speed: float | None = None, delay: float = LINK_DELAY_S,
        observer: StateObserver | None = None, autopilot: AutopilotType = LANDING_AUTOPILOT,
    ) -> None:  # fmt: skip
        """Design loops and approach.

        Args:
            model: that the expert is designed on.
            airframe: wheels of the aircraft that flies.
            pad: where to land.
            speed: airspeed of the approach [m/s]; None for `landing_speed`.
            delay: from a command to its arrival at the aircraft [s].
            observer: of the state; None for `Observer`, which filters the measured one.
            autopilot: the control law.

        Raises:
            InputError: the model cannot be trimmed or stabilised, or not be landed in this hall.
        """
        self.speed = landing_speed(model) if speed is None else speed
        self.path, self._flare_at = landing_path(airframe, pad, self.speed)
        self.airframe, self.pad, self.mode = airframe, pad, "approach"
        require_landable_wind(model, self.path, self.speed)
        self._autopilot = EstimatingAutopilot(model, self.speed, delay, observer, autopilot)

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
        reference = self._autopilot.reference(self.path, s, self.speed, state, observation.t)
        return self._autopilot.track(state, reference, observation, idle=self.mode == "flare")


class FollowExpert:
    """Follows the leader's path: station keeping at the initial relative position."""

    def __init__(
        self, model: Model, airframe: Airframe, leader_path: LeaderTrajectory,
        speed: float = SPEED, delay: float = LINK_DELAY_S,
        observer: StateObserver | None = None, autopilot: AutopilotType = Autopilot,
    ) -> None:  # fmt: skip
        """Design the loops; InputError where the model cannot be trimmed or stabilised.

        speed is the airspeed that the loops are designed for; the leader's is flown.
        """
        positions = leader_path.states[:, 0:3]
        self.path, self.leader, self.mode = ReferencePath(positions), leader_path, "follow"
        # (3,) behind the leader along its path, left of the path, above it [m]
        self.station: Array | None = None
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        self._s_leader = np.concatenate([[0.0], np.cumsum(steps)])
        self._speeds = np.linalg.norm(leader_path.states[:, 6:9], axis=1)
        self._autopilot = EstimatingAutopilot(model, speed, delay, observer, autopilot)
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


def landing_speed(model: Model) -> float:
    """Airspeed of a model's approach [m/s]: 7 for the kit's aircraft, `similar_speed` for others.

    Raises:
        InputError: the aircraft is too fast or too slow for this hall, or has no lift.
    """
    if model.form != "rates":
        return SPEED  # the loops refuse it with a sentence of their own
    speed, run = similar_speed(design_model(model), rates_model()), LandingPad().x_start
    slowest, fastest = (share * SPEED for share in LANDING_SPEEDS)
    fastest = min(fastest, (run - Hall().x[0]) / APPROACH_S)
    if not slowest <= speed <= fastest:
        raise InputError(
            f"model: expected an aircraft that lands at {slowest:.1f} to {fastest:.1f} m/s in this"
            f" hall of 40 m, got one that flies at {speed:.1f} m/s; choose the model of another"
            " aircraft"
        )
    return speed


def require_landable_wind(model: Model, path: ReferencePath, airspeed: float) -> None:
    """InputError where the model's wind is too strong for an approach at an airspeed [m/s]."""
    for p_world, yaw in zip(path.p_world[::5], path.yaw[::5], strict=True):
        wind = wind_velocity(model, p_world, 0.0)
        ahead, left = course_axes(float(yaw))
        across = abs(float(wind @ left))
        too_slow = ground_speed(airspeed, ahead, wind) < MIN_GROUND_SHARE * airspeed
        if too_slow or across > math.sin(MAX_CRAB) * airspeed:
            raise InputError(
                f"model: expected a wind that {airspeed:.1f} m/s can land in, got"
                f" {-float(wind @ ahead):.1f} m/s against the runway and {across:.1f} m/s across it"
                f" at x = {p_world[0]:.0f} m; wait for less wind"
            )


def landing_path(
    airframe: Airframe, pad: LandingPad, speed: float = SPEED
) -> tuple[ReferencePath, float]:
    """Path of the centre of gravity down to the pad, and the arc length where its flare begins [m].

    It runs along the pad's centre line in the direction of world x. The height above the pad falls
    linearly, then exponentially towards a level slightly below the pad, so that the wheels touch at
    the slope tan(gamma_touch): h = L (tan(gamma) e^(-x/L) - tan(gamma_touch)), x from the start of
    the flare [Stevens, Lewis & Johnson, Aircraft Control and Simulation, 3rd ed., sec. 4.5:
    exponential flare]. At another speed [m/s] than 7 the flare lasts as long, so its length and the
    aim go with the speed; above it the wheels touch at the same sink rate.
    """
    share = speed / SPEED
    glide_slope, touchdown_slope = math.tan(GLIDE), TOUCHDOWN_SLOPE / max(share, 1.0)
    flare_length = FLARE_LENGTH * share
    x_flare = pad.x_start + AIM * share - flare_length * math.log(glide_slope / touchdown_slope)
    x = np.arange(-FINAL, pad.length, 0.25)
    glide = -glide_slope * np.minimum(x, 0.0)
    flare = glide_slope * np.exp(-np.maximum(x, 0.0) / flare_length) - touchdown_slope
    # Height of the centre of gravity with the main wheels on the pad.
    standing = pad.height + max(airframe.wheels.main_left[2], airframe.wheels.main_right[2])
    z = standing + glide + flare_length * flare
    path = ReferencePath(np.column_stack([x_flare + x, np.full(len(x), pad.y_centre), z]))
    return path, path.nearest(np.array([x_flare, pad.y_centre, 0.0]))
