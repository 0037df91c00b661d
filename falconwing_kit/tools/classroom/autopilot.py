"""Autopilot of a class: wherever the aircraft is -> commands that lap the hall, then land.

The circuit is an oval of the hall's width, flown to the right, or mirrored to the left; its last
turn is tighter and ends on a line that cuts the pad's centre line. A vector field leads onto it
from anywhere, so an aircraft that a student hands back in some attitude is caught where the hall
leaves room. Near the pad's centre line the task's own expert lands.
"""

import math
from collections.abc import Callable

import numpy as np

from falconwing_kit.aircraft.airframe import Airframe
from falconwing_kit.aircraft.model import Model
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.control.expert import NO_STATE, EstimatingAutopilot, landing_path
from falconwing_kit.control.guidance import ReferencePath
from falconwing_kit.control.loops import LINK_DELAY_S, Reference
from falconwing_kit.core.checks import Array
from falconwing_kit.core.frames import GRAVITY, wrap_angle
from falconwing_kit.core.messages import Command, Observation, State
from falconwing_kit.flight.loop import Pilot
from falconwing_kit.tools.classroom.envelope import room_ahead, turn_margins

LAPS, JOINS = "laps", "joins the circuit"
# Of the circuit, in metres from the pad's centre line and threshold of the kit's hall.
RADIUS, WEST, EAST = 8.4, -13.0, 7.8  # of the turns, and where they begin [m]
LAST_RADIUS, LAST_WEST, LAST_COURSE = 7.2, -13.8, math.radians(32.0)  # of the last turn
LAST_LENGTH = 9.0  # of the line after it [m]
SPACING, HEIGHT = 1.5, 2.2  # of the points, and of the laps above the floor [m]
ABOVE_GLIDE = 0.25  # of the last turn's end above the expert's glide [m]
DESCENT = math.radians(5.0)  # into the last turn, at most

# The course asked for is that of a turn of FIELD_RADIUS which ends on the path, FIELD at most; the
# banks below turn tighter, at 7 m/s with a radius of 5 m [course field after Beard & McLain, Small
# Unmanned Aircraft, sec. 10.1].
FIELD, GENTLE, FIELD_RADIUS = math.radians(65.0), math.radians(40.0), 7.5  # [rad, rad, m]
ON_PATH, ON_COURSE = 0.9, math.radians(25.0)  # within these the path itself is the reference
TURN_BANK, FULL_BANK_AT = math.radians(45.0), math.radians(40.0)  # bank, at this course error
LEAD_S = 0.4  # from a bank asked for to the bank flown [s]
# Where even the better turn away comes this near to a wall it is begun at once, and flown until
# there is so much room straight ahead.
LITTLE_MARGIN, ROOM_AGAIN, AWAY_BANK = 1.6, 12.0, math.radians(52.0)  # [m, m, rad]
CLIMB_STEP = 0.4  # height error that a turn onto the path acts on, at most [m]
TURN_COST = 9.0  # metres that a radian of turn onto the path counts as

# Where the landing expert takes over: tried on a grid of places, offsets and courses.
LANDS_FROM, LANDS_UNTIL = -17.0, -5.5  # before the marker [m]
MAX_OFFSET, MAX_COURSE, TURN_LEAD, SPARE = 3.0, math.radians(42.0), 3.0, 0.6  # [m, rad, m, m]
BELOW_GLIDE, OVER_GLIDE = 0.45, 0.9  # [m]


