"""Worlds of an evaluation: name and trial's seed -> aircraft, air, camera, link, leader and start.

One world differs from the nominal one in one thing, but for `spread`, `reality` and the combined
ones. Every draw depends on the trial's seed alone and not on its size, so that the levels of a
sweep, and all pilots, fly pairs.
"""

import importlib.util
import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from falconwing_kit.aircraft.airframe import Airframe
from falconwing_kit.aircraft.model import Model
from falconwing_kit.aircraft.terms import Parameter, WindTerm
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.aircraft.trim import trim
from falconwing_kit.control.expert import landing_speed
from falconwing_kit.control.guidance import Hall
from falconwing_kit.control.leader import LeaderPath
from falconwing_kit.control.loops import LINK_DELAY_S, SPEED
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.messages import State
from falconwing_kit.flight.judges import FlightEvaluator
from falconwing_kit.flight.loop import Pilot
from falconwing_kit.flight.sources import RenderedView
from falconwing_kit.flight.tasks import FollowTask, LandingTask
from falconwing_kit.flight.tasks.follow import BEHIND
from falconwing_kit.flight.trial import Spread, TrialSetup
from falconwing_kit.flight.world import FlyingAircraft, SimulatedWorld
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.tools.trials.jsbsim_aircraft import STEP, JsbsimAircraft, JsbsimFlight, set_wind

UNSEEN = ("left_turn_s_descent", "right_turn_s_ascent", "right_turn_sharp_climb")  # the paper's
TRAINING = "random_waypoints"
TASKS = ("landing", "follow")
GUST_SHARE, GUST_HZ = 0.3, (0.2, 1.0)  # of the wind's speed; lowest and highest frequency
KEPT = ("delay", "lag")  # values that a spread of coefficients leaves as they are
TRIES = 20  # draws of an aircraft before giving up
WIDE_DURATION_S = 30.0  # of flights that may go around
# Keys of random generators, with the trial's seed
AIRCRAFT, AIR, MOUNT, DELAY, START = range(11, 16)
AWAY_FROM_WALL = 1.0  # of a start, behind it [m]; the hall ends 23.5 m before the pad


@dataclass(frozen=True)
class World:
    """What differs from the nominal world, in which nothing does."""

    name: str
    group: str  # the sweep or table that it belongs to
    level: float | None = None  # its place on the sweep's axis
    tasks: tuple[str, ...] = TASKS
    starts: str = "paper"  # "paper", "curved" or "wide"
    manoeuvre: str = ""  # of the leader; empty for the three unseen ones in turn
    # aircraft and air
    is_jsbsim: bool = False  # flown by JSBSim in place of the kit's model
    coefficients: float = 0.0  # half width of the coefficients' factors, or sd for JSBSim
    delay_s: tuple[float, float] = (LINK_DELAY_S, LINK_DELAY_S)  # of commands, drawn between [s]
    wind_speed: tuple[float, float] = (0.0, 0.0)  # of any direction, drawn between [m/s]
    # camera and link
    is_analog: bool = False  # seen through the analog link that was measured on the hall's photos
    snr_db: float | None = None  # of that link, in place of the measured one
    exposure_ev: tuple[float, float] = (0.0, 0.0)  # drawn between
    mount_deg: float = 0.0  # angle by which the camera is turned about any axis
    late: int = 0  # frames
    lost: float = 0.0  # share of frames
    black_s: float = 0.0  # without a picture, once [s]
    covered: float = 0.0  # share of the image, from the left
    occluded: float = 0.0  # share of the image under six dark discs on the lens
    is_grey: bool = False  # the image shows nothing
    # the leader's look
    leader_scale: float = 1.0
    leader_salt_pepper: float = 0.0  # share of its Gaussians
    leader_gain: tuple[float, float, float] = (1.0, 1.0, 1.0)  # factors of its red, green, blue


def _sweep(group: str, field: str, levels: tuple[float, ...], **more: Any) -> tuple[World, ...]:
    """A world a level, with one field set to it; both ends of it where it is a range."""
    is_range = isinstance(getattr(World("", ""), field), tuple)
    values: Any = [{field: (level, level) if is_range else level} | more for level in levels]
    return tuple(
        World(f"{group} {level:g}", group, level, **value)
        for level, value in zip(levels, values, strict=True)
    )


