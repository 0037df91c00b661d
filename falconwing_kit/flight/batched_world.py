"""Batched world: the same simulated world as in world.py for many landings at once, in NumPy and
numba.

Row by row it is `SimulatedWorld` without a leader: the same model, delay, servo lag, noise, filter
and contact. States agree to rounding and 2e-9 of the control range: the servos are carried on from
step to step here, and start 0.6 s before each step there.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.aircraft.airframe import Airframe
from falconwing_kit.aircraft.integrate import SUBSTEPS, advance_compiled
from falconwing_kit.aircraft.model import Model
from falconwing_kit.aircraft.touchdown import (
    LandingPad,
    pad_height,
    wheel_positions,
    wheel_velocities,
)
from falconwing_kit.control.guidance import Hall
from falconwing_kit.control.loops import LINK_DELAY_S
from falconwing_kit.core.checks import Array, InputError, require_range, require_shape
from falconwing_kit.core.frames import body_rates, wrap_angle
from falconwing_kit.core.messages import CONTROL_PERIOD_S
from falconwing_kit.flight.world import (
    FRAMES_BEFORE_START,
    NO_PAD,
    Contact,
    PoseFilter,
    PoseNoise,
    corner_positions,
    filter_transition,
    find_contact,
)

POSE = [0, 1, 2, 5, 3, 4]  # x y z roll pitch yaw of a state
SETTLED_FRAMES = 200  # after so many the filter's gain is constant to rounding
TOUCH_MARGIN = 1e-6  # rows nearer than this to a contact are looked at one by one [m]


class BatchedWorld:
    """Many flights of one modelled aircraft, advanced together; `begin` starts each of them.

    Attributes:
        x: (B, 12) true states in the order of STATE_NAMES, SI; constant from a contact on.
        measured: (B, 12) noisy poses, with velocities and body rates of the filter.
        frames: (B,) steps since the start of each flight.
        contacts: of each flight the first contact, None while it flies.
    """

    def __init__(
        self, model: Model, airframe: Airframe, count: int, *, pad: LandingPad | None = None,
        hall: Hall | None = None, noise: PoseNoise | None = None, delay: float = LINK_DELAY_S,
    ) -> None:  # fmt: skip
        """Nothing flies before `begin`.

        Args:
            model: the aircraft that flies, of 12 states; an effect may add to forces, wind, delay
                and lag.
            airframe: positions of wheels, wing tips and nose.
            count: B, number of flights.
            pad: the landing pad, None for a bare floor.
            hall: its walls; None for the default.
            noise: of the measured pose; None for the default.
            delay: from a command to the aircraft's own input [s].

        Raises:
            InputError: the model has 9 states, or an effect that changes commands or measurements.
        """
        _require_plain(model)
        self._model, self._airframe = model, airframe
        self._pad, self._hall = pad or NO_PAD, hall or Hall()
        noise = noise or PoseNoise()
        self._sigma = np.repeat((noise.position, noise.attitude), 3)
        self._gains, self._transition = _gains(noise), filter_transition(CONTROL_PERIOD_S)
        self._weights = _weights(self._gains[: FRAMES_BEFORE_START + 1], self._transition)
        B = int(require_range("count", count, low=1, high=1_000_000))
        added_delay, added_lag, _ = model.added_input_map(model.K)
        self._lag = max(model.K.lag + added_lag, 0.0)
        self._dt = CONTROL_PERIOD_S / SUBSTEPS[model.form]
        late = require_range("delay", delay, low=0.0, high=1.0) + max(
            model.K.delay + added_delay, 0.0
        )
        self._changes = _command_changes(late, SUBSTEPS[model.form])
        self._sent = np.zeros((1 + max(change[0] for change in self._changes), B, 4))
        self._servo = np.zeros((B, 4))
        self._filter = np.zeros((B, 3, 6))
        self._seeds = [0] * B
        self.x, self.measured = np.zeros((B, 12)), np.zeros((B, 12))
        self.frames = np.zeros(B, np.int64)
        self.contacts: list[Contact | None] = [None] * B
        self._flies = np.zeros(B, bool)

    @property
    def t(self) -> Array:
        """(B,) time since the start of each flight [s]."""
        return np.asarray(CONTROL_PERIOD_S * self.frames, np.float64)

    def begin(self, rows: Sequence[int], starts: Array, seeds: Sequence[int]) -> None:
        """Begin new flights.

        Args:
            rows: (n,) which of the B.
            starts: (n, 12) true states at t = 0.
            seeds: (n,) of the noise of each.

        Raises:
            InputError: a start is not finite, or the numbers of rows differ.
        """
        x = require_shape("starts", starts, (len(rows), 12))
        if not np.isfinite(x).all():
            raise InputError("starts: expected finite states, got nan or infinity; set all numbers")
        index = np.asarray(rows, np.int64)
        self.x[index], self.frames[index], self._flies[index] = x, 0, True
        for row, seed in zip(rows, seeds, strict=True):
            self._seeds[row], self.contacts[row] = int(seed), None
        self._settle_filter(index, x)

    def advance(self, commands: Array) -> None:
        """Send a command to every flight and fly one control period; flights in contact stand.

        Args:
            commands: (B, 4) in the order of COMMAND_NAMES, within their limits.
        """
        commands = require_shape("commands", commands, (len(self.x), 4))
        first = self.frames == 0  # a flight's first command also acts before its time
        self._sent[1:] = self._sent[:-1]
        self._sent[0] = commands
        self._sent[:, first] = self._servo[first] = commands[first]
        mean, slope = self._positions()
        flown = advance_compiled(self._model, self.t, self.x, mean, slope, self._dt)
        before, self.x = self.x, np.where(self._flies[:, None], flown, self.x)
        self.frames = self.frames + 1
        rows = np.flatnonzero(self._flies)
        for row in rows[self._may_touch(before[rows], self.x[rows])]:
            self._look_for_contact(int(row), before[row])
        self._measure(rows)

    def _positions(self) -> tuple[Array, Array]:
        """Mean and slope (B, S, 4) of the control positions; see `inputs.actuator_response`."""
        parts, dt, lag = [], self._dt, self._lag
        for before_age, after_age, since in self._changes:
            before, after = self._sent[before_age], self._sent[after_age]
            mean = (before * (dt - since) + after * since) / dt
            moment = 0.5 * (after - before) * since * (dt - since)
            if lag > 1e-6:
                decay, decay_since = math.exp(-dt / lag), math.exp(-since / lag)
                begin = self._servo
                end = decay * begin + before * (decay_since - decay) + after * (1.0 - decay_since)
                mean = mean - lag / dt * (end - begin)
                moment = moment - lag * dt * (0.5 * (begin + end) - mean)
                self._servo = end
            parts.append((mean, 6.0 * moment / dt**2))
        means, slopes = zip(*parts, strict=True)
        return np.stack(means, axis=1), np.stack(slopes, axis=1)

    def _may_touch(self, before: Array, x: Array) -> NDArray[np.bool_]:
        """Rows (n,) that may have touched anything; `find_contact` then decides."""
        corners = corner_positions(x, self._airframe)
        near = np.any(corners[..., 2] < pad_height(corners, self._pad) + TOUCH_MARGIN, axis=-1)
        near |= corners[..., 2].max(axis=-1) > self._hall.beams - TOUCH_MARGIN
        level = corners * (1.0, 1.0, 0.0)
        near |= self._hall.margin(level).min(axis=-1) < TOUCH_MARGIN
        low = (x[:, 2] < self._pad.height + 1.0) | ~np.isfinite(x).all(axis=1)
        rows = np.flatnonzero(low & ~near)
        both = np.stack([before[rows], x[rows]])
        z = wheel_positions(both, self._airframe)[..., 2]
        rise = CONTROL_PERIOD_S / 3.0 * wheel_velocities(both, self._airframe)[..., 2]
        # A cubic lies within its Bezier points, and the wheels' paths are cubics in a step.
        lowest = np.minimum(np.minimum(z[0], z[1]), np.minimum(z[0] + rise[0], z[1] - rise[1]))
        near[rows] = ~(lowest.min(axis=-1) > self._pad.height + TOUCH_MARGIN)
        return near

    def _look_for_contact(self, row: int, before: Array) -> None:
        t = CONTROL_PERIOD_S * float(self.frames[row])
        contact = find_contact(
            (t - CONTROL_PERIOD_S, t), np.stack([before, self.x[row]]),
            self._airframe, self._pad, self._hall,
        )  # fmt: skip
        if contact is not None:
            self.contacts[row], self._flies[row] = contact, False

    def _settle_filter(self, rows: NDArray[np.int64], x: Array) -> None:
        """Filter of flights at their start x (n, 12): measured on the straight line that leads
        there, as in world.py, so it is the sum of those poses with fixed weights.
        """
        t = CONTROL_PERIOD_S * np.arange(-FRAMES_BEFORE_START, 1)
        poses = np.repeat(x[:, None, POSE], len(t), axis=1)
        poses[..., :3] += t[:, None] * x[:, None, 6:9]
        for k in range(len(t)):
            poses[:, k] += self._noise(rows, np.full(len(rows), k))
        self._filter[rows] = np.einsum("kij,nkj->nij", self._weights, poses)
        self._write_measured(rows, poses[:, -1])

    def _measure(self, rows: NDArray[np.int64]) -> None:
        """Noisy poses of some rows into their filters, as `PoseFilter.update`."""
        draws = self.frames[rows] + FRAMES_BEFORE_START
        pose = self.x[rows][:, POSE] + self._noise(rows, draws)
        x = self._transition @ self._filter[rows]
        innovation = pose - x[:, 0]
        innovation[:, 3:] = wrap_angle(innovation[:, 3:])
        gains = self._gains[np.minimum(draws, SETTLED_FRAMES)]
        self._filter[rows] = x + gains * innovation[:, None]
        self._write_measured(rows, pose)

    def _noise(self, rows: NDArray[np.int64], draws: NDArray[np.int64]) -> Array:
        """(n, 6) noise of some rows: the same stream for a seed and a frame as in world.py."""
        if not self._sigma.any():
            return np.zeros((len(rows), 6))
        noise = np.empty((len(rows), 6))
        for k, (row, draw) in enumerate(zip(rows.tolist(), draws.tolist(), strict=True)):
            noise[k] = np.random.default_rng([self._seeds[row], draw]).normal(size=6)
        return self._sigma * noise

    def _write_measured(self, rows: NDArray[np.int64], pose: Array) -> None:
        """Measured states: the noisy poses (n, 6), velocities and body rates of the filter."""
        (value, rate), measured = self._filter[rows, :2].swapaxes(0, 1), self.measured
        measured[rows, :6] = pose[:, [0, 1, 2, 4, 5, 3]]
        measured[rows, 6:9] = rate[:, :3]
        rates = body_rates(value[:, 3], value[:, 4], rate[:, 3], rate[:, 4], rate[:, 5])
        measured[rows, 9:12] = np.stack(rates, axis=-1)


def _require_plain(model: Model) -> None:
    """InputError unless all effects of a 12-state model act on forces, wind, delay or lag."""
    if model.form != "rates":
        raise InputError(
            f"model: expected the 12-state model, got form {model.form!r}; use rates_model()"
        )
    for effect in model.effects:
        if effect.command_map is not None or effect.measurement_map is not None:
            raise InputError(
                f"model: expected effects on forces, wind, delay or lag, got {effect.name}; fly it"
                " in SimulatedWorld"
            )
    if model.added_input_map(model.K)[2] > 1e-6:
        raise InputError(
            "model: expected at most one lag, got a second one in series; fly it in SimulatedWorld"
        )


def _gains(noise: PoseNoise) -> Array:
    """(SETTLED_FRAMES + 1, 3, 6) gains of the pose filter's updates, which no measurement moves."""
    pose_filter, gains = PoseFilter(noise), np.empty((SETTLED_FRAMES + 1, 3, 6))
    for frame in range(SETTLED_FRAMES + 1):
        pose_filter.update(frame * CONTROL_PERIOD_S, np.zeros(6))
        gains[frame] = pose_filter.gain
    return gains


def _weights(gains: Array, transition: Array) -> Array:
    """(n, 3, 6) weights of n poses in the filter after the last one, from its gains (n, 3, 6)."""
    weights = np.zeros_like(gains)
    weights[0, 0] = 1.0  # the filter begins at the first pose
    for k in range(1, len(gains)):
        predicted = transition @ weights[:k]
        weights[:k] = predicted - gains[k] * predicted[:, :1]
        weights[k] = gains[k]
    return weights


def _command_changes(late: float, substeps: int) -> list[tuple[int, int, float]]:
    """Which commands act during each integration step of a control period.

    Args:
        late: from a command to the servo [s].
        substeps: integration steps in a control period.

    Returns:
        Of each step: age of the command at its begin, and at its end, in periods, and the time that
        the second one acts within the step [s].
    """
    edges = CONTROL_PERIOD_S / substeps * np.arange(substeps + 1) - late
    rows = np.floor(edges / CONTROL_PERIOD_S + 1e-9)
    since = np.maximum(edges - rows * CONTROL_PERIOD_S, 0.0)
    return [
        (-int(rows[k]), -int(rows[k + 1]), float(since[k + 1]) if rows[k + 1] > rows[k] else 0.0)
        for k in range(substeps)
    ]