def circuit(pad: LandingPad, glide: ReferencePath, side: int, laps: int) -> tuple[Array, float]:
    """Waypoints (n, 3) [m] of the laps and the way onto the line; arc length of the laps [m].

    Args:
        pad: on whose centre line it ends.
        glide: the landing expert's path, whose height is met.
        side: 1 to fly it to the right, -1 for its mirror image.
        laps: whole ovals before the last half one.
    """
    arc = math.pi * RADIUS
    straight = EAST - WEST
    # Pieces of constant curvature: length and curvature, from over the line in the west, eastward.
    oval = [(straight, 0.0), (arc, 1.0 / RADIUS), (straight, 0.0), (arc, 1.0 / RADIUS)]
    last = [(straight, 0.0), (arc, 1.0 / RADIUS), (EAST - LAST_WEST, 0.0)]
    last += [((math.pi + LAST_COURSE) * LAST_RADIUS, 1.0 / LAST_RADIUS), (LAST_LENGTH, 0.0)]
    course, point, points = 0.0, np.array([WEST, RADIUS]), [np.array([WEST, RADIUS])]
    for length, curvature in oval * laps + last:
        count = max(math.ceil(length / SPACING), 1)
        for _ in range(count):
            middle = course + 0.5 * curvature * length / count
            point = point + length / count * np.array([math.cos(middle), -math.sin(middle)])
            course += curvature * length / count
            points.append(point)
    flown = np.array(points)
    steps = np.linalg.norm(np.diff(flown, axis=0), axis=1)
    to_go = np.concatenate([np.cumsum(steps[::-1])[::-1], [0.0]])
    end = float(np.interp(flown[-1, 0], glide.p_world[:, 0], glide.p_world[:, 2])) + ABOVE_GLIDE
    z = np.minimum(HEIGHT, end + math.tan(DESCENT) * to_go)
    y = pad.y_centre + side * flown[:, 1]
    return np.column_stack([flown[:, 0], y, z]), laps * 2.0 * (arc + straight)


