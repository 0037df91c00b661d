"""Lab 13, given: your parts put together: camera, aircraft, pilots, board, gap, and the figures.

The parts come in as `parts`, a package with a module for each lab: yours or the kit's. The kit and
matplotlib are imported where they are needed.
"""

import importlib
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

Array = np.ndarray

HERE = Path(__file__).parent
COHORT: dict[str, float] = json.loads((HERE / "cohort.json").read_text(encoding="utf-8"))
WORTH_M = COHORT["worth_m"]  # an offset at which a landing is worth 1/e of its points [m]
SOFT_SINK = COHORT["soft_sink"]  # a touchdown up to this sink rate is soft [m/s]
IMAGE_EVERY = 2  # a picture every second step

STEP_S, STEPS = 0.05, 240  # [s]; a flight ends after 12 s at the latest
FIT_ROWS, AHEAD = 54, 20  # steps that lab 5 identifies, and those of the forecast
WIDTH, HEIGHT = 160, 120  # of the film [px]
LENS = {"fx": 99.2, "fy": 99.2, "cx": 80.0, "cy": 60.0}  # [px], first pixel's centre at (0.5, 0.5)
GAUSSIANS = 10_000  # of the thinned hall
BACKGROUND = np.array([0.55, 0.56, 0.58])
BLUR_PX2 = 0.3

START = np.array(
    [13.0, -10.7, 2.8, 0.09, math.pi, 0.0, -7.0, 0.0, 0.0]
)  # west, along the right wall
AWAY_START, AWAY_END = np.array([15.0, -10.7]), np.array([-15.0, -10.7])  # first line [m]
TURN_X = -13.5
FINAL_START, AIM = np.array([-35.0, -2.0]), np.array([5.0, -2.0])  # second line [m]
PAD = (1.0, 14.0, -3.0, -1.0)  # x from, to, y from, to [m]
FIRST_COMMAND = np.array([0.24, 0.0, 0.0, 0.0])  # with which the board engages
FLOOR_Z = 0.21  # height of the centre of gravity at touchdown: pad 0.1 m and wheels 0.11 m [m]
BANK_LIMIT, POLICY_BANK = math.radians(50), math.radians(50)  # [rad]; full aileron of lab 8
TRUST = math.radians(COHORT["trust_deg"])  # farther from the expert, the policy is overruled [rad]
HISTORY = 10  # past commands that the policy sees

NOISE = np.array([0.01, 0.01, 0.01, 0.004, 0.004, 0.004, 0.02, 0.02, 0.02])  # of the log, sigmas
HIDDEN = ("extra_drag", "thrust_loss", "aileron_loss", "adverse_yaw")  # one of them, by COHORT
SIZES = {"extra_drag": 0.012, "thrust_loss": 0.25, "aileron_loss": 0.3, "adverse_yaw": 0.08}
STEPS_OF = {"extra_drag": 0.003, "thrust_loss": 0.05, "aileron_loss": 0.05, "adverse_yaw": 0.02}
FREE = ("cL_0", "cL_alpha", "cD_0", "kT", "L_da", "M_0", "M_de", "N_dr")  # known to 3 % only

BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#777777"  # Okabe and Ito


def hidden_effect() -> tuple[str, float]:
    """What your course hides in the flight under test: name and size. Look after you named it."""
    name = HIDDEN[int(COHORT["hidden_number"])]
    return name, SIZES[name]


def lab_given(parts: Any, lab: str) -> Any:
    """The given code of an earlier lab, with your course's numbers: "lab04"."""
    return importlib.import_module(f"{parts.__name__}.given.{lab}")


# The hall and the camera