_LANDING: Any = {"tasks": ("landing",)}
_FOLLOW: Any = {"tasks": ("follow",)}
_COLOURS = {  # factors of light
    "red": (2.0, 0.3, 0.3), "green": (0.3, 2.0, 0.3), "blue": (0.3, 0.3, 2.0),
    "dark": (0.25, 0.25, 0.25), "bright": (2.5, 2.5, 2.5),
}  # fmt: skip
_WORLDS = (
    World("paper", "landing", **_LANDING),
    World("curved", "landing", starts="curved", **_LANDING),
    World("wide", "landing", starts="wide", **_LANDING),
    World("training", "manoeuvres", manoeuvre=TRAINING, **_FOLLOW),
    *(World(name, "manoeuvres", manoeuvre=name, **_FOLLOW) for name in UNSEEN),
    World("spread", "spread", coefficients=0.2, delay_s=(0.0, 0.15), wind_speed=(0.0, 0.8)),
    World(
        "reality", "reality", is_jsbsim=True, coefficients=0.15, delay_s=(0.05, 0.08),
        wind_speed=(0.0, 0.4), is_analog=True, exposure_ev=(-0.5, 0.5), mount_deg=0.5,
    ),
    *_sweep("scale", "leader_scale", (0.5, 0.7, 1.0, 1.4, 2.0), **_FOLLOW),
    *_sweep("salt and pepper", "leader_salt_pepper", (0.0, 0.1, 0.2, 0.3), **_FOLLOW),
    *(World(f"leader {c}", "colour", leader_gain=g, **_FOLLOW) for c, g in _COLOURS.items()),
    *_sweep("exposure", "exposure_ev", (-1.0, -0.5, 0.0, 0.5, 1.0)),
    *_sweep("snr", "snr_db", (40.0, 34.0, 30.0, 26.0, 22.0), is_analog=True),
    *(
        World(f"delay {ms}", "delay", float(ms), delay_s=(1e-3 * ms,) * 2)
        for ms in (0, 50, 100, 150, 200)
    ),
    *(World(f"late {frames}", "late", frames, late=frames) for frames in (0, 1, 2)),
    *_sweep("lost", "lost", (0.0, 0.1, 0.2, 0.3, 0.4)),
    *_sweep("wind speed", "wind_speed", (0.0, 0.4, 0.8, 1.2)),
    *_sweep("coefficients", "coefficients", (0.0, 0.1, 0.2, 0.25)),
    *_sweep("mount", "mount_deg", (0.0, 0.5, 1.0, 2.0, 3.0)),
    *_sweep("occluders", "occluded", (0.0, 0.1, 0.2, 0.3)),
    World("black 0.5 s", "image lost", black_s=0.5),
    World("half covered", "image lost", covered=0.5),
    World("grey image", "image lost", is_grey=True),
    World("-1 EV, 26 dB", "combined", exposure_ev=(-1.0, -1.0), snr_db=26.0, is_analog=True),
    World("+1 EV, 26 dB", "combined", exposure_ev=(1.0, 1.0), snr_db=26.0, is_analog=True),
)  # fmt: skip
WORLDS = {world.name: world for world in _WORLDS}
GROUPS = tuple(dict.fromkeys(world.group for world in _WORLDS))
TABLES = ("landing", "manoeuvres", "spread", "reality")  # the groups of the paper's tables
AXES = {  # of the groups that are sweeps: what is varied, with its unit
    "scale": "leader's size [of the nominal one]",
    "salt and pepper": "leader's Gaussians turned white or black [%]",
    "exposure": "exposure [EV]",
    "snr": "analog link's signal to noise [dB]",
    "delay": "delay of commands [ms]",
    "late": "image late by [frames of 50 ms]",
    "lost": "frames lost [%]",
    "wind speed": "wind with gusts [m/s]",
    "coefficients": "coefficients spread by [+-%]",
    "mount": "camera turned by [deg]",
    "occluders": "image under dark discs [%]",
}
PER_CENT = ("salt and pepper", "lost", "coefficients", "occluders")  # shares, drawn times 100


def select_worlds(text: str, task: str) -> tuple[World, ...]:
    """The worlds of a task that a text names.

    Args:
        text: names of worlds or groups, "tables", "sweeps" or "all", separated by commas; the names
            of worlds may have commas of their own.
        task: of TASKS.

    Raises:
        InputError: there is no such world, or none of this task, or it needs JSBSim.
    """
    chosen: dict[str, World] = {}
    rest = text
    while rest := rest.strip(" ,"):
        names = [name for name in (*WORLDS, *GROUPS, "tables", "sweeps", "all")
                 if rest == name or rest.startswith((f"{name},", f"{name} ,"))]  # fmt: skip
        if not names:
            raise InputError(
                f"--worlds: expected tables, sweeps, all, a group ({', '.join(GROUPS)}) or a world"
                f" such as {', '.join(list(WORLDS)[:3])}, got {rest!r}"
            )
        name = max(names, key=len)
        rest = rest[len(name) :]
        fitting = {
            "all": _WORLDS,
            "tables": tuple(world for world in _WORLDS if world.group in TABLES),
            "sweeps": tuple(world for world in _WORLDS if world.group not in TABLES),
        }.get(name) or tuple(world for world in _WORLDS if name in (world.name, world.group))
        chosen |= {world.name: world for world in fitting if task in world.tasks}
        needed = [world.name for world in fitting if world.is_jsbsim and task in world.tasks]
        if needed and not has_jsbsim():
            if name in needed:
                raise InputError(
                    f"--worlds {name}: expected JSBSim, which flies its aircraft, got none"
                    " installed; run: pip install jsbsim"
                )
            chosen = {key: world for key, world in chosen.items() if key not in needed}
    if not chosen:
        raise InputError(f"--worlds {text}: expected worlds of the task {task}, got none")
    return tuple(chosen.values())


