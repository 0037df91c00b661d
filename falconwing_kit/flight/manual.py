"""Manual pilot: a person's sticks -> commands, as they are or with the beginner's assist.

    pilot = load_pilot("manual", task="landing")
    pilot.sticks.put(Sticks(0.5, 0.0, 0.0, 0.0, hold=True, stamp=t))     # from any thread
    pilot.assist = True
    command = pilot.act(observation)                                     # and pilot.mode

Without the assist the sticks are the command. With it they set a flight that the autopilot of
control/loops.py holds:

    aileron stick    bank, so centred is straight
    elevator stick   climb angle, so centred is level
    throttle stick   speed, half way is that of the approach; fully back stops the motor
    rudder stick     nothing: turns are coordinated

The assist does not land. Beside the pad it levels off above the floor; over the pad it limits the
sink rate, so that only a stick that is pushed brings the wheels down, and softly only by hand.
"""

import math
import threading
from collections.abc import Callable
from dataclasses import astuple, dataclass, replace

import numpy as np

from falconwing_kit.aircraft.airframe import Airframe
from falconwing_kit.aircraft.model import Model
from falconwing_kit.aircraft.touchdown import LandingPad, wheel_heights
from falconwing_kit.control.expert import EstimatingAutopilot, landing_speed
from falconwing_kit.control.guidance import Hall
from falconwing_kit.control.loops import LINK_DELAY_S, Reference, course_axes
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.messages import SAFE_COMMAND, Command, Observation, State

SILENCE_S = 0.2  # age of the newest sticks from which on they count as let go
NO_STICKS, RELEASED, SILENT = "no sticks", "sticks released", "sticks silent"
MANUAL, ASSISTED, NO_STATE = "manual", "manual, assist", "manual, no state for the assist"

# What full sticks ask of the assist.
MAX_BANK, BANK_RATE = math.radians(35.0), math.radians(150.0)  # [rad, rad/s]
MAX_CLIMB = math.radians(8.0)  # [rad]
MAX_RATE_CHANGE = 3.0  # of the rate of climb [m/s^2]
SPEED_SPAN = 1.5  # either side of the speed of the approach [m/s]
IDLE_BELOW = 0.03  # throttle stick that stops the motor
LEVEL_BANK = math.radians(1.0)  # of the reference: below it the turn has ended
STRAIGHT_ROLL = math.radians(5.0)  # below it the course is taken for the line to hold
# Of the reference above or below the aircraft, at most: while it climbs or descends, and level [m].
HEIGHT_LEAD, HEIGHT_HOLD = 0.03, 0.3
# Near the floor: height of the lowest wheel that full forward stick leaves beside the pad, time in
# which the height above it falls to 1/e, sink rate that is left at the pad.
CLEARANCE, SETTLING_S, TOUCH_SINK = 0.3, 0.6, 0.3  # [m, s, m/s]
LOW_BANK, FULL_BANK_AT = math.radians(8.0), 0.5  # with the wheels on the ground [rad]; from [m] on
PAD_MARGIN = 0.3  # from the pad's edges, within which the sink rate is limited and no more [m]
CEILING_MARGIN = 0.6  # [m]
LONGEST_STEP_S = 0.2  # that the references move in; after a longer gap they begin anew


@dataclass(frozen=True)
class Sticks:
    """Sticks as a person moves them."""

    throttle: float  # 0..1
    aileron: float  # -1..1, positive right wing down
    elevator: float  # -1..1, positive nose up
    rudder: float  # -1..1, positive nose right
    hold: bool  # the button or key that must be held to fly
    stamp: float  # [s] on the clock of the pilot


