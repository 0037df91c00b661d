"""Environments: a task of `fly` -> Gymnasium environments FalconWing/Landing-v0 and
FalconWing/Follow-v0, one flight or many at once.

    import gymnasium
    env = gymnasium.make("falconwing_kit.flight.environments:FalconWing/Landing-v0")

To import this file registers both; nothing else in the kit imports gymnasium. World, delay, noise,
seeds and judge are those of `fly`: `env.reset(options={"trial": 7})` is trial 7 of its frozen list.

Action (4,), each -1..1: throttle (-1 idle, 1 full), aileron, elevator, rudder, positive right wing
down, nose up, nose right. Everywhere else in the kit the throttle is 0..1.

Observation of the landing, (12 + 4 history,) float32: the measured state in the paper's order
relative to the pad, each number over its unit below, then past commands. With `images=True` it is a
dictionary of "image" (height, width, 3) uint8 from the nose, "state" and "past_commands" (history,
4). Numbers beyond +-10 units are cut, and info["clipped"] says so.

    px py pz        from the pad's threshold, centre line and top    10 m, 2 m, 1 m
    pitch yaw roll                                                    0.35 rad
    vx vy vz        in world axes                                     7, 2, 2 m/s
    p q r           body rates                                        2 rad/s
    past commands   oldest first, as sent: throttle 0..1, others -1..1, zeros before the first

Following adds the leader after the state, 9 numbers, true as the state-based expert has them: its
place ahead, left and up of the aircraft along its heading (4 m each), its pitch, yaw relative to
the own and roll (0.35 rad), its velocity minus the own along the same axes (2 m/s). The own
position is then relative to the middle of the hall's floor (10 m, 10 m, 1 m).

Reward: see rewards.py; it reads the true state. A contact terminates, the task's duration
truncates, as in `fly`; info then has "reason" and the judge's "result", whose "success" is the
verdict.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.aircraft.trim import trim
from falconwing_kit.control.expert import landing_speed
from falconwing_kit.core.checks import Array, InputError, require_range, require_shape
from falconwing_kit.core.frames import (
    HALL_HIGH,
    HALL_LOW,
    camera_pose,
    pose_matrix,
    rotation_world_body,
    wrap_angle,
)
from falconwing_kit.core.messages import CONTROL_PERIOD_S, Command, Image, Observation, State
from falconwing_kit.flight.batched_world import BatchedWorld
from falconwing_kit.flight.judges import FlightEvaluator, FollowEvaluator, LandingEvaluator
from falconwing_kit.flight.loop import HISTORY, LoopStep
from falconwing_kit.flight.rewards import DISCOUNT, LOCK_REWARD, FollowReward, LandingReward
from falconwing_kit.flight.sources import IMAGE_SIZE, RenderedView, fpv_camera
from falconwing_kit.flight.tasks.follow import BEHIND, FollowTask
from falconwing_kit.flight.tasks.landing import LandingTask
from falconwing_kit.flight.trial import TRIAL_SEEDS, TrialSetup, trial_seed
from falconwing_kit.flight.world import Contact
from falconwing_kit.scene.gaussians import GaussianScene

Floats = NDArray[np.float32]
StateObservation = Floats | dict[str, NDArray[Any]]
View = Literal["nose", "chase"]

LIMIT = 10.0  # of an observed number, in its unit
UNITS = np.array([10.0, 2.0, 1.0, *[0.35] * 3, 7.0, 2.0, 2.0, *[2.0] * 3])
FOLLOW_UNITS = np.array([10.0, 10.0, 1.0, *[0.35] * 3, 7.0, 7.0, 2.0, *[2.0] * 3])
LEADER_UNITS = np.array([*[4.0] * 3, *[0.35] * 3, *[2.0] * 3])
PAST = 4  # commands in an observation: longer than delay and servo lag together
CHASE_BACK, CHASE_UP, CHASE_PITCH = 3.0, 0.9, -0.2  # of the chase camera [m], [m], [rad]
OPTIONS = ("trial", "list", "manoeuvre")  # of `reset`


def command_from_action(action: ArrayLike) -> Command:
    """The command of an action (4,); the throttle comes as -1..1.

    Raises:
        InputError: the action has another shape or is not finite.
    """
    values = require_shape("action", np.asarray(action, np.float64), (4,)).tolist()
    return Command.clip(0.5 * (values[0] + 1.0), *values[1:])


def action_from_command(command: Command) -> Floats:
    """The action (4,) of a command; the inverse of `command_from_action`."""
    values = command.vector
    values[0] = 2.0 * values[0] - 1.0
    return values.astype(np.float32)


class FlightEnvironment(gymnasium.Env[StateObservation, Floats]):
    """One flight of a task at a time; the observation and the reward are described above."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1.0 / CONTROL_PERIOD_S)}  # noqa: RUF012

    def __init__(
        self, task: LandingTask | FollowTask, *, images: bool = False,
        scene: str | GaussianScene = "hall", image_size: tuple[int, int] = IMAGE_SIZE,
        history: int = PAST, discount: float = DISCOUNT, render_mode: str | None = None,
        view: View = "chase",
    ) -> None:  # fmt: skip
        """Prepare flights; the first begins with `reset`.

        Args:
            task: to fly.
            images: render the nose camera into every observation; the judge then also finds
                occlusions.
            scene: a name that ships ("hall", "arena") or a scene, for images and `render`.
            image_size: width and height [px].
            history: past commands in an observation.
            discount: of the potential in the reward, as the agent's.
            render_mode: None or "rgb_array".
            view: of `render`, "nose" or "chase".

        Raises:
            InputError: an argument is out of its range.
        """
        for name, value, known in (
            ("render_mode", render_mode, (None, "rgb_array")), ("view", view, ("nose", "chase")),
        ):  # fmt: skip
            if value not in known:
                raise InputError(f"{name}: expected one of {known}, got {value!r}")
        self.task, self.render_mode, self._images, self._view_name = task, render_mode, images, view
        self._camera, self._scene = fpv_camera(*image_size), scene
        self._history = int(require_range("history", history, low=0, high=HISTORY))
        self._discount = require_range("discount", discount, low=0.0, high=1.0)
        self._follows = isinstance(task, FollowTask)
        self._landing_reward = LandingReward(task.airframe, _pad(task))
        self._follow_reward = FollowReward(BEHIND)
        self._units = np.concatenate([FOLLOW_UNITS, LEADER_UNITS]) if self._follows else UNITS
        self.action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.observation_space = _observation_space(
            len(self._units), self._history, image_size if images else None
        )
        self._trial: TrialSetup | None = None
        self._judge: FlightEvaluator | None = None
        self._view: RenderedView | None = None
        self._frame, self._past = 0, np.zeros((HISTORY, 4))
        self._image: NDArray[np.uint8] | None = None
        self._ended = True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[StateObservation, dict[str, Any]]:
        """Begin a flight from a training seed drawn by `seed`, or a trial of the frozen list.

        Args:
            seed: of the draws of this and of later flights; None goes on drawing.
            options: "trial": number in the frozen list; "list": its number, 0 by default;
                "manoeuvre": of the leader from now on, for following.

        Raises:
            InputError: an option is unknown or out of its range.
        """
        super().reset(seed=seed)
        chosen = _require_options(options)
        if "manoeuvre" in chosen:
            if not isinstance(self.task, FollowTask):
                raise InputError("manoeuvre: expected none for a landing; use FalconWing/Follow-v0")
            self.task = replace(self.task, manoeuvre=chosen["manoeuvre"])
        if chosen.get("trial") is None:
            world_seed = int(self.np_random.integers(TRIAL_SEEDS))
        else:
            world_seed = trial_seed(chosen["trial"], chosen.get("list", 0))
        self._trial = trial = self.task.trial(world_seed)
        if self._images or self.render_mode:
            self._open_view(trial)
        self._frame, self._past, self._ended = 0, np.zeros((HISTORY, 4)), False
        seen = self._view if self._images else None
        self._judge = self.task.judge(trial, self._camera, seen)
        self._watch(Command(0.0, 0.0, 0.0, 0.0))
        observation, clipped = self._observe()
        return observation, {"seed": world_seed, "t": 0.0, "clipped": clipped}

    def step(self, action: ArrayLike) -> tuple[StateObservation, float, bool, bool, dict[str, Any]]:
        """Send an action and fly 50 ms.

        Raises:
            InputError: the action is not four finite numbers, or no flight has begun.
        """
        trial, command = self._require_flight(), command_from_action(action)
        before = self._potential(trial)
        trial.world.send(self._frame * CONTROL_PERIOD_S, command)
        self._past = np.concatenate([self._past[1:], command.vector[None]])
        self._frame += 1
        t = self._frame * CONTROL_PERIOD_S
        trial.world.advance(t)
        reason = self._watch(command)
        terminated = bool(reason)
        # The loop of `fly` flies a step at every multiple of the period before the duration.
        truncated = not terminated and (self._frame + 1) * CONTROL_PERIOD_S >= trial.duration
        reward = -before if terminated else self._discount * self._potential(trial) - before
        observation, clipped = self._observe()
        info: dict[str, Any] = {"seed": trial.seed, "t": t, "clipped": clipped}
        if isinstance(self._judge, FollowEvaluator):
            reward += LOCK_REWARD * self._judge.is_locked
        if terminated or truncated:
            self._ended = True
            result = self._judge.result() if self._judge else {}
            info |= {"reason": reason or "duration", "result": result}
            reward += 0.0 if self._follows else self._landing_reward.outcome(result)
        return observation, float(reward), terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """SIMULATED picture (height, width, 3) of the present moment; None without render mode."""
        if self.render_mode is None or self._view is None:
            return None
        if self._view_name == "nose":
            return self._view.look()
        return self._look_from_behind()

    def pilot_observation(self) -> Observation:
        """The same moment as the kit's pilots get it in `fly`."""
        trial = self._require_flight()
        t = self._frame * CONTROL_PERIOD_S
        image = None if self._image is None else Image(self._frame, t, self._image)
        return Observation(t, image, self._past, trial.world.measured())

    @property
    def trial(self) -> TrialSetup:
        """World, leader and duration of the present flight; InputError before the first `reset`."""
        if self._trial is None:
            raise InputError("flight: expected one that has begun, got none; call reset() first")
        return self._trial

    def _require_flight(self) -> TrialSetup:
        if self._ended:
            raise InputError("flight: expected one that goes on, got none; call reset() first")
        return self.trial

    def _potential(self, trial: TrialSetup) -> float:
        own, leader = trial.world.state, trial.world.leader_state
        if leader is None:
            return float(self._landing_reward.potential(own.vector))
        return self._follow_reward.potential(own, leader)

    def _watch(self, command: Command) -> str:
        """Take the image of this moment and have the judge look; its reason to end."""
        if self._images and self._view is not None:
            self._image = self._view.look()
        if self._judge is None:
            return ""
        t, world = self._frame * CONTROL_PERIOD_S, self.trial.world
        return self._judge.watch(
            LoopStep(t, None, world.measured(), command, "", world.leader_state)
        )

    def _observe(self) -> tuple[StateObservation, bool]:
        world = self.trial.world
        measured = world.measured().vector
        if world.leader_state is None:
            relative = relative_state(measured, _pad(self.task))
        else:
            relative = _follower_state(measured, world.leader_state)
        state, clipped = _scaled(relative, self._units)
        past = self._past[HISTORY - self._history :].astype(np.float32)
        if self._image is None or not self._images:
            return np.concatenate([state, past.ravel()]), clipped
        return {"image": self._image.copy(), "state": state, "past_commands": past}, clipped

    def _open_view(self, trial: TrialSetup) -> None:
        """One view for all flights: to load and compile takes seconds."""
        if self._view is not None:
            self._view.world = trial.world
            return
        from falconwing_kit.scene.arena import leader_at, load_scene

        scene = load_scene(self._scene) if isinstance(self._scene, str) else self._scene
        mount = self.task.airframe.p_body_camera
        self._view = RenderedView(trial.world, scene, self._camera, mount)
        if self.render_mode and self._view_name == "chase":
            self._hall = leader_at(scene, None) if "leader" in scene.label_names else scene
            self._aircraft = load_scene("leader")

    def _look_from_behind(self) -> NDArray[np.uint8]:
        from falconwing_kit.scene.arena import leader_at
        from falconwing_kit.scene.render import render

        world = self.trial.world
        own, leader = world.state, world.leader_state
        R_level = rotation_world_body(0.0, 0.0, own.yaw)
        behind = own.p_world + R_level @ (-CHASE_BACK, 0.0, -CHASE_UP)
        R_camera_body = rotation_world_body(0.0, CHASE_PITCH, own.yaw)
        aircraft = [own] if leader is None else [own, leader]
        scenes = [leader_at(self._aircraft, state.pose.T_world_body) for state in aircraft]
        T_world_camera = camera_pose(pose_matrix(R_camera_body, behind))
        frame = render([self._hall, *scenes], self._camera, T_world_camera, backend="fast")
        return np.asarray(255.0 * frame.rgb + 0.5, np.uint8)