def has_jsbsim() -> bool:
    """Whether JSBSim is installed."""
    return importlib.util.find_spec("jsbsim") is not None


@dataclass(frozen=True)
class WorldTask:
    """A task of the kit in another world, with its evaluator; the pilots' model stays nominal."""

    base: LandingTask | FollowTask
    world: World

    @property
    def name(self) -> str:
        """Task and world."""
        return f"{self.base.name} in {self.world.name}"

    @property
    def airframe(self) -> Airframe:
        """Of the aircraft that flies."""
        return self.base.airframe

    @property
    def model(self) -> Model:
        """That pilots are designed on."""
        return self.base.model

    @property
    def pad(self) -> LandingPad | None:
        """Where to land; None for following."""
        return self.base.pad if isinstance(self.base, LandingTask) else None

    @property
    def start(self) -> State | None:
        """Where every trial starts; None where starts are drawn."""
        return self.base.start

    def leader(self, seed: int) -> LeaderPath | None:
        """The leader of a seed."""
        return self.base.leader(seed)

    def trial(self, seed: int) -> TrialSetup:
        """The world of a seed; the same for every pilot.

        Raises:
            InputError: no drawn aircraft flies.
        """
        world, leader = self.world, self.base.leader(seed)
        delay = float(np.random.default_rng([seed, DELAY]).uniform(*world.delay_s))
        flies, steady = _draw_aircraft(world, self.base.model, seed)
        start = self.base.start or self._start(steady, leader, seed)
        aircraft: Model | FlyingAircraft
        if isinstance(flies, JsbsimAircraft):
            aircraft = JsbsimFlight(flies, start.vector, delay, _blow(world, seed))
        else:
            aircraft = flies
        flight = SimulatedWorld(
            aircraft, self.airframe, start, seed=seed, pad=self.pad, leader=leader, delay=delay
        )
        wide = WIDE_DURATION_S if world.starts == "wide" else 0.0
        duration = leader.duration if leader else max(self._landing.duration, wide)
        return TrialSetup(seed, flight, leader, duration)

    def judge(
        self, trial: TrialSetup, camera: PinholeCamera, view: RenderedView | None = None
    ) -> FlightEvaluator:
        """The task's own evaluator."""
        return self.base.judge(trial, camera, view)

    def expert(self, trial: TrialSetup, model: Model | None = None) -> Pilot:
        """The task's own expert."""
        return self.base.expert(trial, model)

    @property
    def _landing(self) -> LandingTask:
        if not isinstance(self.base, LandingTask):
            raise InputError(f"task: expected a landing, got {self.base.name}")
        return self.base

    def _start(self, steady: State, leader: LeaderPath | None, seed: int) -> State:
        """The start of a seed, near a trimmed flight of the aircraft that flies."""
        if leader is not None:
            first = leader.state_at(0.0)
            forward = first.v_world / np.linalg.norm(first.v_world)
            yaw = math.atan2(-forward[1], forward[0])
            behind = first.p_world - BEHIND * forward
            return self.base.spread.start_near(steady, behind, seed, yaw)
        task, rng = self._landing, np.random.default_rng([seed, START])
        if self.world.starts == "paper":
            return task.spread.start_near(
                steady, task.nominal, seed, speed=landing_speed(self.model)
            )
        pad, side = task.pad, rng.choice((-1.0, 1.0))
        farthest = pad.x_start - Hall().x[0] - AWAY_FROM_WALL
        if self.world.starts == "curved":
            out, aside, height = rng.uniform((16.0, 2.0, 1.0), (20.0, 4.0, 2.0))
            aside *= side
            yaw = side * math.radians(rng.uniform(10.0, 30.0))  # nose towards the centre line
        else:
            out, aside, height = rng.uniform((12.0, -3.0, 0.7), (farthest, 3.0, 3.0))
            yaw = math.radians(rng.uniform(-30.0, 30.0))
        p_world = np.array([pad.x_start - out, pad.y_centre + aside, height])
        near = Spread(0.0, math.radians(5.0), 1.0)
        return near.start_near(steady, p_world, seed, yaw, landing_speed(self.model))


