"""Online filter: camera poses, also late ones, and the commands sent -> the aircraft's state now
and its covariance.

An extended Kalman filter [Beard & McLain, Small Unmanned Aircraft, sec. 8.5-8.6; Simon, Optimal
State Estimation, sec. 13.2] whose process is the aircraft's model flown on the commands sent:

    predict   x = f(x, u),    P = F P F^T + Q
    update    y = z - h(x),   S = H P H^T + R,   K = P H^T S^-1
              x = x + K y,    P = (I - K H) P (I - K H)^T + K R K^T       [Joseph's form]

x is in the order of STATE_NAMES: position, pitch yaw roll, velocity, body rates. Behind these come
parameters of the process, estimated with them [Simon, sec. 13.4: parameter estimation]: how much
more effective each control surface is than in the model, as logarithms, and the unmodelled
acceleration [Friedland 1969: bias in recursive filtering]. z is the camera's pose, R its covariance
as the pose network states it, times `correlation`.

A pose belongs to the time at which its image was taken, which is some time ago. The filter goes
back to that time, fuses the pose there, fuses again what is younger, and predicts to the present by
the commands sent since. So a late pose gives the same estimate as the same pose in time [Larsen et
al. 1998: recalculation of the filter through the delay].
"""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from falconwing_kit.aircraft.integrate import advance
from falconwing_kit.aircraft.model import Model
from falconwing_kit.core.checks import Array
from falconwing_kit.core.frames import (
    R_BODY_CAMERA,
    body_rates,
    euler_from_rotation,
    rotation_world_body,
    wrap_angle,
)
from falconwing_kit.core.messages import CONTROL_PERIOD_S

COMMAND_HISTORY = 100  # commands kept: 5 s at 20 Hz, longer than delay, lag and horizon together
DIFFERENCE_STEP = 1e-5  # of central differences; its square and 1e-16 over it are below 1e-10
TIME_ROUNDING = 1e-6  # [s]


class CameraPose(Protocol):
    """A measured pose: `PoseEstimate`, or anything with the same attributes."""

    @property
    def T_world_camera(self) -> Array:
        """(4, 4)."""

    @property
    def covariance(self) -> Array:
        """(6, 6) of position [m] and rotation vector [rad] in world axes."""


class Process(Protocol):
    """Motion of the state."""

    @property
    def parameter_sigmas(self) -> Array:
        """(n,) Standard deviations of its parameters among aircraft, each in the parameter's unit;
        a parameter is zero where the model is right.
        """

    def advance(self, t: float, t_end: float, x: Array) -> Array:
        """States and parameters (12 + n, B) at t_end [s] of those at t [s]."""


@dataclass(frozen=True)
class FilterSettings:
    """Noise, gates and times of the filter."""

    # Process noise of a step of 50 ms, as standard deviations: what is unmodelled and not lasting.
    # Chosen on seeds of tuning: less averages the network's errors over longer, more follows them.
    # Moments of controls are known least, and grow with speed squared: with 0.5 rad/s an aircraft
    # that rolled faster than its model was taken for one that flies 5 m/s faster.
    velocity_noise: float = 0.1  # [m/s]
    rate_noise: float = 1.0  # [rad/s]
    # Similar images have similar errors, so a pose counts as this many: R is multiplied by it.
    correlation: float = 2.0
    # Poses whose own standard deviations reach these are left out: some are off by many metres.
    max_sigma_position: float = 1.0  # [m]
    max_sigma_attitude: float = 0.1  # [rad]
    # Largest y^T S^-1 y, the squared Mahalanobis distance of a pose from the prediction. The
    # network's errors have tails: the chi2 distribution's 22 (once in 1,000) rejects good poses.
    innovation_gate: float = 100.0
    # A filter that rejects so many poses in a row is itself wrong, and starts again from the next.
    max_rejected: int = 10
    horizon_s: float = 0.5  # poses older than this are left out
    # Standard deviations of the start's velocity and rates, which one pose does not show.
    start_velocity_sigma: float = 1.5  # [m/s]
    start_rate_sigma: float = 1.0  # [rad/s]
    # Parameters of the process, in shares of their standard deviations among aircraft: standard
    # deviation at the start, noise of a step and largest value.
    start_parameter_sigma: float = 1.0
    parameter_noise: float = 0.06
    max_parameter: float = 3.6


