"""Situations: a seed and ranges -> one flight of a training: aircraft, air, link, camera, start.

Every flight of a training is another aircraft in other air, so that a policy learns to fly what it
meets rather than one aircraft [domain randomisation, Tobin et al. 2017]. `NOMINAL` is the kit's own
aircraft, for comparison.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from falconwing_kit.aircraft.model import Model, rates_model
from falconwing_kit.aircraft.terms import Parameter, WindTerm
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.control.guidance import Hall
from falconwing_kit.control.leader import LeaderPath, leader_path
from falconwing_kit.control.loops import LINK_DELAY_S
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.frames import R_BODY_CAMERA, pose_matrix, rotation_world_body
from falconwing_kit.core.messages import CONTROL_PERIOD_S, State
from falconwing_kit.flight.tasks.follow import BEHIND
from falconwing_kit.flight.tasks.follow import SPREAD as FOLLOW_SPREAD
from falconwing_kit.flight.tasks.landing import DISTANCE, HEIGHT
from falconwing_kit.flight.tasks.landing import SPREAD as LANDING_SPREAD
from falconwing_kit.flight.trial import Spread

SHARED, LED = 4, 8  # flights with one aircraft in one wind, and behind one leader
TRIES = 20  # draws of an aircraft or a leader before giving up
GUST_HZ = (0.15, 0.4, 0.9)  # of the three waves of a gust
TRIMMED = {"L_0": "L_da", "M_0": "M_de", "N_0": "N_dr"}  # a trim bias is a moment
KEPT = ("delay", "lag", *TRIMMED)  # values that are not multiplied
MOMENTS = {  # about each axis: the values that are divided by its inertia, but for the trim
    "roll": ("L_da", "L_beta", "L_p", "L_r"),
    "pitch": ("M_0", "M_de", "M_alpha", "M_q"),
    "yaw": ("N_dr", "N_beta", "N_r", "N_p"),
}
LEADERS = "random_waypoints"  # the only manoeuvre of training; the others stay unseen


@dataclass(frozen=True)
class Ranges:
    """Half widths of uniform distributions, unless a text says otherwise."""

    coefficients: float = 0.25  # of each of the model's values, as a share
    # Logarithms of factors: of all moments about one axis (low, high), since small aircraft differ
    # most in inertia and control surfaces, and of each derivative of a moment (half width).
    moments: tuple[float, float] = (-0.35, 1.25)
    derivatives: float = 0.5
    trim: float = 0.08  # moments, in shares of full control
    delay: tuple[float, float] = (0.0, 0.17)  # of the link, low and high [s]
    long_delay: tuple[float, float] = (0.15, 0.23)  # the same, of one flight in five
    mean_wind: float = 1.2  # most wind [m/s]; it is uniform in 0 to this, of any direction
    gusts: float = 0.4  # most amplitude [m/s], likewise
    mount: tuple[float, float, float] = (0.25, 0.08, 0.12)  # camera in body axes: 0 to x, +-y, +-z
    mount_angle: float = math.radians(3.0)  # about each of its axes [rad]
    wide_starts: float = 0.4  # share of flights that start far from the usual place
    late: int = 3  # most frames that an image is late
    lost: float = 0.4  # most share of images that are lost
    black_s: float = 0.55  # longest time without a picture [s], in one flight of four
    graded: bool = False  # whether half of the aircraft differ less, by a share drawn for each

    def eased(self, share: float) -> "Ranges":
        """The same with an aircraft, a wind and a camera angle that differ by a share of these.

        The link's delay keeps its range: a slow link is as likely with a well-known aircraft.
        """
        return replace(
            self, coefficients=share * self.coefficients, trim=share * self.trim,
            moments=(share * self.moments[0], share * self.moments[1]),
            derivatives=share * self.derivatives, mean_wind=share * self.mean_wind,
            gusts=share * self.gusts, mount_angle=share * self.mount_angle,
        )  # fmt: skip


SPREAD_RANGES = Ranges(graded=True)
# behind a leader an aircraft is steered harder, and loses it where it is flown late
FOLLOW_RANGES = replace(
    SPREAD_RANGES, coefficients=0.15, moments=(0.0, 0.0), derivatives=0.0, trim=0.04,
    delay=(0.0, 0.12), long_delay=(0.12, 0.17), mean_wind=0.6, gusts=0.2, black_s=0.3,
)  # fmt: skip
NOMINAL = Ranges(0.0, (0.0, 0.0), 0.0, 0.0, (LINK_DELAY_S,) * 2, (LINK_DELAY_S,) * 2, 0.0, 0.0,
                 (0.0,) * 3, 0.0, 0.0, 0, 0.0, 0.0)  # fmt: skip


def training_ranges(task: str, nominal: bool) -> Ranges:
    """Of the flights of a training or a dataset: the kit's own aircraft, or many."""
    if nominal:
        return NOMINAL
    return FOLLOW_RANGES if task == "follow" else SPREAD_RANGES