def load_hall() -> dict[str, Array]:
    """The kit's hall (195,753 Gaussians) as arrays.

    Returns:
        means (N, 3) [m], world; log_scales (N, 3); quaternions_xyzw (N, 4); opacities (N,); colours
        (N, 3); groups (N,) number of the cell that each Gaussian falls into: cells are small at the
        marker, larger on the pad, and largest elsewhere, about GAUSSIANS in all.
    """
    from falconwing_kit.scene import load_scene

    scene = load_scene("hall")
    means = scene.means.astype(float)
    colours = np.clip(0.5 + 0.28209479 * scene.sh[:, 0].astype(float), 0.0, 1.0)
    side = np.select([scene.labels == 3, scene.labels == 2], [0.06, 0.12], 0.45)
    quaternions = scene.quaternions.astype(float)[:, [1, 2, 3, 0]]
    for _ in range(20):  # larger cells, until they are few enough
        cells = np.floor(means / side[:, None]).astype(np.int64)
        cells -= cells.min(axis=0)
        key = (*cells.T, scene.labels.astype(np.int64))
        # one whole number for each row: sorted many times as fast as rows are
        numbers = np.ravel_multi_index(key, [int(each.max()) + 1 for each in key])
        _, groups = np.unique(numbers, return_inverse=True)
        if groups.max() < GAUSSIANS:
            break
        side = np.where(scene.labels < 2, 1.05 * side, side)
    return {
        "means": means,
        "log_scales": np.log(np.maximum(scene.scales.astype(float), 1e-6)),
        "quaternions_xyzw": quaternions,
        "opacities": scene.opacities.astype(float),
        "colours": colours,
        "groups": groups,
    }


def camera_pose(parts: Any, state: Array) -> Array:
    """Pose of the nose camera by your lab 2: T_world_camera (4, 4), axes right, down, forward."""
    pitch, yaw, roll = state[3:6]
    heading = yaw + math.radians(lab_given(parts, "lab02").COHORT["runway_heading_deg"])
    R_world_map = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    R_map_body = parts.camera.rot_from_euler(roll, pitch, heading)
    T_map_camera = parts.camera.camera_pose(
        R_map_body, R_world_map.T @ state[:3], np.array([0.1, 0.0, 0.0]), 0.0
    )
    T_world_camera = np.eye(4)
    T_world_camera[:3] = R_world_map @ T_map_camera[:3]
    return T_world_camera


def new_look(parts: Any, scene: Mapping[str, Array]) -> Callable[[Array], Array]:
    """A function that renders what the nose camera sees: state (9,) -> (H, W, 3) uint8.

    Your lab 2 says where the camera is, your lab 3 projects and draws, with your `render_tiles`.

    Args:
        parts: yours or the kit's.
        scene: means (N, 3) [m], covs (N, 3, 3) [m^2], opacities (N,), colours (N, 3).
    """

    def look(state: Array) -> Array:
        T = camera_pose(parts, state) @ np.diag([1.0, -1.0, -1.0, 1.0])  # right, up, backwards
        means = (scene["means"] - T[:3, 3]) @ T[:3, :3]
        x, y, z = means.T
        seen = (z < -0.3) & (np.abs(x) < -1.3 * z) & (np.abs(y) < -1.1 * z)
        means, covs = means[seen], T[:3, :3].T @ scene["covs"][seen] @ T[:3, :3]
        means_px, covs_px = parts.renderer.project_gaussians(means, covs, LENS, BLUR_PX2)
        opacities, colours, depths = scene["opacities"][seen], scene["colours"][seen], -means[:, 2]
        shape = (HEIGHT, WIDTH)
        image = parts.renderer.render_tiles(
            means_px, covs_px, opacities, colours, depths, shape, BACKGROUND
        )
        return np.round(255.0 * np.clip(image, 0.0, 1.0)).astype(np.uint8)

    return look