@dataclass(frozen=True, eq=False)
class Estimate:
    """A state with its covariance at one time."""

    t: float  # [s]
    x: Array  # (12 + n,) in the order of STATE_NAMES, SI, then n parameters of the process
    P: Array  # (12 + n, 12 + n)

    @property
    def sigma_position(self) -> float:
        """Standard deviation of a coordinate, root mean square of the three [m]."""
        return float(np.sqrt(np.trace(self.P[:3, :3]) / 3.0))


@dataclass(frozen=True, eq=False)
class Measurement:
    """z and R: a camera's pose and the covariance that the filter gives it."""

    T_world_camera: Array  # (4, 4)
    R: Array  # (6, 6) of position [m] and rotation vector [rad] in world axes


@dataclass(frozen=True, eq=False)
class Fusion:
    """An estimate right after the pose that was fused into it."""

    estimate: Estimate
    pose: Measurement | None  # None: a prediction, kept so that the next need not start far back


class AircraftProcess:
    """An aircraft's model flown on the commands sent to it, which arrive after a delay.

    The control surfaces of the aircraft that flies may be more or less effective than the model's:
    with factors e, a control position u acts as level + e (u - level) does on the model. The first
    parameters are the logarithms of e for aileron, elevator and rudder.

    Its forces differ too, and a wind that the model has no term for changes them. The other two
    parameters are the unmodelled acceleration along the right wing and the belly at the usual speed
    [m/s^2]; as the forces of the air it grows with speed squared. Without it an aircraft with more
    lift is always higher than predicted, and its estimate stays below it. There is none along the
    nose: with it, landings of tuning scattered more along the runway.
    """

    # 0.5: a factor between 0.6 and 1.6 twice in three, 1/6 to 6 at most; 1 m/s^2: a tenth of the
    # lift. Those of the acceleration were chosen on landings of tuning.
    parameter_sigmas = np.array([0.5, 0.5, 0.5, 0.5, 1.0])

    def __init__(
        self, model: Model, delay: float, level: Array | None = None, speed: float = 7.0
    ) -> None:
        """Begin without a command.

        Args:
            model: the aircraft's.
            delay: from a command to its arrival at the aircraft [s]; the model adds its own.
            level: (4,) control positions of straight level flight; None for neutral and idle.
            speed: the usual one, at which the unmodelled acceleration is stated [m/s].
        """
        self._model, self._delay, self._speed = model, delay, speed
        self._level = np.zeros(4) if level is None else np.asarray(level, np.float64)
        self._times: list[float] = []
        self._commands: list[Array] = []

    def send(self, t: float, command: Array) -> None:
        """Append a command (4,) at a time [s] after the last."""
        self._times.append(t + self._delay)
        self._commands.append(np.asarray(command, np.float64))
        del self._times[:-COMMAND_HISTORY], self._commands[:-COMMAND_HISTORY]

    def advance(self, t: float, t_end: float, x: Array) -> Array:
        """States and parameters (17, B) at t_end of those at t; neutral and idle without a command.

        The parameters stay. The unmodelled acceleration acts half before and half after the model's
        flight [Strang 1968: splitting].
        """
        times = np.array(self._times or [0.0])
        commands = np.array(self._commands or [np.zeros(4)])
        factor = np.concatenate([np.zeros_like(x[:1]), x[12:15]])  # the throttle's is one
        x = x.copy()
        x[6:9] += 0.5 * (t_end - t) * self._unmodelled_acceleration(x)
        x[:12] = advance(
            self._model, t, t_end, x[:12], times, commands, np.exp(factor), self._level
        )
        x[6:9] += 0.5 * (t_end - t) * self._unmodelled_acceleration(x)
        return x

    def _unmodelled_acceleration(self, x: Array) -> Array:
        """In the world (3, B) [m/s^2], of states and parameters (17, B)."""
        a_body = np.concatenate([np.zeros_like(x[:1]), x[15:]])
        a_body *= (x[6:9] ** 2).sum(axis=0) / self._speed**2
        return np.einsum("bij,jb->ib", rotation_world_body(x[5], x[3], x[4]), a_body)


