"""Scripted keyboard pilot: what the page shows, 250 ms late -> keys, at most four changes a second.

It stands for a person in benchmarks. It has the STATE message of the page (pose, speed, the sticks)
and the pad's place, nothing else: rates are differences of what was shown. It moves by taps: it
chooses how long a key stays down when it presses it, as a practised hand does, and counts on taps
whose effect is not shown yet.

    keys (here) -> sticks (key_step, as page/sticks.js) -> ManualPilot -> SimulatedWorld
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.core.messages import CONTROL_PERIOD_S, Observation, State
from falconwing_kit.flight.loop import LoopStep
from falconwing_kit.flight.manual import ManualPilot, Sticks
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.flight.tasks.landing import LandingTask
from tests.tools.classroom.stick_keys import KEY_RATE, SPRING_RATE, THROTTLE_RATE, key_step

REACTION_S = 0.25
CHANGES, WITHIN_S = 4, 1.0  # key changes, down or up, in any such time
KEY_PERIOD_S = 0.02  # of the page's stick messages: 50 Hz
DIFFERENCE_S = 0.2  # over which a rate is seen
SHORTEST_TAP_S, LONGEST_TAP_S = 0.06, {"aileron": 0.5, "elevator": 1.2}
SPRING_S = 0.25  # after a tap the stick is back at its centre
FOREVER = 1e3


@dataclass(frozen=True)
class Shown:
    """One STATE message, as far as it is used."""

    t: float  # [s]
    p_world: np.ndarray  # (3,) [m]
    roll: float  # [rad]
    throttle: float


@dataclass
class Tap:
    """A key that goes down and up again."""

    stick: str
    side: int
    down: float  # [s]
    up: float

    @property
    def area(self) -> float:
        """Travel times time of the stick, with the spring's way back [s]."""
        return self.side * stick_area(self.up - self.down)


def stick_area(seconds: float) -> float:
    """Travel times time that a tap gives: up at KEY_RATE to the stop, back at SPRING_RATE."""
    peak = min(KEY_RATE * seconds, 1.0)
    rise = peak / KEY_RATE
    return 0.5 * peak * rise + (seconds - rise) * peak + 0.5 * peak**2 / SPRING_RATE


def tap_seconds(area: float) -> float:
    """How long to press for an area, the inverse of `stick_area`."""
    to_stop = stick_area(1.0 / KEY_RATE)
    if area > to_stop:
        return 1.0 / KEY_RATE + area - to_stop
    return math.sqrt(area / (0.5 * KEY_RATE + 0.5 * KEY_RATE**2 / SPRING_RATE))


@dataclass(frozen=True)
class Skill:
    """What the person has learnt: how far a tap goes, and how it approaches."""

    roll: float = 2.6  # bank after a tap, without the assist [rad/s per travel]
    slope: float = 2.4  # change of the flight path, without the assist [rad/s per travel]
    bank: float = 0.61  # bank that full stick asks of the assist [rad]
    climb: float = 0.9  # climb that full stick asks of the assist [m/s]
    ahead: float = 8.0  # distance in which it steers back to the centre line [m]
    intercept: float = math.radians(15.0)
    turn_s: float = 0.9  # time in which it turns to a course, without the assist
    largest_bank: float = math.radians(25.0)
    over_threshold: float = 0.5  # height of the centre of gravity [m]
    descend_s: float = 0.9  # time in which it corrects its height
    idle_before: float = 5.0  # of the threshold, without the assist [m]
    pace_s: float = 0.35  # between two taps, so that one is left for what comes
    turn_ahead_s: float = 0.6  # for which it counts on the bank that it sees, without the assist
    roll_first: float = 1.5  # weight of the bank against the other sticks, without the assist
    flare: float = 0.3  # slope over height, without the assist [rad/m]
    course_band: float = math.radians(3.0)  # errors that it lets be [rad]
    roll_band: float = math.radians(4.0)
    slope_band: float = 0.035
    height_band: float = 0.12  # [m]


# By practice on training seeds: with the assist one tap is a turn; without, a bank that stays.
ASSISTED = Skill(pace_s=0.15)
PLAIN = Skill(largest_bank=0.25, turn_ahead_s=0.8, pace_s=0.1, slope_band=0.05)