def landing_environment(task: LandingTask | None = None, **settings: Any) -> FlightEnvironment:
    """FalconWing/Landing-v0: land on the pad from about 20 m before it.

    Args:
        task: another aircraft, pad or spread; None for that of `fly`.
        settings: of `FlightEnvironment`.
    """
    return FlightEnvironment(task or LandingTask(), **settings)


def follow_environment(
    manoeuvre: str = "left_turn_s_descent", task: FollowTask | None = None, **settings: Any
) -> FlightEnvironment:
    """FalconWing/Follow-v0: keep a leader in view through a manoeuvre, from about 4 m behind it.

    Args:
        manoeuvre: that the leader flies.
        task: another aircraft or spread, with its own manoeuvre; None for that of `fly`.
        settings: of `FlightEnvironment`.
    """
    return FlightEnvironment(task or FollowTask(manoeuvre), **settings)


@dataclass
class _FlownWorld:
    """A flown landing, as its evaluator reads a world."""

    state: State
    contact: Contact | None = None


class FalconWingLandingVector(VectorEnv[Floats, Floats, NDArray[Any]]):
    """Many landings at once, without images: row by row FalconWing/Landing-v0 with the same seed.

    Same model, delay, noise, contact and judge; states agree within 1e-8. A flight that ends begins
    again in the same step (AutoresetMode.SAME_STEP): the observation is the new flight's first, and
    infos has "final_obs" and "final_info" of the old one, in the form of SyncVectorEnv, with the
    judge's record of each ended row in infos["final_info"]["result"]. The first call compiles for
    some seconds. A row costs the less the more there are, up to about a thousand.
    """

    metadata = {  # noqa: RUF012
        "render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP,
        "render_fps": round(1.0 / CONTROL_PERIOD_S),
    }  # fmt: skip

    def __init__(
        self,
        num_envs: int = 64,
        *,
        task: LandingTask | None = None,
        history: int = PAST,
        discount: float = DISCOUNT,
        starts: Callable[[int], Array] | None = None,
    ) -> None:
        """Prepare flights; they begin with `reset`.

        Args:
            num_envs: B, flights at once.
            task: another aircraft, pad or spread; None for that of `fly`.
            history: past commands in an observation.
            discount: of the potential in the reward, as the agent's.
            starts: a flight's seed -> its true state (12,) at the start; None for the task's own.

        Raises:
            InputError: an argument is out of its range, or the model needs SimulatedWorld.
        """
        self.task = task = task or LandingTask()
        self.num_envs = int(require_range("num_envs", num_envs, low=1, high=100_000))
        self._history = int(require_range("history", history, low=0, high=HISTORY))
        self._discount = require_range("discount", discount, low=0.0, high=1.0)
        self._reward, self.starts = LandingReward(task.airframe, task.pad), starts
        self.world = BatchedWorld(task.model, task.airframe, self.num_envs, pad=task.pad)
        self.single_action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.single_observation_space = _observation_space(len(UNITS), self._history, None)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._speed = landing_speed(task.model)
        self._steady = State.from_vector(trim(task.model, self._speed).state)
        frames = np.arange(int(task.duration / CONTROL_PERIOD_S) + 3)
        # Steps of a flight that reaches the duration; the same sum as in the single environment.
        self._last = int(np.argmax((frames + 1) * CONTROL_PERIOD_S >= task.duration))
        self._flown = np.zeros((len(frames) + 1, self.num_envs, 3))
        self._past = np.zeros((self.num_envs, self._history, 4))
        self._potential = np.zeros(self.num_envs)
        self._seeds = np.zeros(self.num_envs, np.int64)
        self._rngs = [seeding.np_random()[0] for _ in range(self.num_envs)]
        self._begun = False

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Floats, dict[str, Any]]:  # fmt: skip
        """Begin all flights.

        Args:
            seed: as of SyncVectorEnv: row i draws by seed + i, or by the i-th of a list.
            options: "trial": number of row 0 in the frozen list, row i has the i-th after it, or a
                number for every row; "list": the number of the list. Later flights draw their
                seeds.

        Raises:
            InputError: an option is unknown or out of its range, or there are not B seeds.
        """
        B, chosen = self.num_envs, _require_options(options)
        if "manoeuvre" in chosen:
            raise InputError("manoeuvre: expected none for a landing")
        if seed is not None:
            seeds = list(seed) if isinstance(seed, Sequence) else [seed + i for i in range(B)]
            if len(seeds) != B:
                raise InputError(f"seed: expected one for each of {B} flights, got {len(seeds)}")
            for row, each in enumerate(seeds):
                if each is not None:
                    self._rngs[row] = seeding.np_random(each)[0]
        trial = chosen.get("trial")
        if trial is None:
            drawn = [self._draw_seed(row) for row in range(B)]
        else:
            numbers = list(trial) if np.ndim(trial) else [trial + i for i in range(B)]
            if len(numbers) != B:
                raise InputError(f"trial: expected one for each of {B} flights, got {len(numbers)}")
            drawn = [trial_seed(number, chosen.get("list", 0)) for number in numbers]
        self._begin(list(range(B)), drawn)
        observations, clipped = self._observe()
        return observations, {"seed": self._seeds.copy(), "clipped": clipped}

    def begin(self, seeds: Sequence[int]) -> Floats:
        """Begin all flights from world seeds (B,), such as training seeds; their observations."""
        if len(seeds) != self.num_envs:
            raise InputError(f"seeds: expected one a flight, {self.num_envs}, got {len(seeds)}")
        self._begin(list(range(self.num_envs)), list(seeds))
        return self._observe()[0]

    def step(
        self, actions: ArrayLike
    ) -> tuple[Floats, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Send an action to every flight and fly 50 ms.

        Args:
            actions: (B, 4).

        Raises:
            InputError: the actions are not (B, 4) finite numbers, or nothing has begun.
        """
        if not self._begun:
            raise InputError("flights: expected ones that have begun; call reset() first")
        values = require_shape("actions", np.array(actions, np.float64), (self.num_envs, 4))
        if not np.isfinite(values).all():
            raise InputError("actions: expected finite numbers, got nan or infinity")
        values[:, 0] = 0.5 * (values[:, 0] + 1.0)
        commands = np.clip(values, (0.0, -1.0, -1.0, -1.0), 1.0)
        self.world.advance(commands)
        if self._history:
            self._past = np.concatenate([self._past[:, 1:], commands[:, None]], axis=1)
        rows, frames = np.arange(self.num_envs), self.world.frames
        self._flown[frames, rows] = self.world.x[:, :3]
        contacts = self.world.contacts
        terminated = np.array([contact is not None for contact in contacts])
        truncated = ~terminated & (frames >= self._last)
        potential = np.where(terminated, 0.0, self._reward.potential(self.world.x))
        rewards = self._discount * potential - self._potential
        self._potential = potential
        infos: dict[str, Any] = {}
        ended = np.flatnonzero(terminated | truncated)
        if ended.size:
            last, clipped = self._observe()
            infos = self._final(ended, last, clipped, rewards)
            self._begin(ended.tolist(), [self._draw_seed(row) for row in ended.tolist()])
        observations, clipped = self._observe()
        infos |= {"seed": self._seeds.copy(), "clipped": clipped}
        return observations, rewards, terminated, truncated, infos

    def _final(
        self, ended: NDArray[np.int64], last: Floats, clipped: NDArray[np.bool_], rewards: Array
    ) -> dict[str, Any]:
        """Judge the flights that ended, and add the outcome to their rewards."""
        B = self.num_envs
        mask = np.zeros(B, bool)
        mask[ended] = True
        final_obs, results, reasons = (np.full(B, None, object) for _ in range(3))
        success = np.zeros(B, bool)
        for row in ended.tolist():
            contact, frames = self.world.contacts[row], int(self.world.frames[row])
            result = _judge_landing(self._flown[: frames + 1, row], contact)
            rewards[row] += self._reward.outcome(result)
            final_obs[row], results[row], success[row] = last[row].copy(), result, result["success"]
            reasons[row] = f"touched {contact.obstacle}" if contact else "duration"
        info = {
            "seed": self._seeds.copy(), "t": self.world.t.copy(), "clipped": clipped.copy(),
            "reason": reasons, "result": results, "success": success,
        }  # fmt: skip
        info |= {f"_{key}": mask.copy() for key in info}
        masks = {"_final_obs": mask, "_final_info": mask.copy()}
        return {"final_obs": final_obs, "final_info": info, **masks}

    def _draw_seed(self, row: int) -> int:
        """A training seed, as the single environment draws it."""
        return int(self._rngs[row].integers(TRIAL_SEEDS))

    def _begin(self, rows: list[int], seeds: list[int]) -> None:
        states, self._begun = np.array([self._start(seed) for seed in seeds]), True
        self.world.begin(rows, states, seeds)
        self._seeds[rows], self._past[rows], self._flown[0, rows] = seeds, 0.0, states[:, :3]
        self._potential[rows] = self._reward.potential(states)

    def _start(self, seed: int) -> Array:
        if self.starts is not None:
            return self.starts(seed)
        task = self.task
        near = (self._steady, task.nominal, seed)
        return (task.start or task.spread.start_near(*near, speed=self._speed)).vector

    def _observe(self) -> tuple[Floats, NDArray[np.bool_]]:
        return landing_observation(self.world.measured, self._past, self.task.pad)


def landing_observation(
    measured: Array, past: Array, pad: LandingPad
) -> tuple[Floats, NDArray[np.bool_]]:
    """The observations of Landing-v0 without images.

    Args:
        measured: (..., 12) measured states in the order of STATE_NAMES, SI.
        past: (..., history, 4) past commands, oldest first.
        pad: the landing pad.

    Returns:
        (..., 12 + 4 history), and (...) whether a number was beyond its limit and cut.
    """
    scaled = relative_state(measured, pad) / UNITS
    state = np.clip(scaled, -LIMIT, LIMIT)
    flat = past.reshape(*past.shape[:-2], -1)
    return np.concatenate([state, flat], axis=-1).astype(np.float32), np.any(state != scaled, -1)


def relative_state(measured: Array, pad: LandingPad) -> Array:
    """States (..., 12) relative to the pad's threshold, centre line and top; yaw wrapped."""
    relative = measured - (pad.x_start, pad.y_centre, pad.height, *[0.0] * 9)
    relative[..., 3:6] = wrap_angle(relative[..., 3:6])
    return relative


def _follower_state(measured: Array, leader: State) -> Array:
    """(21,) the own measured state about the hall's middle, and the leader along its heading."""
    middle = 0.5 * (HALL_LOW + HALL_HIGH) * (1.0, 1.0, 0.0)
    own = measured.copy()
    own[:3] -= middle
    own[3:6] = wrap_angle(own[3:6])
    R_level = rotation_world_body(0.0, 0.0, float(measured[4]))  # columns ahead, right, down
    axes = R_level.T * np.array([1.0, -1.0, -1.0])[:, None]  # rows ahead, left, up
    place, speed = axes @ (leader.p_world - measured[:3]), axes @ (leader.v_world - measured[6:9])
    turned = wrap_angle(np.array([leader.pitch, leader.yaw - measured[4], leader.roll]))
    return np.concatenate([own, place, turned, speed])


def _scaled(values: Array, units: Array) -> tuple[Floats, bool]:
    scaled = values / units
    clipped = np.clip(scaled, -LIMIT, LIMIT)
    return clipped.astype(np.float32), bool(np.any(clipped != scaled))


def _observation_space(
    numbers: int, history: int, image_size: tuple[int, int] | None
) -> spaces.Space[Any]:
    lowest = np.array([0.0, -1.0, -1.0, -1.0], np.float32)
    low, high = np.tile(lowest, (history, 1)), np.ones((history, 4), np.float32)
    if image_size is None:
        bound = np.full(numbers, LIMIT, np.float32)
        return spaces.Box(
            np.concatenate([-bound, low.ravel()]), np.concatenate([bound, high.ravel()])
        )
    width, height = image_size
    return spaces.Dict(
        {
            "image": spaces.Box(0, 255, (height, width, 3), np.uint8),
            "state": spaces.Box(-LIMIT, LIMIT, (numbers,), np.float32),
            "past_commands": spaces.Box(low, high),
        }
    )


def _judge_landing(path: Array, contact: Contact | None) -> dict[str, Any]:
    """The judge's record of a flown path (n, 3) and its end."""
    still = np.zeros(3)
    world = _FlownWorld(State(path[0], 0.0, 0.0, 0.0, still))
    judge = LandingEvaluator(world)  # type: ignore[arg-type]
    step = LoopStep(0.0, None, None, Command(0.0, 0.0, 0.0, 0.0), "", None)
    for p_world in path:
        world.state = State(p_world, 0.0, 0.0, 0.0, still)
        judge.watch(step)
    world.contact = contact
    return judge.result()


def _pad(task: LandingTask | FollowTask) -> LandingPad:
    return task.pad if isinstance(task, LandingTask) else LandingPad()


def _require_options(options: Mapping[str, Any] | None) -> Mapping[str, Any]:
    unknown = [name for name in options or {} if name not in OPTIONS]
    if unknown:
        raise InputError(f"options: expected some of {', '.join(OPTIONS)}, got {unknown[0]!r}")
    return options or {}


def _register() -> None:
    here = "falconwing_kit.flight.environments"
    gymnasium.register(
        id="FalconWing/Landing-v0", entry_point=f"{here}:landing_environment",
        vector_entry_point=f"{here}:FalconWingLandingVector",
    )  # fmt: skip
    gymnasium.register(id="FalconWing/Follow-v0", entry_point=f"{here}:follow_environment")


_register()