def mount_rotation(world: World, seed: int) -> Array:
    """R_body_mount (3, 3) of a camera turned by the world's angle about a drawn axis."""
    from scipy.spatial.transform import Rotation

    axis = np.random.default_rng([seed, MOUNT]).normal(size=3)
    axis *= math.radians(world.mount_deg) / np.linalg.norm(axis)
    return np.asarray(Rotation.from_rotvec(axis).as_matrix())


def _draw_aircraft(world: World, nominal: Model, seed: int) -> tuple[Model | JsbsimAircraft, State]:
    """An aircraft in its wind, and its trimmed flight in still air."""
    speed = landing_speed(nominal) if nominal.form == "rates" else SPEED
    for attempt in range(TRIES):
        rng = np.random.default_rng([seed, AIRCRAFT, attempt])
        flies: Model | JsbsimAircraft
        if world.is_jsbsim:
            flies = replace(JsbsimAircraft(), delay=0.0).redrawn(rng, world.coefficients)
            still = flies.kit_model()
        else:
            still = _spread(nominal, rng, world.coefficients)
            flies = still.with_terms(GUSTY_WIND).with_values(_wind(world, seed))
            flies = flies if world.wind_speed[1] else still
        try:
            return flies, State.from_vector(trim(still, speed).state)
        except InputError:
            continue
    raise InputError(f"aircraft: expected one that flies at seed {seed}, got none in {TRIES} draws")


def _spread(nominal: Model, rng: np.random.Generator, half_width: float) -> Model:
    """The aircraft with each coefficient times 1 +- half_width, uniformly."""
    factors = {name: 1.0 + half_width * rng.uniform(-1.0, 1.0) for name in nominal.values}
    return nominal.with_values({
        name: value * factors[name] for name, value in nominal.values.items() if name not in KEPT
    })  # fmt: skip


def _wind(world: World, seed: int) -> dict[str, float]:
    """Speed and direction of the wind, and of its gust amplitude, frequency and phase."""
    rng = np.random.default_rng([seed, AIR])
    speed, direction = rng.uniform(*world.wind_speed), rng.uniform(0.0, 2.0 * math.pi)
    return {
        "air_x": speed * math.cos(direction),
        "air_y": speed * math.sin(direction),
        "air_gust": GUST_SHARE,
        "air_omega": 2.0 * math.pi * rng.uniform(*GUST_HZ),
        "air_phase": rng.uniform(0.0, 2.0 * math.pi),
    }


def gusty_wind(px, py, height, time, K):  # type: ignore[no-untyped-def]
    """A level wind whose speed goes up and down: W (1 + g sin(omega t + phase))."""
    share = 1.0 + K.air_gust * np.sin(K.air_omega * time + K.air_phase)
    return K.air_x * share, K.air_y * share, 0.0 * share


GUSTY_WIND = WindTerm(
    "air with a gust",
    (
        Parameter("air_x", 0.0, -10.0, 10.0, "m/s", "velocity of the air along world x"),
        Parameter("air_y", 0.0, -10.0, 10.0, "m/s", "velocity of the air along world y"),
        Parameter("air_gust", 0.0, 0.0, 1.0, "-", "amplitude of the gust, in shares"),
        Parameter("air_omega", 1.0, 0.0, 100.0, "rad/s", "of the gust"),
        Parameter("air_phase", 0.0, 0.0, 7.0, "rad", "of the gust"),
    ),
    gusty_wind,
)


def _blow(world: World, seed: int) -> Any:
    """What sets the same wind in JSBSim before each step, with turbulence of its own.

    The turbulence is white noise behind a first-order lag of a second, of the gust's rms.
    """
    values = _wind(world, seed)
    rng, turbulence = np.random.default_rng([seed, AIR, 1]), np.zeros(3)
    sigma = GUST_SHARE * math.hypot(values["air_x"], values["air_y"]) / math.sqrt(2.0)
    mean = np.array([values["air_x"], values["air_y"], 0.0])
    return partial(_blow_turbulent, mean, sigma, rng, turbulence)


def _blow_turbulent(
    mean: Array, sigma: float, rng: np.random.Generator, turbulence: Array, t: float, fdm: Any
) -> None:
    decay = math.exp(-STEP)
    turbulence *= decay
    turbulence += sigma * math.sqrt(1.0 - decay**2) * rng.normal(size=3)
    set_wind(fdm, mean + turbulence)