class KeyboardPilot:
    """Lands by keys."""

    def __init__(self, pad: LandingPad, assist: bool, skill: Skill | None = None) -> None:
        self.pad, self.assist, self.skill = pad, assist, skill or (ASSISTED if assist else PLAIN)
        self._shown: deque[Shown] = deque(maxlen=100)
        self.taps: list[Tap] = []

    def look(self, shown: Shown) -> None:
        """What the page shows now; it counts REACTION_S later."""
        self._shown.append(shown)

    def keys(self, t: float) -> dict[str, int]:
        """The keys that are down at t [s]."""
        seen = [shown for shown in self._shown if shown.t <= t - REACTION_S + 1e-9]
        if len(seen) > round(DIFFERENCE_S / CONTROL_PERIOD_S):
            self._decide(t, seen[-1], seen[-1 - round(DIFFERENCE_S / CONTROL_PERIOD_S)])
        return {tap.stick: tap.side for tap in self.taps if tap.down <= t < tap.up}

    def _decide(self, t: float, now: Shown, before: Shown) -> None:
        """Press at most one key: the one that is most needed."""
        velocity = (now.p_world - before.p_world) / (now.t - before.t)
        needs = self._assisted(t, now, velocity) if self.assist else self._plain(t, now, velocity)
        for need, stick, area in sorted(needs, reverse=True, key=lambda each: each[0]):
            if need >= 1.0 and self._press(t, stick, area):
                return

    def _press(self, t: float, stick: str, area: float) -> bool:
        """Begin a tap; False where the key is down, or one change too many would follow."""
        side = 1 if area > 0.0 else -1
        if abs(area) >= FOREVER:
            for tap in self.taps:
                if tap.stick == stick and tap.side == side and t < tap.up:
                    tap.up = t + FOREVER  # the key that is down stays down
                    return True
        if any(tap.stick == stick and t < tap.up + SPRING_S for tap in self.taps):
            return False
        if self.taps and t < self.taps[-1].down + self.skill.pace_s:
            return False
        if stick == "throttle":
            seconds = abs(area) / THROTTLE_RATE
        else:
            seconds = FOREVER if abs(area) >= FOREVER else tap_seconds(abs(area))
            seconds = seconds if seconds == FOREVER else min(seconds, LONGEST_TAP_S[stick])
        up = t + max(seconds, SHORTEST_TAP_S)
        changes = sorted([t, up, *(time for tap in self.taps for time in (tap.down, tap.up))])
        if any(b - a < WITHIN_S for a, b in zip(changes, changes[CHANGES:], strict=False)):
            return False
        self.taps.append(Tap(stick, side, t, up))
        return True

    def _pending(self, stick: str, since: float) -> float:
        """Area of the taps of a stick whose effect is not shown yet [s]."""
        taps = [tap for tap in self.taps if tap.stick == stick and tap.up > since]
        return sum(tap.area * min((tap.up - since) / (tap.up - tap.down), 1.0) for tap in taps)

    def _seconds(self, stick: str, since: float) -> float:
        """Time that the keys of a stick are down after a time, negative for the other side [s]."""
        times = (
            (tap.side, max(tap.up - max(tap.down, since), 0.0))
            for tap in self.taps
            if tap.stick == stick
        )
        return sum(side * seconds for side, seconds in times)

    def _course(self, t: float, now: Shown, velocity: np.ndarray) -> tuple[float, float]:
        """Course that is flown and course to fly [rad], positive to the right."""
        course = math.atan2(-velocity[1], velocity[0])
        left = now.p_world[1] + velocity[1] * (t - now.t + 0.2) - self.pad.y_centre
        wish = math.atan2(left, self.skill.ahead)
        return course, max(min(wish, self.skill.intercept), -self.skill.intercept)

    def _wish_height(self, x: float) -> float:
        """Height to fly at x: level over the threshold's height, reached on a line of 4 deg."""
        low = self.skill.over_threshold
        return low + max(self.pad.x_start - 1.0 - x, 0.0) * math.tan(math.radians(4.0))

    def _assisted(self, t: float, now: Shown, v: np.ndarray) -> list[tuple[float, str, float]]:
        skill, seconds = self.skill, t - now.t
        course, wish = self._course(t, now, v)
        turn = 9.81 / 7.0 * skill.bank  # rad/s per travel
        course += turn * self._pending("aileron", now.t - 0.4)
        needs = [(abs(wish - course) / skill.course_band, "aileron", (wish - course) / turn)]
        x, z = now.p_world[0] + v[0] * seconds, now.p_world[2]
        if x > self.pad.x_start - 1.0:  # over the pad: forward until the wheels touch
            return [*needs, (5.0, "elevator", -FOREVER)]
        # A tap changes the height, and the assist then holds it.
        z += skill.climb * self._pending("elevator", now.t - 0.4)
        error = self._wish_height(x + v[0] * 0.6) - z
        error = min(error, max(skill.over_threshold - z, 0.0))  # it does not climb to descend
        return [*needs, (abs(error) / skill.height_band, "elevator", error / skill.climb)]

    def _plain(self, t: float, now: Shown, v: np.ndarray) -> list[tuple[float, str, float]]:
        skill, seconds = self.skill, t - now.t
        course, wish = self._course(t, now, v)
        course += 9.81 / 7.0 * now.roll * skill.turn_ahead_s
        bank = (wish - course) * 7.0 / 9.81 / skill.turn_s
        bank = max(min(bank, skill.largest_bank), -skill.largest_bank)
        roll = now.roll + skill.roll * self._pending("aileron", now.t - 0.1)
        need = skill.roll_first * abs(bank - roll) / skill.roll_band
        needs = [(need, "aileron", (bank - roll) / skill.roll)]
        x, z = now.p_world[0] + v[0] * seconds, now.p_world[2] + v[2] * seconds
        climb = math.atan2(v[2], v[0]) + skill.slope * self._pending("elevator", now.t - 0.15)
        throttle = now.throttle + THROTTLE_RATE * self._seconds("throttle", now.t)
        if x > self.pad.x_start - skill.idle_before:  # idle, and down more slowly the lower it is
            wish_throttle, height = 0.0, z - self.pad.height - 0.1
            slope = -0.03 - skill.flare * max(height, 0.0)
        else:
            high = z - self._wish_height(x + 3.0)
            wish_throttle, slope = (0.1 if high > 0.3 else 0.2), -high / (7.0 * skill.descend_s)
        needs.append((abs(wish_throttle - throttle) / 0.06, "throttle", wish_throttle - throttle))
        error = max(min(slope, 0.12), -0.12) - climb
        needs.append((abs(error) / skill.slope_band, "elevator", error / skill.slope))
        return needs