@dataclass(frozen=True, eq=False)
class Situation:
    """One flight before it begins."""

    seed: int
    task: str
    model: Model  # that flies, with gusts
    known_model: Model  # what the teacher is designed on: all but the gusts
    delay: float  # from a command to its arrival at the aircraft [s]
    start: State
    p_body_camera: Array  # (3,) where the pilot believes its camera to be [m]
    T_body_camera: Array  # (4, 4) where it is
    leader: LeaderPath | None
    duration: float  # at most [s]
    newest: Array  # (n,) number of the frame that is the newest delivered at each step; -1 none
    black: Array  # (n,) whether the picture of each frame is black


def draw_situation(task: str, seed: int, ranges: Ranges, nominal_mount: Array) -> Situation:
    """The flight of a seed.

    Args:
        task: "landing" or "follow".
        seed: of all draws.
        ranges: of the randomisation; its mount is added to a camera at the centre of gravity, or
            where it is zero the camera is at the nominal place.
        nominal_mount: (3,) in body axes [m].

    Raises:
        InputError: no draw gave an aircraft that flies.
    """
    rng, shared = (np.random.default_rng(key) for key in ([seed, 18], [seed // SHARED, 17]))
    if ranges.graded:
        ranges = ranges.eased(min(2.0 * shared.uniform(), 1.0))
    known_model = _draw_model(shared, ranges)
    delay = float(shared.uniform(*(ranges.long_delay if shared.random() < 0.2 else ranges.delay)))
    gust = dict(zip(("gust_x", "gust_y", "gust_z"), rng.uniform(0, ranges.gusts, 3), strict=True))
    phases = {f"gust_phase_{k}": float(rng.uniform(0.0, 2.0 * math.pi)) for k in range(3)}
    model = known_model.with_values({**gust, **phases})
    p_body_camera = np.asarray(nominal_mount, np.float64)
    if any(ranges.mount):
        x, y, z = ranges.mount
        p_body_camera = rng.uniform((0.0, -y, -z), (x, y, z))
    turn = rotation_world_body(*rng.uniform(-1.0, 1.0, 3) * ranges.mount_angle)
    flip = np.diag((1.0, -1.0, -1.0))  # rotation_world_body at zero angles
    T_body_camera = pose_matrix(flip @ turn @ R_BODY_CAMERA, p_body_camera)
    leader = None
    if task == "follow":
        leader = draw_leader(seed // LED)
        start = _follow_start(rng, leader, known_model, ranges)
        duration = leader.duration
    else:
        start, duration = _landing_start(rng, known_model, ranges), 8.0
    start = _without_some_wind(rng, start, known_model)
    steps = round(duration / CONTROL_PERIOD_S) + 1
    newest, black = draw_delivery(rng, steps, ranges)
    return Situation(
        seed, task, model, known_model, delay, start, p_body_camera, T_body_camera, leader,
        duration, newest, black,
    )  # fmt: skip


def gusty_wind(px, py, height, time, K):  # type: ignore[no-untyped-def]
    """A level wind and three waves that pass: sum of amplitude times sin(2 pi f t + phase)."""
    a = math.sin(2.0 * math.pi * 0.15 * time + K.gust_phase_0)
    b = math.sin(2.0 * math.pi * 0.4 * time + K.gust_phase_1)
    c = math.sin(2.0 * math.pi * 0.9 * time + K.gust_phase_2)
    return (
        K.mean_wind_x + K.gust_x * (0.6 * a + 0.4 * b),
        K.mean_wind_y + K.gust_y * (0.6 * b + 0.4 * c),
        0.5 * K.gust_z * (0.5 * a + 0.5 * c),
    )


_WIND = WindTerm(
    "gusty_wind",
    tuple(
        Parameter(name, 0.0, -10.0, 10.0, "m/s", "of the wind")
        for name in ("mean_wind_x", "mean_wind_y", "gust_x", "gust_y", "gust_z")
    )
    + tuple(Parameter(f"gust_phase_{k}", 0.0, -10.0, 10.0, "rad", "of a wave") for k in range(3)),
    gusty_wind,
)


def _draw_model(rng: np.random.Generator, ranges: Ranges) -> Model:
    """The kit's aircraft with other values, in a steady wind."""
    base = rates_model()
    values = {}
    for name, value in base.values.items():
        share = 0.0 if name in KEPT else rng.uniform(-1.0, 1.0) * ranges.coefficients
        values[name] = value * (1.0 + share)
    if ranges.derivatives or any(ranges.moments):
        for names in MOMENTS.values():
            of_axis = math.exp(rng.uniform(*ranges.moments))
            for name in names:
                own = 0.0 if name in TRIMMED else rng.uniform(-1.0, 1.0) * ranges.derivatives
                values[name] *= of_axis * math.exp(own)
    for moment, control in TRIMMED.items():
        values[moment] = (
            values[moment] * (1.0 + rng.uniform(-1.0, 1.0) * 0.4 * ranges.coefficients)
            + values[control] * rng.uniform(-1.0, 1.0) * ranges.trim
        )
    if ranges.coefficients:
        values["lag"] = rng.uniform(0.02, 0.06)
    speed, direction = rng.uniform(0.0, ranges.mean_wind), rng.uniform(0.0, 2.0 * math.pi)
    values["mean_wind_x"] = speed * math.cos(direction)
    values["mean_wind_y"] = speed * math.sin(direction)
    return base.with_terms(_WIND).with_values(values)


def _landing_start(rng: np.random.Generator, model: Model, ranges: Ranges) -> State:
    """A start before the pad: near the usual one, or far from it and still landable."""
    pad, seed = LandingPad(), int(rng.integers(2**31))
    if rng.random() < ranges.wide_starts:
        farthest = min(25.0, pad.x_start - Hall().x[0] - 1.0)  # a metre before the wall
        distance, aside = rng.uniform(12.0, farthest), rng.uniform(-3.0, 3.0)
        height = rng.uniform(0.7, 1.0 + 0.1 * distance)  # higher ones end beyond the pad
        p_world = np.array([pad.x_start - distance, pad.y_centre + aside, height])
        yaw = math.radians(rng.uniform(-25.0, 25.0)) + 0.08 * aside
        return Spread(0.2, math.radians(10.0), 1.5).start(model, p_world, seed, yaw)
    p_world = np.array([pad.x_start - DISTANCE, pad.y_centre, HEIGHT])
    grown = 1.2 if ranges.wide_starts else 1.0  # training covers more than the trials
    spread = Spread(
        grown * LANDING_SPREAD.position,
        grown * LANDING_SPREAD.angle,
        grown * LANDING_SPREAD.speed,
    )
    return spread.start(model, p_world, seed)


def _without_some_wind(rng: np.random.Generator, start: State, model: Model) -> State:
    """A start that moves with a share of the air only, and so begins with sideslip.

    Where every start moves with the air, its first two images show the wind, and a policy learns to
    look at nothing else: where a start does not, it drifts downwind to the end. A quarter of the
    starts moves with all of the wind, a quarter with none of it.
    """
    wind = np.array([model.values["mean_wind_x"], model.values["mean_wind_y"], 0.0])
    return replace(start, v_world=start.v_world - np.clip(rng.uniform(-0.5, 1.5), 0.0, 1.0) * wind)


@lru_cache(maxsize=8)
def draw_leader(seed: int) -> LeaderPath:
    """A leader on random waypoints; a path that leaves the hall is drawn again."""
    rng = np.random.default_rng([seed, 20])
    for _ in range(TRIES):
        try:
            return leader_path(LEADERS, seed=int(rng.integers(2**31)))
        except InputError:
            continue
    raise InputError(f"leader: expected one that stays in the hall in {TRIES} draws, got none")


def _follow_start(
    rng: np.random.Generator, leader: LeaderPath, model: Model, ranges: Ranges
) -> State:
    """A start behind a leader."""
    first = leader.state_at(0.0)
    forward = first.v_world / np.linalg.norm(first.v_world)
    yaw = math.atan2(-forward[1], forward[0])
    distance = BEHIND + (rng.uniform(-1.2, 1.2) if ranges.wide_starts else 0.0)
    behind = first.p_world - distance * forward
    return FOLLOW_SPREAD.start(model, behind, int(rng.integers(2**31)), yaw)


def draw_delivery(rng: np.random.Generator, steps: int, ranges: Ranges) -> tuple[Array, Array]:
    """Which frame is the newest that the pilot has at each step, and which pictures are black.

    Half of the flights have every frame at once; the others have it late, or lose some.

    Returns:
        (n,) numbers of frames, -1 before the first, and (n,) booleans.
    """
    arrival, black = np.arange(steps), np.zeros(steps, bool)
    if ranges.late and rng.random() < 0.5:
        arrival = arrival + rng.integers(0, ranges.late)  # always late
        arrival = arrival + (rng.random(steps) < rng.uniform(0.0, 0.3))  # some more
    arrives = rng.random(steps) >= (rng.uniform(0.0, ranges.lost) if rng.random() < 0.5 else 0.0)
    arrives[0] = True
    newest = np.full(steps, -1)
    for frame in range(steps):
        if arrives[frame] and arrival[frame] < steps:
            newest[arrival[frame]] = max(newest[arrival[frame]], frame)
    newest = np.maximum.accumulate(newest)
    if ranges.black_s and rng.random() < 0.25:
        first = int(rng.integers(5, 70))
        black[first : first + round(rng.uniform(0.1, ranges.black_s) / CONTROL_PERIOD_S)] = True
    return newest, black


def nominal_situation_ranges(**changes: object) -> Ranges:
    """`NOMINAL` with some ranges changed, for evaluations of one influence."""
    return replace(NOMINAL, **changes)  # type: ignore[arg-type]
