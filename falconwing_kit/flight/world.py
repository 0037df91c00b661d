"""Simulated world: delayed commands -> true state, measured state (pose noise, velocity filter),
leader and first contact.

Everything here is simulated. The noise depends only on the seed and the frame's number, so flights
with the same seed have the same start and the same noise, whatever the pilot.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal, Protocol

import numpy as np

from falconwing_kit.aircraft.airframe import Airframe
from falconwing_kit.aircraft.model import Model
from falconwing_kit.aircraft.touchdown import (
    LandingPad,
    Touchdown,
    find_touchdown,
    is_out_of_reach,
    pad_height,
)
from falconwing_kit.control.estimate import SimulatedAircraft
from falconwing_kit.control.expert import LeaderTrajectory
from falconwing_kit.control.guidance import Hall
from falconwing_kit.control.loops import LINK_DELAY_S
from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.frames import body_rates, rotation_world_body
from falconwing_kit.core.messages import CONTROL_PERIOD_S, Command, State

Obstacle = Literal["pad", "pad edge", "floor", "wall", "ceiling", "leader"]

CLEARANCE = 1.0  # distance of the centres of gravity below which two aircraft collide [m]
NO_PAD = LandingPad(length=0.0, width=0.0, height=0.0)
# White jerk of a small aircraft [m/s^3, rad/s^3, each times sqrt(s)]
POSITION_JERK, ATTITUDE_JERK = 8.0, 15.0
# Smallest noise that the filter assumes [m, rad]; without any it would follow rounding errors.
NOISE_FLOOR = (1e-3, 1e-3)
FRAMES_BEFORE_START = 40  # simulated for the velocity filter, which has then settled


@dataclass(frozen=True)
class PoseNoise:
    """White noise of a measured pose, standard deviation per axis; by default a close marker's."""

    position: float = 0.01  # [m]
    attitude: float = math.radians(0.7)  # [rad]

    def __post_init__(self) -> None:
        require_range("position noise", self.position, low=0.0, high=10.0)
        require_range("attitude noise", self.attitude, low=0.0, high=1.0)


@dataclass(frozen=True)
class Contact:
    """The first contact with anything; the flight ends there."""

    t: float  # [s]
    obstacle: Obstacle
    p_world: Array  # (3,) the centre of gravity [m]
    touchdown: Touchdown | None = None  # of the wheels on pad or floor; None for other contacts


class FlyingAircraft(Protocol):
    """An aircraft that is simulated step by step, such as `control.estimate.SimulatedAircraft`."""

    t: float  # now [s]
    x: Array  # (12,) its true state in the order of STATE_NAMES, SI

    def send(self, t: float, commands: Array) -> None:
        """Send commands (4,) at a time [s] not before the last."""

    def advance(self, t: float) -> None:
        """Simulate until t [s]."""


def measured_state(model: Model, state: State) -> State:
    """A true state with the pose that the model's measurement maps turn it into, without noise."""
    pose = np.array([*state.p_world, state.roll, state.pitch, state.yaw])
    x, y, z, roll, pitch, yaw = model.measured_pose(pose, model.K)
    p_world = np.array([x, y, z])
    return State(p_world, float(pitch), float(yaw), float(roll), state.v_world, state.rates_body)


class PoseFilter:
    """Noisy poses, one by one -> filtered state with velocities and body rates.

    A Kalman filter for each of the six channels: value, rate and acceleration, driven by white jerk
    [Bar-Shalom, Li & Kirubarajan, Estimation with Applications to Tracking and Navigation, sec.
    6.2.3: white-noise jerk model].
    """

    def __init__(self, noise: PoseNoise) -> None:
        """noise: as expected of the poses."""
        self._t: float | None = None
        # Mean (3, 6) and covariance (3, 3, 6): value, rate, acceleration of each channel.
        self._x, self._P = np.zeros((3, 6)), np.zeros((3, 3, 6))
        sigma = np.maximum((noise.position, noise.attitude), NOISE_FLOOR)
        self._variance = np.repeat(sigma**2, 3)
        self._jerk = np.repeat((POSITION_JERK, ATTITUDE_JERK), 3)
        self.gain = np.zeros((3, 6))  # of the newest update; it depends on the times alone

    def update(self, t: float, pose: Array) -> State:
        """The state after a pose (6,) at t [s]: p_world [m], roll, pitch, yaw [rad]."""
        if self._t is None:
            self._x[0], self._P = pose, np.diag((1.0, 100.0, 100.0))[:, :, None] * np.ones(6)
        else:
            self._predict(max(t - self._t, 1e-6))
        self._t = t
        innovation = pose - self._x[0]
        innovation[3:] = (innovation[3:] + np.pi) % (2.0 * np.pi) - np.pi
        # Only the value is measured, so the gain is the covariance's first column over a scalar.
        self.gain = self._P[:, 0] / (self._P[0, 0] + self._variance)
        self._x = self._x + self.gain * innovation
        self._P = self._P - self.gain[:, None] * self._P[None, 0]
        p_world, (roll, pitch, yaw) = self._x[0, :3].copy(), self._x[0, 3:]
        rates = np.array(body_rates(roll, pitch, *self._x[1, 3:]))
        yaw = (yaw + np.pi) % (2.0 * np.pi) - np.pi
        v_world = self._x[1, :3].copy()
        return State(p_world, float(pitch), float(yaw), float(roll), v_world, rates)

    def _predict(self, dt: float) -> None:
        F = filter_transition(dt)
        Q = np.array(
            [
                [dt**5 / 20, dt**4 / 8, dt**3 / 6],
                [dt**4 / 8, dt**3 / 3, dt**2 / 2],
                [dt**3 / 6, dt**2 / 2, dt],
            ]
        )
        self._x = F @ self._x
        self._P = np.einsum("ij,jkc,lk->ilc", F, self._P, F) + Q[:, :, None] * self._jerk**2