def small(image: Array) -> Array:
    """The picture that the policy sees: (H, W, 3) uint8 -> (30, 40, 3) uint8, means of blocks."""
    blocks = image.reshape(30, HEIGHT // 30, 40, WIDTH // 40, 3)
    return np.round(blocks.mean(axis=(1, 3))).astype(np.uint8)


# The aircraft


def new_plant(
    parts: Any, effect: str = "none", size: float = 0.0, K: Mapping[str, float] | None = None
) -> Callable[[Array, Array, Array], Array]:
    """Your lab 4 as one step of 0.05 s, in still air: (state, command now, command next) -> state.

    Args:
        parts: yours or the kit's.
        effect, size: what is different, by your lab 12's `augment_model`; "none".
        K: the aircraft's numbers; lab 4's if None.
    """
    lab04 = lab_given(parts, "lab04")
    K = lab04.K if K is None else K

    def rate(x: Array, command: Array) -> Array:
        air = parts.aircraft.air_data(x, np.zeros(3))
        force, rates = parts.aircraft.body_force(air, command, K), lab04.body_rates(air, command, K)
        if effect != "none":
            V, alpha, beta = air
            flow = {
                "V": np.array([V]),
                "alpha": np.array([alpha]),
                "beta": np.array([beta]),
                "height": np.array([max(x[2], 0.0)]),
                "c": np.array([K["cL_0"] + K["cL_alpha"] * alpha]),
                "thrust": np.array([(K["kT"] - K["kTV"] * V) * command[0]]),
                "aileron": np.array([command[1]]),
            }
            added = parts.gap.augment_model(np.zeros((6, 1)), flow, K, effect, size)[:, 0]
            force, rates = force + added[:3], rates + added[3:] / V  # lab 4 has rates, not moments
        return np.asarray(parts.aircraft.state_rate(x, force, rates))

    def step(state: Array, now: Array, after: Array) -> Array:
        return np.asarray(parts.aircraft.rk4_step(rate, state, now, after, STEP_S))

    return step


# The pilots


class Expert:
    """Your lab 7: away along the wall, round to the runway, down and flare.

    Args:
        parts: yours or the kit's.
    """

    def __init__(self, parts: Any) -> None:
        self.parts, lab07 = parts, lab_given(parts, "lab07")
        self.autopilot, self.integral, self.final, self.idle = lab07.Autopilot(), 0.0, False, False
        self._last: Array | None = None

    def bank(self, state: Array) -> float:
        """The bank that leads along the line of this part of the flight [rad]."""
        self.final = self.final or state[0] < TURN_X
        line = (FINAL_START, AIM) if self.final else (AWAY_START, AWAY_END)
        if self.final and state[6] < -1.0 and state[1] < -6.0:
            return BANK_LIMIT  # round to the right, away from the wall
        return float(self.parts.expert.guidance(state[:2], state[6:8], *line, BANK_LIMIT))

    def command(self, state: Array, bank: float) -> Array:
        """Throttle, aileron, elevator, rudder (4,) that fly a bank and the height of this part."""
        speed, expert = float(np.linalg.norm(state[6:])), self.parts.expert
        height, distance = state[2] - FLOOR_Z, AIM[0] - state[0]
        climb, flaring = min(max(2.8 - state[2], -0.5), 0.5), False
        heads_in = state[6] > 0.6 * speed
        if self.final and heads_in:
            climb, flaring = expert.flare(height, distance, 7.0)
        self.idle = self.idle or bool(flaring)
        base = 0.05 if self.final and heads_in else 0.24
        throttle, self.integral = expert.hold_speed(7.0 - speed, self.integral, base)
        rates = expert.turn_rates(bank, state[3], speed)
        sticks = self.autopilot.sticks(self._measured(state), bank, climb, rates)
        return np.clip([0.0 if self.idle else throttle, *sticks], [0.0, -1.0, -1.0, -1.0], 1.0)

    def _measured(self, state: Array) -> SimpleNamespace:
        """State as lab 7's autopilot reads it; body rates from the angles' change."""
        before = state if self._last is None else self._last
        change = (state[3:6] - before[3:6] + np.pi) % (2.0 * np.pi) - np.pi
        pitch_dot, yaw_dot, roll_dot = change / STEP_S
        self._last = state
        pitch, _, roll = state[3:6]
        p = roll_dot - yaw_dot * math.sin(pitch)
        q = pitch_dot * math.cos(roll) + yaw_dot * math.sin(roll) * math.cos(pitch)
        r = yaw_dot * math.cos(roll) * math.cos(pitch) - pitch_dot * math.sin(roll)
        return SimpleNamespace(
            v_world=state[6:], roll=roll, pitch=pitch, rates_body=np.array([p, q, r])
        )


def load_flights() -> dict[str, Array]:
    """SIMULATED flights of the kit's expert with noise on its bank, drawn by the kit's parts.

    Returns:
        "images" (n, 30, 40, 3) uint8, one every second step; "banks" (2 n,) commanded at every
        step, with the noise, in full banks; "labels" (n,) the expert's own; "starts" (flights,)
        number of each flight's first image.
    """
    with np.load(HERE / "data" / "flights.npz", allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


class Pilot:
    """Your expert flies; your policy chooses the bank where it is near the expert's.

    Args:
        parts: yours or the kit's.
        policy: function of a picture (30, 40, 3) uint8 and the past banks (HISTORY,), the newest
            first -> bank, in full banks; None for the expert alone.

    Attributes:
        banks: what was chosen at every step: the expert's bank and the policy's [rad].
        trusted: whether the policy's was flown.
    """

    def __init__(self, parts: Any, policy: Callable[..., float] | None = None) -> None:
        self.expert, self._ask = Expert(parts), policy
        self._past, self._seen, self._policy = np.zeros(HISTORY), np.zeros(0), math.nan
        self.banks: list[tuple[float, float]] = []
        self.trusted: list[bool] = []

    def __call__(self, state: Array, image: Array | None) -> Array:
        """Throttle, aileron, elevator, rudder (4,) for a state (9,) and the newest picture."""
        own = self.expert.bank(state)
        if self._ask is not None and image is not None and image is not self._seen:
            self._seen, answer = image, float(self._ask(small(image), self._past))
            known = math.isfinite(answer)
            self._policy = POLICY_BANK * min(max(answer, -1.0), 1.0) if known else math.nan
        trusted = abs(self._policy - own) <= TRUST  # False where it is nan
        bank = self._policy if trusted else own
        self.banks.append((own, self._policy))
        self.trusted.append(bool(trusted))
        self._past = np.concatenate([[bank / POLICY_BANK], self._past[:-1]])
        return self.expert.command(state, bank)


# The wire and the board


class Board:
    """SIMULATED: from the pilot to the servos by your lab 10, with a bad contact.

    A command becomes the edges of PPM frames and slots again, as the radio understands it, then
    bytes on the serial line. Your `TrainerBridge` reads them and decides what goes to the radio:
    two frames a step. The pilot's sticks are near the command at first, so that it engages.

    Args:
        parts: yours or the kit's.
        to_sticks: your `sticks_from_slots`.
        lost: share of the steps in which a bit of the command is flipped.
        seed: of the bad contact.

    Attributes:
        states: of the board after each step.
    """

    def __init__(
        self, parts: Any, to_sticks: Callable[..., Array], lost: float = 0.03, seed: int = 13
    ) -> None:
        self.parts, self.to_sticks, self.lost = parts, to_sticks, lost
        self.lab10, self._rng = lab_given(parts, "lab10"), np.random.default_rng(seed)
        self._bridge, self.states = parts.bridge.TrainerBridge(), []
        self._t_ms, self._sequence = 0.0, 0
        self._bridge.frame(0.0, None)

    def engage(self, command: Array) -> None:
        """Hand over to the host: a pilot holds the sticks where the first command wants them."""
        slots = self._slots(command)
        for engaged in [False] * 5 + [True] * 8:
            self._bridge.frame(self._t_ms, slots)
            self._send(slots, engaged)
            self._t_ms += 22.0

    def carry(self, command: Array) -> Array | None:
        """What arrives at the servos (4,), or None where nothing does."""
        self._send(self._slots(command), True, flip=bool(self._rng.random() < self.lost))
        for part in (0.44, 0.88):
            slots = self._bridge.frame(self._t_ms + part * 1000.0 * STEP_S, None)
        self._t_ms += 1000.0 * STEP_S
        self.states.append(self._bridge.state)
        if self._bridge.state != "ACTIVE":
            return None
        lab10 = self.lab10
        return np.asarray(self.to_sticks(np.array(slots), "TAER", lab10.CENTRE_US, lab10.REACH_US))

    def _send(self, slots: tuple[float, ...] | None, engage: bool, flip: bool = False) -> None:
        """A command on the serial line, in two pieces; with a flipped bit the board drops it."""
        from falconwing_kit.trainer_port import encode_channels

        self._sequence += 1
        if slots is None:
            return
        data = encode_channels(self._sequence, [round(us) for us in slots], engage)
        if flip:
            data = data[:5] + bytes([data[5] ^ 4]) + data[6:]
        self._bridge.receive(data[:9], self._t_ms + 1.0)
        self._bridge.receive(data[9:], self._t_ms + 2.0)

    def _slots(self, command: Array) -> tuple[float, ...] | None:
        """Slots [us] of a command after the wire, or None."""
        names = ("throttle", "aileron", "elevator", "rudder")
        sticks = dict(zip(names, map(float, command), strict=True))
        edges = self.parts.bridge.encode_ppm(sticks, "TAER", 0)[::2]
        frame = int(self.lab10.TICKS_PER_US * self.lab10.FRAME_US)
        stream = np.concatenate([edges + number * frame for number in range(4)]) % self.lab10.TIMER
        slots = self.parts.bridge.decode_ppm(stream, 4)
        return tuple(float(us) for us in slots[-1]) if len(slots) else None


def run_fly(
    function: Callable[..., Any],
    start: Array,
    gains: Array,
    lost: Array,
    steps: float,
    floor: float,
) -> dict[str, Array]:
    """Calls your `fly` in a small world of numbers; checks and grader call it through this.

    Args:
        function: fly.
        start: (9,) first state.
        gains: (4, 18) commands for state and picture.
        lost: (m,) steps whose command does not arrive.
        steps: at most.
        floor: height at which it ends.

    Returns:
        "states", "commands", and "frames" as one array.
    """
    count = {"carry": 0}

    def look(state: Array) -> Array:
        return np.array(state) + 0.5

    def decide(state: Array, image: Array) -> Array:
        return np.asarray(gains @ np.concatenate([state, image]))

    def carry(command: Array) -> Array | None:
        count["carry"] += 1
        return None if count["carry"] - 1 in lost else 0.5 * command

    def step(state: Array, now: Array, after: Array) -> Array:
        push = np.concatenate([[0.0, 0.0, -0.1], 0.3 * now[:3], 0.2 * after[:3]])
        return np.asarray(0.97 * state + 0.1 * push)

    flown = function(np.array(start), look, decide, carry, step, int(steps), floor)
    return {
        "states": np.asarray(flown["states"]),
        "commands": np.asarray(flown["commands"]),
        "frames": np.array(flown["frames"]),
    }


# The gap


def logged(flown: Mapping[str, Array], seed: int) -> dict[str, Array]:
    """SIMULATED log of a flight: states (n + 1, 9) with noise, commands (n, 4) exact."""
    noise = NOISE * np.random.default_rng(seed).normal(size=np.shape(flown["states"]))
    return {"states": flown["states"] + noise, "commands": np.asarray(flown["commands"])}


def one_step_ahead(parts: Any, log: Mapping[str, Array], **changes: Any) -> Array:
    """Your model's next state less the logged one, in sigmas (n, 9); `changes` as for new_plant."""
    step, commands = new_plant(parts, **changes), log["commands"]
    before = np.vstack([np.zeros(4), commands[:-1]])
    ahead = [step(*each) for each in zip(log["states"][:-1], before, commands, strict=True)]
    return np.asarray((np.array(ahead) - log["states"][1:]) / (math.sqrt(2.0) * NOISE))


def name_the_gap(
    parts: Any, calm: Mapping[str, Array], flight: Mapping[str, Array]
) -> dict[str, Any]:
    """Your lab 12 on two logs, row by row: which candidate explains the flight?

    Returns:
        "gains" by candidate, "sizes" by candidate, "threshold", "word" and "names" of your verdict.
    """
    K = lab_given(parts, "lab04").K
    calm_r, calm_J, calm_E = _sensitivities(parts, calm, K)
    r, J, E = _sensitivities(parts, flight, K)
    scatter = float(np.mean(calm_r**2))
    precision = np.diag([1.0 / (0.03 * K[name]) ** 2 for name in FREE])
    away = np.zeros(len(FREE))

    def scores(rows: Array, r: Array, J: Array, E: Mapping[str, Array]) -> dict[str, Array]:
        flat = {name: column[rows].reshape(-1, 1) for name, column in E.items()}
        return dict(
            parts.gap.score_candidates(
                r[rows].ravel(), J[rows].reshape(-1, len(FREE)), away, precision, flat, scatter
            )
        )

    found = scores(np.arange(len(r)), r, J, E)
    thirds = [np.arange(first, len(calm_r), 3) for first in range(3)]  # every phase in each
    chance = [max(s[0] for s in scores(part, calm_r, calm_J, calm_E).values()) for part in thirds]
    gains = {name: float(score[0]) for name, score in found.items()}
    threshold, word, names = parts.gap.verdict(gains, np.array(chance))
    sizes = {name: float(score[1]) for name, score in found.items()}
    return {
        "gains": gains,
        "sizes": sizes,
        "threshold": float(threshold),
        "word": word,
        "names": tuple(names),
    }


def _sensitivities(
    parts: Any, log: Mapping[str, Array], K: Mapping[str, float]
) -> tuple[Array, Array, dict[str, Array]]:
    """Residuals (n, 9), their slopes to K (n, 9, F), and to each candidate's size (n, 9)."""
    r = one_step_ahead(parts, log)
    J = [
        (one_step_ahead(parts, log, K={**K, name: 1.01 * K[name]}) - r) / (0.01 * K[name])
        for name in FREE
    ]
    E = {
        name: (one_step_ahead(parts, log, effect=name, size=size) - r) / size
        for name, size in STEPS_OF.items()
    }
    return r, np.stack(J, axis=-1), E


# The film and the figures


def film(frames: Array, seconds: float = 0.1) -> bytes:
    """An animated GIF of pictures (n, H, W, 3) uint8, at most 1 MB: as many colours as fit."""
    from falconwing_kit.tools.grading import moving_pictures

    return bytes(moving_pictures(frames, seconds, "a film").data)


def draw_flight(flown: Mapping[str, Any], pilot: Pilot, board: Board) -> None:
    """Six pictures of the film, the track from above, height, and who chose the bank."""
    import matplotlib.pyplot as plt

    states, frames = flown["states"], flown["frames"]
    t = STEP_S * np.arange(len(states))
    figure = plt.figure(figsize=(11.0, 6.0), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(1.0, 2.0))
    for ax, number in zip(
        above.subplots(1, 6), np.linspace(0, len(frames) - 1, 6).astype(int), strict=True
    ):
        ax.imshow(frames[number])
        ax.set_title(f"{IMAGE_EVERY * STEP_S * number:.1f} s", fontsize=8)
        ax.axis("off")
    track, bank = below.subplots(1, 2)
    track.plot([-22.5, 17.5, 17.5, -22.5, -22.5], [-12, -12, 8, 8, -12], color="black", lw=1)
    track.fill([PAD[0], PAD[1], PAD[1], PAD[0]], [PAD[2], PAD[2], PAD[3], PAD[3]], color="#9fc5e8")
    track.plot(states[:, 0], states[:, 1], color=BLUE, label="flown")
    for k in range(0, len(states), 40):
        words, beside = f"{t[k]:.0f} s, {states[k, 2]:.1f} m", (4, 5)
        track.plot(*states[k, :2], ".", color=BLUE)
        side = "right" if states[k, 0] > 8.0 else "left"
        track.annotate(
            words, states[k, :2], beside, textcoords="offset points", fontsize=8, ha=side
        )
    track.plot(*states[-1, :2], "o", color=ORANGE, label="end")
    track.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="SIMULATED, from above")
    track.set(ylim=(-13.0, 13.0))
    track.legend(fontsize=8, loc="upper right", ncols=2)
    own, policy = np.degrees(np.array(pilot.banks)).T
    bank.plot(t[1 : len(own) + 1], own, "--", color=ORANGE, label="expert's bank")
    bank.plot(t[1 : len(own) + 1], policy, color=BLUE, label="policy's bank, from the picture")
    lost = [k for k, state in enumerate(board.states) if state != "ACTIVE"]
    bank.plot(t[1:][lost], np.full(len(lost), -48.0), "x", color=GREY, label="board not ACTIVE")
    bank.set(xlabel="time [s]", ylabel="bank [deg], right wing down positive")
    bank.set_title(f"The policy chose {100.0 * np.mean(pilot.trusted):.0f} % of the banks")
    bank.legend(fontsize=8)


def draw_gains(found: Mapping[str, Any]) -> None:
    """Bars of evidence for each candidate, and the threshold."""
    import matplotlib.pyplot as plt

    gains = found["gains"]
    names = sorted(gains, key=lambda name: gains[name])
    ax: Any = plt.subplots(figsize=(7.0, 2.4), layout="constrained")[1]
    bars = ax.barh(names, [gains[name] for name in names], color=BLUE)
    ax.bar_label(bars, fmt="%.1f", padding=3, fontsize=8)
    ax.axvline(found["threshold"], color=ORANGE, ls="--", label="threshold")
    ax.set_xscale("symlog", linthresh=10.0)
    ax.margins(x=0.12)
    ax.set(xlabel="evidence: chi2 gained less its price [-]", title="What was hidden?")
    ax.legend(fontsize=8, loc="lower right")


def words_for(flown: Mapping[str, Any]) -> str:
    """The film in words, from the flight itself."""
    states = flown["states"]
    seconds = STEP_S * (len(states) - 1)
    turn = STEP_S * int(np.argmax(np.abs(states[:, 5]) > math.radians(20.0)))
    return (
        f"Film of a simulated flight of {seconds:.1f} s through a hall, seen from the nose: along "
        f"a wall, from {turn:.1f} s on a turn to the right, then towards a blue pad; the last "
        f"picture is taken {states[-1, 2]:.1f} m above the floor at x = {states[-1, 0]:.1f} m, "
        f"y = {states[-1, 1]:.1f} m."
    )


def entry_of(flown: Mapping[str, Any], points: float, parts: Any) -> str:
    """An entry for the class's leaderboard, JSON: the commands, and what you say they are worth."""
    record = Path(parts.__file__).with_name("parts.json")
    functions = json.loads(record.read_text(encoding="utf-8"))["functions"]
    return json.dumps(
        {
            "entry": "lab13",
            "points": round(points, 3),
            "mine": sum(bool(each["mine"]) for each in functions),
            "of": len(functions),
            "commands": np.round(flown["commands"], 6).tolist(),
        }
    )


def fly_entry(entry: str, score: Callable[[Array], tuple[float, ...]]) -> float:
    """Points of an entry, flown again with the kit's parts: numbers only, no code of anybody."""
    from falconwing_kit.tools.grading import load_parts

    commands = np.array(json.loads(entry)["commands"], float)
    if commands.ndim != 2 or commands.shape[1] != 4 or not 2 <= len(commands) <= STEPS:
        raise ValueError(f"entry: expected (n, 4) commands, n at most {STEPS}: {commands.shape}")
    step, state, last, states = new_plant(load_parts("kit")), START, np.zeros(4), [START]
    for command in np.clip(np.nan_to_num(commands), [0.0, -1.0, -1.0, -1.0], 1.0):
        state, last = step(state, last, command), command
        states.append(state)
        if state[2] <= FLOOR_Z:
            break
    return float(score(np.array(states))[3])


def second_opinions(parts: Any, flown: Mapping[str, Any]) -> list[str]:
    """What your other labs say about a flight, a line each: labs 1, 2 and 6, 5 and 4, 10, 11."""
    states, K = np.asarray(flown["states"]), lab_given(parts, "lab06").K
    v_min = float(parts.sizing.min_speed(150.0, 20.0))
    _, needed, radius = parts.sizing.level_turn(v_min, math.degrees(BANK_LIMIT))
    lines = [
        f"lab 1: the paper's wing needs {v_min:.1f} m/s straight, {float(needed):.1f} m/s in this "
        f"turn, on a radius of {float(radius):.1f} m",
    ]
    side, height = lab_given(parts, "lab06").MARKER_SIZE / 2.0, 0.75
    corners = [[0.0, y, height + z] for y, z in _square(side)]  # world: y to the left
    lens = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5, "k1": 0.0}
    R_map_world = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    rng, misses = np.random.default_rng(6), []
    for state in states[::4]:
        T = camera_pose(parts, state)
        T_map_camera = np.eye(4)
        T_map_camera[:3] = R_map_world @ T[:3]
        p_camera = parts.camera.map_to_camera(np.array(corners) @ R_map_world.T, T_map_camera)
        pixels = parts.camera.project_points(p_camera, lens)
        if not np.isfinite(pixels).all() or (np.abs(pixels - K[:2, 2]) > K[:2, 2]).any():
            continue  # the marker is not wholly in the picture
        pixels = pixels + rng.normal(0.0, 0.3, (4, 2))  # as a detector finds them
        found = parts.poses.marker_pose(pixels, K, 2.0 * side)
        found = lab_given(parts, "lab06").polish(found, pixels, 2.0 * side)
        p_world = (lab_given(parts, "lab06").T_WORLD_MARKER @ found)[:3, 3]
        misses.append(float(np.linalg.norm(p_world - T[:3, 3])))
    if misses:
        lines.append(
            f"labs 2 and 6: the marker is in {len(misses)} pictures of a 640 x 480 camera; "
            f"the last one places the camera to {100.0 * misses[-1]:.0f} cm"
        )
    t = STEP_S * np.arange(len(states))
    noisy = states[:, 0] + np.random.default_rng(5).normal(0.0, 0.03, len(t))
    slope = np.asarray(parts.identification.local_slope(t, noisy, 4)[0])
    miss = float(np.sqrt(np.nanmean((slope - states[:, 6]) ** 2)))
    lines.append(f"lab 5: speed along x from positions of 3 cm noise: {miss:.2f} m/s rms off")
    if len(states) > FIT_ROWS + AHEAD:
        fitted, guess = forecast_misses(parts, flown)
        lines.append(
            f"labs 5 and 4: your model with numbers fitted to {STEP_S * FIT_ROWS:.1f} s is "
            f"{100.0 * fitted:.0f} cm off {STEP_S * AHEAD:.0f} s later, lab 5's guess "
            f"{100.0 * guess:.0f} cm"
        )
    if flown["frames"] and flown["frames"][0] is not None:
        grey = np.asarray(flown["frames"]).mean(axis=3).astype(np.uint8)
        ssim, alarm = parts.bridge.ssim_monitor(grey, 0.2, 3)
        lines.append(
            f"lab 10: lowest SSIM of two pictures {float(np.min(ssim)):.2f}, "
            f"{int(np.count_nonzero(alarm))} alarms"
        )
    low, high = parts.landings.success_interval(1, 1, 0.95)
    lines.append(f"lab 11: one landing of one shows a success rate of {low:.2f} to {high:.2f}")
    return lines