class LapsAndLanding:
    """Laps of the hall, then a landing; begun in flight it joins the last lap where it is."""

    def __init__(
        self, model: Model, airframe: Airframe, pad: LandingPad, expert: Callable[[], Pilot],
        speed: float, laps: int = 1, delay: float = LINK_DELAY_S,
    ) -> None:  # fmt: skip
        """Design the loops.

        Args:
            model: that the autopilot is designed on.
            airframe: wheels of the aircraft.
            pad: where it lands.
            expert: makes the task's own expert for the landing.
            speed: airspeed [m/s].
            laps: whole ovals at first; after `recover` none.
            delay: from a command to its arrival at the aircraft [s].

        Raises:
            InputError: the model cannot be trimmed or stabilised.
        """
        self.mode, self._speed, self._pad = JOINS, speed, pad
        self._glide = landing_path(airframe, pad, speed)[0]
        self._expert = expert
        self._lander: Pilot | None = None
        self._make = lambda: EstimatingAutopilot(model, speed, delay)
        self._autopilot = self._make()
        self._laps = laps
        self._field = GENTLE if laps else FIELD
        self._away = 0.0  # side of a turn away from a wall: 1 right, -1 left, 0 none
        self._path: ReferencePath | None = None
        self._s = 0.0

    def recover(self) -> None:
        """Begin anew from wherever the aircraft is."""
        self._lander, self._path, self._laps, self._field = None, None, 0, FIELD
        self._autopilot = self._make()

    def act(self, observation: Observation) -> Command:
        """The command towards the circuit, along it, or of the landing."""
        if self._lander is not None:
            command = self._lander.act(observation)
            self.mode = str(getattr(self._lander, "mode", ""))
            return command
        state = self._autopilot.estimate(observation)
        if state is None:
            self.mode = NO_STATE
            return self._autopilot.level()
        if self._may_land(state):
            self._lander = self._expert()
            return self.act(observation)
        path = self._choose_path(state)
        self._s = path.nearest(state.p_world, self._s)
        if self._s > path.length - 0.5:  # missed: once more around
            self._path, self._laps = None, 0
            path = self._choose_path(state)
        return self._autopilot.track(state, self._reference(path, state), observation)

    def _choose_path(self, state: State) -> ReferencePath:
        """The circuit of the side that is joined with the least way and turn."""
        if self._path is not None:
            return self._path
        best = math.inf
        for side in (1, -1):
            points, lapped = circuit(self._pad, self._glide, side, self._laps)
            path = ReferencePath(points)
            until = path.length - LAST_LENGTH if self._laps == 0 else lapped
            distance = np.linalg.norm(path.p_world - state.p_world, axis=1)
            turn = np.abs(wrap_angle(path.yaw - course_of(state)))
            cost = np.where(path.s < until, distance + TURN_COST * turn, math.inf)
            place = int(np.argmin(cost))
            if cost[place] < best:
                best, self._path, self._s = float(cost[place]), path, float(path.s[place])
        assert self._path is not None
        return self._path

    def _reference(self, path: ReferencePath, state: State) -> Reference:
        """The path where the aircraft is on it, else a turn towards it at a bounded bank."""
        on_path = path.at(self._s, self._speed)
        left = np.array([math.sin(on_path.yaw), math.cos(on_path.yaw), 0.0])
        offset = float((state.p_world - on_path.p_world) @ left)
        if abs(offset) < ON_PATH and abs(wrap_angle(on_path.yaw - course_of(state))) < ON_COURSE:
            self.mode = LAPS
            return on_path
        # The bank follows late, so the turn is chosen for where the aircraft will be by then.
        turn_rate = GRAVITY * math.tan(min(max(state.roll, -1.0), 1.0)) / self._speed
        course = course_of(state) + LEAD_S * turn_rate
        middle = 0.5 * (course + course_of(state)) - on_path.yaw
        ahead = offset - LEAD_S * self._speed * math.sin(middle)
        asked = on_path.yaw + math.copysign(_entry_angle(abs(ahead), self._field), ahead)
        error = float(wrap_angle(asked - course))
        self.mode = JOINS
        if away := self._turn_away(state):
            return self._level_turn(state, away * AWAY_BANK, on_path.p_world[2])
        bank = on_path.bank * max(1.0 - abs(offset) / 3.0, 0.0)
        bank += TURN_BANK * error / FULL_BANK_AT
        bank = min(max(bank, -TURN_BANK), TURN_BANK)
        return self._level_turn(state, bank, on_path.p_world[2])

    def _level_turn(self, state: State, bank: float, height: float) -> Reference:
        """A turn from here at a bank [rad], towards a height [m]."""
        low, high = state.p_world[2] - CLIMB_STEP, state.p_world[2] + CLIMB_STEP
        place = np.array([*state.p_world[:2], min(max(height, low), high)])
        # The course flown is the reference's: only the bank turns the aircraft.
        return Reference(place, course_of(state), 0.0, self._speed, bank)

    def _turn_away(self, state: State) -> float:
        """Side of a turn away from a wall ahead, kept until there is room; 0 where there is."""
        room = room_ahead(state)
        if self._away and room > ROOM_AGAIN:
            self._away = 0.0
        right, left = turn_margins(state)
        if not self._away and max(right, left) < LITTLE_MARGIN and room < ROOM_AGAIN:
            self._away = 1.0 if right > left else -1.0
            self._path = None  # another place to join may be nearer after the turn
        return self._away

    def _may_land(self, state: State) -> bool:
        """Whether the landing expert lands from here: measured on a grid of such states."""
        x, y, z = state.p_world
        side = 1.0 if y >= self._pad.y_centre else -1.0
        offset, course = abs(y - self._pad.y_centre), side * course_of(state)
        above = z - float(np.interp(x, self._glide.p_world[:, 0], self._glide.p_world[:, 2]))
        return bool(
            self._laps_done
            and LANDS_FROM <= x <= LANDS_UNTIL
            and offset <= MAX_OFFSET
            and course + 0.05 * (MAX_OFFSET - offset) >= -0.1
            and course <= MAX_COURSE
            and TURN_LEAD * math.sin(course) <= offset + SPARE
            and -BELOW_GLIDE <= above <= OVER_GLIDE
            and abs(state.roll) < math.radians(50.0)
        )

    @property
    def _laps_done(self) -> bool:
        return self._laps == 0 or (
            self._path is not None and self._s > self._path.length - 3.0 * LAST_LENGTH
        )


def _entry_angle(distance: float, most: float) -> float:
    """Angle to the path [rad] at which a turn of FIELD_RADIUS ends on it, from a distance [m]."""
    return min(math.acos(max(1.0 - distance / FIELD_RADIUS, 0.0)), most)


def course_of(state: State) -> float:
    """Course over the floor, positive to the right [rad]."""
    return math.atan2(-float(state.v_world[1]), float(state.v_world[0]))