def filter_transition(dt: float) -> Array:
    """(3, 3) value, rate and acceleration after dt [s] of constant acceleration."""
    return np.array([[1.0, dt, dt * dt / 2.0], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])


class SimulatedWorld:
    """One flight of a modelled aircraft in the hall, with or without a pad and a leader."""

    def __init__(
        self, model: Model | FlyingAircraft, airframe: Airframe, start: State, *, seed: int,
        pad: LandingPad | None = None, leader: LeaderTrajectory | None = None,
        hall: Hall | None = None, noise: PoseNoise | None = None, delay: float = LINK_DELAY_S,
        camera: Callable[[State], State] | None = None,
    ) -> None:  # fmt: skip
        """Begin at t = 0.

        Args:
            model: the aircraft that flies, with any effect added; or an aircraft that another
                simulator flies, at the start and with its own delay.
            airframe: positions of wheels, wing tips and nose.
            start: the true state at t = 0.
            seed: of the noise.
            pad: the landing pad, None for a bare floor.
            leader: another aircraft, an obstacle.
            hall: its walls; None for the default.
            noise: of the measured pose; None for the default.
            delay: from `send` to the aircraft's own input [s].
            camera: true state -> state that the camera would measure without noise; None: the same.

        Raises:
            InputError: the start is not finite, or an argument is out of its range.
        """
        if not np.isfinite(start.vector).all():
            raise InputError(
                "start: expected a finite state, got nan or infinity; set all of its numbers"
            )
        self.contact: Contact | None = None
        self._aircraft: FlyingAircraft = (
            SimulatedAircraft(model, start, delay) if isinstance(model, Model) else model
        )
        self._camera = camera or (lambda state: state)
        self._airframe, self._leader = airframe, leader
        self._pad, self._hall = pad or NO_PAD, hall or Hall()
        self._noise, self._seed = noise or PoseNoise(), int(require_range("seed", seed, low=0))
        self._t, self._filter = 0.0, PoseFilter(self._noise)
        self._measured = self._measure_before_start()

    @property
    def t(self) -> float:
        """Time since the start [s]."""
        return self._t

    @property
    def state(self) -> State:
        """The true state; constant from the first contact on."""
        return State.from_vector(self._aircraft.x)

    @property
    def leader_state(self) -> State | None:
        """The leader's true state; None where there is no leader."""
        return None if self._leader is None else self._leader.state_at(self._t)

    def change_model(self, model: Model) -> None:
        """Fly on with another model from now on, such as one with an effect added.

        Its measurement maps act on the measured poses from the next frame on.

        Args:
            model: of as many states as the one that flies.

        Raises:
            InputError: another simulator flies the aircraft, or the states differ.
        """
        aircraft = self._aircraft
        if not isinstance(aircraft, SimulatedAircraft) or model.n_states != len(aircraft.x):
            raise InputError(
                "model: expected one with the states of the aircraft that flies, got another; give"
                " the model to the world at its start"
            )
        aircraft.change_model(model)
        self._camera = partial(measured_state, model)

    def send(self, t: float, command: Command) -> None:
        """Send a command at t [s]; it arrives after the delay."""
        self._aircraft.send(t, command.vector)

    def measured(self) -> State:
        """The noisy pose of this frame, with velocities and body rates of a `PoseFilter`."""
        return self._measured

    def advance(self, t: float) -> None:
        """Fly until t [s], after a contact only the time; InputError where t is in the past."""
        require_range("t", t, low=self._t)
        while self.contact is None and self._t < t - 1e-9:
            t_before, x_before = self._t, self._aircraft.x
            self._aircraft.advance(min(t_before + CONTROL_PERIOD_S, t))
            self._t = self._aircraft.t
            self.contact = self._find_contact(t_before, x_before)
            self._measured = self._measure(round(self._t / CONTROL_PERIOD_S), self.state)
        self._t = t

    def _measure_before_start(self) -> State:
        """Run the velocity filter along the straight line that leads to the start.

        Returns:
            The measured state at the start; the filter needs frames before it to have a velocity.
        """
        start = self.state
        for frame_before_start in range(-FRAMES_BEFORE_START, 0):
            t_before_start = frame_before_start * CONTROL_PERIOD_S
            p_before_start = start.p_world + t_before_start * start.v_world
            state_before_start = State(
                p_before_start, start.pitch, start.yaw, start.roll, start.v_world
            )
            self._measure(frame_before_start, state_before_start)
        return self._measure(0, start)

    def _measure(self, frame: int, state: State) -> State:
        rng, state = (
            np.random.default_rng([self._seed, frame + FRAMES_BEFORE_START]),
            self._camera(state),
        )
        sigma = np.repeat((self._noise.position, self._noise.attitude), 3)
        true_pose = np.array([*state.p_world, state.roll, state.pitch, state.yaw])
        pose = true_pose + sigma * rng.normal(size=6)
        filtered = self._filter.update(frame * CONTROL_PERIOD_S, pose)
        return State(pose[:3], pose[4], pose[5], pose[3], filtered.v_world, filtered.rates_body)

    def _find_contact(self, t_before: float, x_before: Array) -> Contact | None:
        """The first contact since t_before."""
        times, path = (t_before, self._aircraft.t), np.stack([x_before, self._aircraft.x])
        return find_contact(times, path, self._airframe, self._pad, self._hall, self._leader)