class StickSource:
    """The newest sticks; any thread may put some."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest: Sticks | None = None

    def put(self, sticks: Sticks) -> bool:
        """Take sticks; False where they are not finite or older than those that are here."""
        try:
            finite = all(map(math.isfinite, astuple(sticks)))
        except TypeError:
            return False
        with self._lock:
            if not finite or (self._newest is not None and sticks.stamp < self._newest.stamp):
                return False
            self._newest = sticks
        return True

    def clear(self) -> None:
        """Forget the sticks."""
        with self._lock:
            self._newest = None

    @property
    def newest(self) -> Sticks | None:
        """The newest sticks; None before the first."""
        return self._newest


class ManualPilot:
    """Flies by sticks; without any, or after 0.2 s of silence, it gives the safe command."""

    reads_state = True

    def __init__(
        self, model: Model, airframe: Airframe, pad: LandingPad,
        sticks: StickSource | None = None, assist: bool = False,
        clock: Callable[[], float] | None = None, delay: float = LINK_DELAY_S,
    ) -> None:  # fmt: skip
        """Wait for sticks.

        Args:
            model: that the assist is designed on.
            airframe: wheels, for the height that the assist leaves.
            pad: where the assist lets the wheels touch.
            sticks: where they come from; None for a new source.
            assist: whether the beginner's assist is on.
            clock: of the sticks' stamps [s]; None: the time of the observations.
            delay: from a command to its arrival at the aircraft [s], for the assist.

        Raises:
            InputError: assist is on and cannot be designed on this model.
        """
        self._make = lambda: Assist(model, airframe, pad, delay)
        self._assist: Assist | None = None
        self._clock = clock
        self.sticks, self.mode = sticks or StickSource(), NO_STICKS
        self.assist = assist

    @property
    def assist(self) -> bool:
        """Whether the beginner's assist is on; it may be set in flight, from any thread.

        Raises:
            InputError: it cannot be designed on this model; the pilot flies on without.
        """
        return self._assist is not None

    @assist.setter
    def assist(self, on: bool) -> None:
        """Switch it on or off."""
        if not on:
            self._assist = None
        elif self._assist is None:
            self._assist = self._make()

    def reset(self) -> None:
        """Begin a new flight: no sticks, nothing left in the assist."""
        self.sticks.clear()
        self.mode = NO_STICKS
        if self._assist is not None:
            self._assist = self._make()

    def act(self, observation: Observation) -> Command:
        """The command of the sticks; the safe one where no one holds them."""
        now = observation.t if self._clock is None else self._clock()
        sticks, assist = self.sticks.newest, self._assist
        if sticks is None or not sticks.hold or not abs(now - sticks.stamp) <= SILENCE_S:
            self.mode = NO_STICKS if sticks is None else SILENT if sticks.hold else RELEASED
            if assist is not None:
                assist.release()
            return SAFE_COMMAND
        plain = Command.clip(sticks.throttle, sticks.aileron, sticks.elevator, sticks.rudder)
        if assist is None:
            self.mode = MANUAL
            return plain
        command = assist.command(observation, plain)
        self.mode = NO_STATE if command is None else ASSISTED
        return plain if command is None else command


class Assist:
    """The beginner's assist: sticks and a measured state -> the command that flies what they ask.

    The reference moves as the sticks ask, and the autopilot follows it. While the aircraft turns,
    the reference has its place and course; straight ahead, it is a line.
    """

    def __init__(
        self, model: Model, airframe: Airframe, pad: LandingPad, delay: float = LINK_DELAY_S
    ) -> None:
        """Design the loops; InputError where the model cannot be trimmed or stabilised."""
        self.speed = landing_speed(model)
        self._autopilot = EstimatingAutopilot(model, self.speed, delay)
        self._airframe, self._pad = airframe, pad
        self._highest = Hall().beams - CEILING_MARGIN
        self._t = math.nan
        self.release()

    def release(self) -> None:
        """Begin anew at the next sticks: level flight where the aircraft is then."""
        self._line: tuple[Array, float] | None = None  # a point (3,) [m] and a course [rad]
        self._height: float | None = None  # of the reference [m]
        self._bank = self._rate = 0.0  # of the reference [rad], [m/s] upward

    def command(self, observation: Observation, sticks: Command) -> Command | None:
        """The command; None without a finite state.

        Args:
            observation: its state, time and past commands are used.
            sticks: within their limits.
        """
        past_commands = np.nan_to_num(observation.past_commands)
        observation = replace(observation, past_commands=past_commands)
        try:
            state = self._autopilot.estimate(observation)
            if state is None:
                self.release()
                return None
            reference = self._reference(observation.t, state, sticks)
            idle = sticks.throttle < IDLE_BELOW
            return self._autopilot.track(state, reference, observation, idle)
        except InputError:  # a state beyond all flight
            self.release()
            return None

    def _reference(self, t: float, state: State, sticks: Command) -> Reference:
        """The flight that the sticks ask for at t [s]."""
        step, self._t = t - self._t, t
        if not 0.0 <= step <= LONGEST_STEP_S:
            self.release()
            step = 0.0
        wheels = float(np.min(wheel_heights(state.vector, self._airframe, self._pad)))
        # A wing tip must not reach the ground before a wheel does.
        free = LOW_BANK + (MAX_BANK - LOW_BANK) * min(max(wheels / FULL_BANK_AT, 0.0), 1.0)
        bank = min(max(MAX_BANK * sticks.aileron, -free), free)
        self._bank = _approach(self._bank, bank, BANK_RATE * step)
        speed = self.speed + SPEED_SPAN * (2.0 * sticks.throttle - 1.0)
        rate = speed * math.sin(MAX_CLIMB * sticks.elevator)
        height = self._vertical(state, wheels, rate, step)
        place, course = self._lateral(state, sticks)
        p_world = np.array([place[0], place[1], height])
        return Reference(p_world, course, math.asin(self._rate / speed), speed, self._bank)

    def _lateral(self, state: State, sticks: Command) -> tuple[Array, float]:
        """The nearest point of the line to hold and its course; while turning, the aircraft's own.

        The line begins where the aircraft has rolled out, for until then its course changes.
        """
        v_x, v_y, _ = state.v_world
        course = math.atan2(-v_y, v_x)
        if abs(self._bank) > LEVEL_BANK or sticks.aileron:
            self._line = None
            return state.p_world, course
        if self._line is None and abs(state.roll) > STRAIGHT_ROLL:
            return state.p_world, course
        if self._line is None:
            self._line = state.p_world, course
        point, course = self._line
        ahead = course_axes(course)[0]
        return point + ((state.p_world - point) @ ahead) * ahead, course

    def _vertical(self, state: State, wheels: float, rate: float, step: float) -> float:
        """Height of the reference [m], from the lowest wheel's [m] and the rate asked for [m/s]."""
        z = float(state.p_world[2])
        height = z if self._height is None else self._height
        if self._is_over_pad(state.p_world):
            lowest_rate = -TOUCH_SINK - max(wheels, 0.0) / SETTLING_S
        else:
            # The wheels' height above the ground that the reference has, over its clearance.
            lowest_rate = -(wheels + height - z - CLEARANCE) / SETTLING_S
        limit = self.speed * math.sin(MAX_CLIMB)
        highest_rate = (self._highest - height) / SETTLING_S
        rate = min(max(rate, min(lowest_rate, limit)), max(highest_rate, -limit))
        self._rate = _approach(self._rate, rate, MAX_RATE_CHANGE * step)
        # A reference far ahead would make the aircraft faster than asked for, and one that it has
        # passed would call it back.
        below, above = HEIGHT_HOLD, HEIGHT_HOLD
        if rate:
            below, above = (HEIGHT_LEAD, 0.0) if rate < 0.0 else (0.0, HEIGHT_LEAD)
        self._height = min(max(height + self._rate * step, z - below), z + above)
        return self._height

    def _is_over_pad(self, p_world: Array) -> bool:
        pad = self._pad
        along, across = p_world[0] - pad.x_start, abs(p_world[1] - pad.y_centre)
        inside = pad.length - PAD_MARGIN >= along >= PAD_MARGIN
        return bool(inside and across <= pad.width / 2.0 - PAD_MARGIN)


def _approach(value: float, target: float, step: float) -> float:
    """The value moved towards a target by at most a step."""
    return value + min(max(target - value, -step), step)
