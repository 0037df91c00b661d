"""Estimate: noisy measured states and commands -> the state of the model, by an observer; the
simulated aircraft that is observed.
"""

import math
from functools import lru_cache

import numpy as np

from falconwing_kit.aircraft.integrate import advance
from falconwing_kit.aircraft.model import Model
from falconwing_kit.aircraft.trim import linearise, trim
from falconwing_kit.control.inverse import design_model, true_state
from falconwing_kit.control.loops import LINK_DELAY_S, SPEED, model_key
from falconwing_kit.control.riccati import predicted_covariance
from falconwing_kit.core.checks import Array, require_range
from falconwing_kit.core.messages import CONTROL_PERIOD_S, Observation, State

COMMAND_HISTORY = 400  # commands: 20 s at 20 Hz, far longer than any delay
LONGEST_GAP_S = 0.5  # the observer restarts after a longer one
MEASUREMENT_SIGMA = (0.01, math.radians(0.7))  # measurement noise per axis [m], [rad]
PROCESS_SIGMA = (0.05, 0.1)  # process noise of a step of 50 ms: velocity [m/s], rates [rad/s]


class SimulatedAircraft:
    """A simulated aircraft: commands in, which act after a delay; true state out."""

    def __init__(
        self, model: Model, start: State, delay: float = LINK_DELAY_S, t: float = 0.0
    ) -> None:
        """Start at t [s]; the first command also acts before its time."""
        self.t, self.x = t, start.vector[: model.n_states].copy()
        self._model, self._delay = model, require_range("delay", delay, low=0.0, high=1.0)
        self._times: list[float] = []
        self._commands: list[Array] = []

    def send(self, t: float, commands: Array) -> None:
        """Append commands (4,) at a time [s] not before the last; they arrive `delay` later."""
        self._times.append(t + self._delay)
        self._commands.append(np.asarray(commands, np.float64))
        del self._times[:-COMMAND_HISTORY], self._commands[:-COMMAND_HISTORY]

    def change_model(self, model: Model) -> None:
        """Fly on with another model of as many states, such as one with an effect added."""
        self._model = model

    def advance(self, t: float) -> None:
        """Simulate until t [s]; without any command, controls are neutral and the throttle idle."""
        times = np.array(self._times or [0.0])
        commands = np.array(self._commands or [np.zeros(4)])
        self.x = advance(self._model, self.t, t, self.x, times, commands)
        self.t = max(self.t, t)


class Observer:
    """x = f(x, u) + L (measured pose - pose of x), L the stationary Kalman gain in level flight.

    [Astrom & Murray, Feedback Systems, sec. 8.2-8.4: observers and Kalman filtering]
    """

    effectiveness = np.ones(4)  # of the controls: as in the model

    def __init__(self, model: Model, speed: float = SPEED, delay: float = LINK_DELAY_S) -> None:
        """Design the gain in still air; InputError where the model cannot be trimmed."""
        gain = _kalman_gain(*model_key(design_model(model)), speed)
        self._model, self._delay, self._gain = model, delay, gain
        self._estimate: SimulatedAircraft | None = None

    def estimate(self, observation: Observation) -> State | None:
        """The estimated state; None where the measured one is missing or not finite."""
        measured = observation.state
        if measured is None or not np.isfinite(measured.vector).all():
            self.reset()
            return None
        return self.update(observation.t, measured, observation.past_commands[-1])

    def update(self, t: float, measured: State, sent: Array) -> State:
        """Prediction and measurement update; returns the estimate.

        Args:
            t: now [s].
            measured: its pose is used, through the inverse of the model's measurement maps (a
                camera tilt); velocities and rates only where the observer starts.
            sent: (4,) commands since the last update, in the order of COMMAND_NAMES.
        """
        measured = true_state(self._model, measured)
        estimate = self._estimate
        if estimate is None or not 0.0 <= t - estimate.t <= LONGEST_GAP_S:
            self._estimate = SimulatedAircraft(self._model, measured, self._delay, t)
            return measured
        if t == estimate.t:
            return State.from_vector(estimate.x)
        estimate.send(estimate.t, sent)
        with np.errstate(all="ignore"):
            estimate.advance(t)
        if not np.isfinite(estimate.x).all():  # wild poses had set the model beyond all flight
            self._estimate = SimulatedAircraft(self._model, measured, self._delay, t)
            return measured
        rotation = _course_rotation(float(estimate.x[4]))
        innovation = measured.vector[:6] - estimate.x[:6]
        innovation[3:] = (innovation[3:] + np.pi) % (2.0 * np.pi) - np.pi
        estimate.x = estimate.x + rotation @ self._gain @ rotation[:6, :6].T @ innovation
        return State.from_vector(estimate.x)

    def reset(self) -> None:
        """Restart at the next update."""
        self._estimate = None


@lru_cache(maxsize=32)
def _kalman_gain(form, terms, winds, parameters, values, speed):  # type: ignore[no-untyped-def]
    """L (12, 6) for pose innovations, in axes along the aircraft's heading."""
    model = Model(form, terms, winds, parameters, dict(values))
    A, _ = linearise(model, trim(model, speed), CONTROL_PERIOD_S)
    G, C = np.eye(12)[:, 6:], np.eye(12)[:6]
    process_noise, measurement_noise = (
        np.diag(np.repeat(np.square(sigmas), 3)) for sigmas in (PROCESS_SIGMA, MEASUREMENT_SIGMA)
    )
    # before the pose is taken in
    P = predicted_covariance(A, C, G @ process_noise @ G.T, measurement_noise)
    return P @ C.T @ np.linalg.inv(C @ P @ C.T + measurement_noise)


def _course_rotation(yaw: float) -> Array:
    """(12, 12) rotation of positions and velocities from heading axes to the world."""
    c, s = math.cos(yaw), math.sin(yaw)
    R = np.eye(12)
    for first in (0, 6):
        R[first : first + 2, first : first + 2] = (c, s), (-s, c)
    return R