def find_contact(
    t: tuple[float, float], states: Array, airframe: Airframe, pad: LandingPad, hall: Hall,
    leader: LeaderTrajectory | None = None,
) -> Contact | None:  # fmt: skip
    """The first contact between two samples; a touchdown only if nothing else was hit by then.

    Args:
        t: of both samples [s], increasing.
        states: (2, 9 or 12) in the order of STATE_NAMES, SI.
        airframe: positions of wheels, wing tips, nose and tail.
        pad: the landing pad, of size zero for a bare floor.
        hall: its walls.
        leader: another aircraft, an obstacle.

    Raises:
        InputError: a number is not finite.
    """
    (x_before, x), now = states, t[1]
    p_world, attitude = x[:3], (x[5], x[3], x[4])  # roll, pitch, yaw
    is_high = states.shape[1] == 12 and is_out_of_reach(t[1] - t[0], states, airframe, pad)
    touchdown = None if is_high else find_touchdown(t, states, airframe, pad)
    if touchdown is not None:
        now, p_world = touchdown.t, touchdown.p_world
        attitude = (touchdown.bank, touchdown.pitch, touchdown.yaw)
    if leader is not None:
        distance = np.linalg.norm(leader.state_at(now).p_world - p_world)
        if distance < CLEARANCE:
            return Contact(now, "leader", p_world)
    corners = p_world + airframe.corners_body @ rotation_world_body(*attitude).T
    ground = pad_height(corners, pad)
    below = corners[:, 2] < ground
    in_pad = below & (ground > 0.0)
    # A corner that was already lower than the pad's top came through its side.
    through_top = bool(np.any(in_pad)) and bool(
        np.any(in_pad & (corner_positions(x_before, airframe)[:, 2] > ground))
    )
    touched: dict[Obstacle, bool] = {
        "pad": through_top,
        "pad edge": bool(np.any(in_pad)),
        "floor": bool(np.any(below)),
        "ceiling": corners[:, 2].max() > hall.beams,
        "wall": hall.margin(corners * (1.0, 1.0, 0.0)).min() < 0.0,
    }
    for obstacle, hits in touched.items():
        if hits:
            return Contact(now, obstacle, p_world)
    return None if touchdown is None else Contact(now, touchdown.surface, p_world, touchdown)


def corner_positions(states: Array, airframe: Airframe) -> Array:
    """Nose, tail and wing tips (..., 4, 3) [m] of states (..., 9 or 12)."""
    R_world_body = rotation_world_body(states[..., 5], states[..., 3], states[..., 4])
    turned = airframe.corners_body @ np.swapaxes(R_world_body, -1, -2)
    return np.asarray(states[..., None, :3] + turned)