def forecast_misses(parts: Any, flown: Mapping[str, Any]) -> tuple[float, float]:
    """Your lab 5 identifies the flight's first, straight part, and your lab 4 flies on from there.

    The poses have lab 5's noise and are SIMULATED. Eight numbers of one straight leg are not well
    known, and those of sideways flight are not in lab 5: good for a forecast of the leg, not for a
    whole flight, so the aircraft that flies keeps lab 4's numbers.

    Args:
        parts: yours or the kit's.
        flown: "states" (n + 1, 9) and "commands" (n, 4), n above FIT_ROWS + AHEAD.

    Returns:
        How far the forecast is from the flight after AHEAD steps [m]: with the numbers that
        `multiple_shooting` finds, and with the guess that it begins from.
    """
    lab05, K = lab_given(parts, "lab05"), lab_given(parts, "lab04").K
    states, commands = np.asarray(flown["states"]), np.asarray(flown["commands"])
    leg = states[: FIT_ROWS + 1]
    poses = np.column_stack([leg[0, 0] - leg[:, 0], leg[:, 2], leg[:, 3]])  # it flies to -x
    poses = poses + lab05.SIGMA * np.random.default_rng(4).normal(size=poses.shape)
    before = np.vstack([np.zeros(4), commands])[: FIT_ROWS + 1]
    acting = 0.5 * (before + commands[: FIT_ROWS + 1])[:, [0, 2]]  # mean of a step: it is a ramp
    link = np.array([0.02, 0.02, 0.01, 0.05, 0.05])  # m, m, rad, m/s, m/s
    found, _ = parts.identification.multiple_shooting(poses[None], acting[None], FIT_ROWS, link)
    misses = []
    for numbers in (found, lab05.GUESS):
        step = new_plant(parts, K={**K, **dict(zip(lab05.NAMES, map(float, numbers), strict=True))})
        state = states[FIT_ROWS]
        for k in range(FIT_ROWS, FIT_ROWS + AHEAD):
            state = step(state, commands[k - 1], commands[k])
        misses.append(float(np.linalg.norm(state[:3] - states[FIT_ROWS + AHEAD, :3])))
    return misses[0], misses[1]


def _square(half: float) -> list[tuple[float, float]]:
    """Corners as an approaching camera sees them, from the top left on: y to the left, z up."""
    return [(half, half), (-half, half), (-half, -half), (half, -half)]


def moving_training() -> Any:
    """A film of the first shipped flight, as your policy will see it: 40 x 30 pixels."""
    from falconwing_kit.tools.grading import moving_pictures

    data = load_flights()
    first, last = data["starts"][:2]
    pictures = [each.repeat(8, axis=0).repeat(8, axis=1) for each in data["images"][first:last]]
    words = "A flight along a wall, a turn to the right, and down to a blue pad, in large pixels."
    return moving_pictures(pictures, IMAGE_EVERY * STEP_S, words)