def land_by_keys(
    seed: int, assist: bool, task: LandingTask | None = None, skill: Skill | None = None
) -> dict:
    """The record of the task's own evaluator of one landing by keys, with its key changes.

    Args:
        seed: of the trial.
        assist: whether the beginner's assist is on.
        task: None for the kit's; its start may be a longer final.
        skill: of the pilot.
    """
    task = task or LandingTask()
    trial = task.trial(seed)
    world, judge = trial.world, task.judge(trial, fpv_camera())
    hands = ManualPilot(task.model, task.airframe, task.pad, assist=assist)
    person = KeyboardPilot(task.pad, assist, skill)
    # Taken over from an autopilot: its throttle, or half way where the assist holds the speed.
    sticks = {"throttle": 0.5 if assist else 0.21, "aileron": 0.0, "elevator": 0.0, "rudder": 0.0}
    past, reason, keys_at = np.zeros((30, 4)), "", 0.0
    for k in range(round(trial.duration / CONTROL_PERIOD_S)):
        t = k * CONTROL_PERIOD_S
        world.advance(t)
        state: State = world.measured()
        person.look(Shown(t, state.p_world, state.roll, sticks["throttle"]))
        while keys_at <= t + 1e-9:
            sticks = key_step(sticks, person.keys(keys_at), KEY_PERIOD_S)
            hands.sticks.put(Sticks(**sticks, hold=True, stamp=keys_at))
            keys_at += KEY_PERIOD_S
        command = hands.act(Observation(t, None, past, state))
        reason = judge.watch(LoopStep(t, None, state, command, hands.mode, None))
        if reason:
            break
        world.send(t, command)
        past = np.vstack([past[1:], command.vector])
    else:
        world.advance(trial.duration)
    changes = sum(1 + (tap.up < t) for tap in person.taps)
    return judge.result() | {"reason": reason, "seconds": t, "key_changes": changes}