class OnlineFilter:
    """Poses one by one -> estimate; it has none before the first pose that passes its gate."""

    def __init__(
        self, process: Process, v_body_start: Array, p_body_camera: Array,
        settings: FilterSettings | None = None,
    ) -> None:  # fmt: skip
        """Wait for the first pose.

        Args:
            process: motion of the state between poses.
            v_body_start: (3,) velocity in body axes that a start assumes [m/s].
            p_body_camera: (3,) the camera in body axes [m]; it looks along the nose.
            settings: None for the default.
        """
        self.settings = settings or FilterSettings()
        self._process, self._v_body_start = process, np.asarray(v_body_start, np.float64)
        self._p_body_camera = np.asarray(p_body_camera, np.float64)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._fusions: list[Fusion] = []  # in the order of time, not longer than the horizon
        self._now: Estimate | None = None
        self._rejected = 0

    def fuse(self, t: float, pose: CameraPose, inflation: float = 1.0) -> str:
        """Fuse a pose.

        Args:
            t: when its image was taken [s].
            pose: with its covariance as stated, which the limits of the settings are for.
            inflation: of that covariance, 1 or more, where the pose's source is less accurate than
                it states.

        Returns:
            Why it was left out: "uncertain pose", "late image", "implausible pose"; "" if fused.
        """
        limits = self.settings
        if not self._is_certain(pose):
            return "uncertain pose"
        R = inflation * limits.correlation * np.asarray(pose.covariance, np.float64)
        measured = Measurement(np.asarray(pose.T_world_camera, np.float64), R)
        if self._now is not None and t < self._now.t - limits.horizon_s:
            return "late image"
        if not self._fusions or self._rejected >= limits.max_rejected:
            return self._start(t, measured)
        kept = [each for each in self._fusions if each.estimate.t <= t + TIME_ROUNDING]
        younger = [
            (each.estimate.t, each.pose)
            for each in self._fusions[len(kept) :]
            if each.pose is not None
        ]
        if not kept:
            return "late image"
        fused = self._fused(kept[-1].estimate, t, measured)
        if fused is None:
            self._rejected += 1
            return "implausible pose"
        kept.append(Fusion(fused, measured))
        for t_younger, younger_pose in younger:
            fused = self._fused(kept[-1].estimate, t_younger, younger_pose)
            if fused is not None:
                kept.append(Fusion(fused, younger_pose))
        oldest = kept[-1].estimate.t - limits.horizon_s
        self._fusions = [each for each in kept if each.estimate.t >= oldest]
        self._now, self._rejected = self._fusions[-1].estimate, 0
        return ""

    def estimate(self, t: float) -> Estimate | None:
        """The estimate at t [s], predicted from the newest fusion; None without one.

        A prediction that is no longer finite, such as after minutes without a pose, ends the
        estimate: the filter starts again with the next pose.
        """
        if self._now is None:
            return None
        if t > self._now.t + TIME_ROUNDING:
            self._now = self._predicted(self._now, t)
            if not (np.isfinite(self._now.x).all() and np.isfinite(self._now.P).all()):
                self.reset()
            elif t - self._fusions[-1].estimate.t > self.settings.horizon_s:
                self._fusions.append(Fusion(self._now, None))
        return self._now

    def _is_certain(self, pose: CameraPose) -> bool:
        """Whether a pose is finite and its stated covariance is one, within the limits."""
        T, covariance = np.asarray(pose.T_world_camera), np.asarray(pose.covariance)
        if not (np.isfinite(T).all() and np.isfinite(covariance).all()):
            return False
        limits = np.square([self.settings.max_sigma_position, self.settings.max_sigma_attitude])
        variances = np.array([np.trace(covariance[:3, :3]), np.trace(covariance[3:, 3:])]) / 3.0
        return bool((variances < limits).all() and np.linalg.eigvalsh(covariance).min() > 0.0)

    def _start(self, t: float, pose: Measurement) -> str:
        """Start from one pose: flying straight at the usual speed."""
        R_world_body = pose.T_world_camera[:3, :3] @ R_BODY_CAMERA.T
        roll, pitch, yaw = map(float, euler_from_rotation(R_world_body))
        p_world = pose.T_world_camera[:3, 3] - R_world_body @ self._p_body_camera
        v_world = R_world_body @ self._v_body_start
        scales = self._process.parameter_sigmas
        n = len(scales)
        x = np.concatenate([p_world, [pitch, yaw, roll], v_world, np.zeros(3 + n)])
        # The pose part of H is square: the covariance of the six is H^-1 R H^-T.
        H_inverse = np.linalg.inv(self._linearised(x)[:, :6])
        P = np.zeros((12 + n, 12 + n))
        P[:6, :6] = H_inverse @ pose.R @ H_inverse.T
        start = self.settings
        motion = np.repeat([start.start_velocity_sigma, start.start_rate_sigma], 3)
        sigmas = np.concatenate([motion, start.start_parameter_sigma * scales])
        P[6:, 6:] = np.diag(sigmas**2)
        if self._now is not None:  # what was found of the process stays true
            x[12:], P[12:, 12:] = self._now.x[12:], self._now.P[12:, 12:]
        self._now = Estimate(t, x, P)
        self._fusions, self._rejected = [Fusion(self._now, pose)], 0
        return ""

    def _predicted(self, estimate: Estimate, t: float) -> Estimate:
        """The estimate at a later time, in steps of 50 ms at most."""
        n = len(estimate.x)
        noise = np.zeros(n)
        noise[6:9], noise[9:12] = self.settings.velocity_noise, self.settings.rate_noise
        noise[12:] = self.settings.parameter_noise * self._process.parameter_sigmas
        while estimate.t < t - TIME_ROUNDING:
            t_next = min(estimate.t + CONTROL_PERIOD_S, t)
            # One batch: the state, and each coordinate moved up and down for the derivative F.
            moved = DIFFERENCE_STEP * np.eye(n)
            x = estimate.x[:, None]
            batch = np.concatenate([x, x + moved, x - moved], axis=1)
            with np.errstate(all="ignore"):  # what is not finite is found by the caller
                after = self._process.advance(estimate.t, t_next, batch)
                F = (after[:, 1 : n + 1] - after[:, n + 1 :]) / (2.0 * DIFFERENCE_STEP)
                Q = np.diag(noise**2) * (t_next - estimate.t) / CONTROL_PERIOD_S
                estimate = Estimate(t_next, after[:, 0], F @ estimate.P @ F.T + Q)
        return replace(estimate, t=t)

    def _fused(self, before: Estimate, t: float, pose: Measurement) -> Estimate | None:
        """The estimate at t with a pose fused into it; None where the gate rejects it."""
        now, newest = self._now, self._fusions[-1].estimate
        # A pose of the present: the prediction to now is that to its image.
        is_now = now is not None and before is newest and abs(now.t - t) < TIME_ROUNDING
        predicted = now if now is not None and is_now else self._predicted(before, t)
        x, P = predicted.x, predicted.P
        if not (np.isfinite(x).all() and np.isfinite(P).all()):
            return None
        y, H = self._innovation(x, pose), self._linearised(x)
        S = H @ P @ H.T + pose.R
        if not y @ np.linalg.solve(S, y) < self.settings.innovation_gate:
            return None
        K = np.linalg.solve(S, H @ P).T  # P and S are symmetric
        x = x + K @ y
        x[3:6] = wrap_angle(x[3:6])
        largest = self.settings.max_parameter * self._process.parameter_sigmas
        x[12:] = np.clip(x[12:], -largest, largest)
        rest = np.eye(len(x)) - K @ H
        P = rest @ P @ rest.T + K @ pose.R @ K.T
        return Estimate(t, x, 0.5 * (P + P.T))

    def _innovation(self, x: Array, pose: Measurement) -> Array:
        """y (6,): measured minus predicted camera position [m], and the rotation vector [rad] in
        world axes that turns the predicted camera into the measured one.
        """
        from scipy.spatial.transform import Rotation

        R_world_body = rotation_world_body(x[5], x[3], x[4])
        p_world_camera = x[:3] + R_world_body @ self._p_body_camera
        R_world_camera = R_world_body @ R_BODY_CAMERA
        turn = Rotation.from_matrix(pose.T_world_camera[:3, :3] @ R_world_camera.T).as_rotvec()
        return np.concatenate([pose.T_world_camera[:3, 3] - p_world_camera, turn])

    def _linearised(self, x: Array) -> Array:
        """H (6, 12 + n), the derivative of the camera's position and rotation vector by the state.

        A small change of an angle turns the body by w in world axes, w = R_world_body (p, q, r) of
        that angle's rate [Stevens, Lewis & Johnson, eq. 1.4-4], and moves the camera by w x r, with
        r = R_world_body p_body_camera its lever arm.
        """
        pitch, yaw, roll = x[3:6]
        R_world_body = rotation_world_body(roll, pitch, yaw)
        # Columns: unit rates of pitch, yaw and roll.
        unit_rates = {"pitch_rate": (1, 0, 0), "yaw_rate": (0, 1, 0), "roll_rate": (0, 0, 1)}
        per_angle = R_world_body @ np.array(
            body_rates(roll, pitch, **{name: np.array(unit) for name, unit in unit_rates.items()})
        )
        lever = R_world_body @ self._p_body_camera
        H = np.zeros((6, len(x)))
        H[:3, :3] = np.eye(3)
        H[:3, 3:6] = np.cross(per_angle, lever, axisa=0).T
        H[3:, 3:6] = per_angle
        return H
