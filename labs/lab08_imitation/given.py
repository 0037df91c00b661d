"""Lab 8, given: your course's numbers, a simulated approach, its expert, data, network, plots.

torch is imported only where it is needed, so that the exercises without it stay quick.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
COHORT: dict[str, float] = json.loads((HERE / "cohort.json").read_text(encoding="utf-8"))
TURN_WEIGHT = COHORT[
    "turn_weight"
]  # how much more a full turn counts in the loss than flying straight [-]
CLIP_NORM = COHORT["clip_norm"]  # longest gradient that a step may use [-]

HISTORY = 10  # past commands that the network sees: half a second
SPEED, STEP_S, GRAVITY = 7.0, 0.05, 9.81  # [m/s], [s], [m/s^2]
BANK, LAG_S = math.radians(35.0), 0.25  # roll at full aileron [rad], and how slowly it comes [s]
START_X, TOUCH_X, CENTRE_Y = (
    -17.0,
    4.5,
    -2.0,
)  # where the approach begins and ends, and the pad's centre line [m]
PAD_HALF = 1.0  # half the pad's width [m]
LOST_M, LOST_YAW = 6.0, 1.2  # farther off, or turned farther, and the flight is lost [m], [rad]
GUST = 0.3  # size of the test flights' gusts, in full ailerons

BLUE, ORANGE, GREEN, PINK = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
)  # distinct for colour-blind eyes as well
STYLES = {"expert": (GREEN, ":"), "clean": (ORANGE, "--"), "noisy": (BLUE, "-")}

Array = np.ndarray


class Flight:
    """SIMULATED: one approach at constant speed down a straight glide.

    The pilot has the aileron only.

    Args:
        offset: from the centre line at the start, positive left of it [m].
        yaw: of the nose at the start, positive right of the runway [rad].
        wind: from the right, so that it blows the aircraft to the left [m/s].
        seed: of the gusts; negative for none.
        look: renders the picture of a flight; None for a flight without pictures.
    """

    def __init__(
        self,
        offset: float,
        yaw: float,
        wind: float,
        seed: float,
        look: Callable[["Flight"], Array] | None = None,
    ) -> None:
        self.x, self.offset, self.yaw, self.roll, self.wind = (
            START_X,
            float(offset),
            float(yaw),
            0.0,
            float(wind),
        )
        self._look, self._gust, self._draws = (
            look,
            0.0,
            np.random.default_rng(int(seed)) if seed >= 0 else None,
        )

    @property
    def lost(self) -> bool:
        """Too far off, or turned away."""
        return abs(self.offset) > LOST_M or abs(self.yaw) > LOST_YAW

    @property
    def over(self) -> bool:
        """At the touchdown point, or lost."""
        return self.x >= TOUCH_X or self.lost

    @property
    def height(self) -> float:
        """Of the camera above the floor [m]: 4 degrees down to the pad."""
        return 0.25 + math.tan(math.radians(4.0)) * (TOUCH_X - self.x)

    def look(self) -> Array:
        """The picture from the nose, now."""
        if self._look is None:
            return np.array([[self.offset, self.yaw, self.roll]])
        return self._look(self)

    def fly(self, aileron: float) -> None:
        """One step of 0.05 s. The servo goes from -1 to 1; positive is right wing down."""
        if self._draws is not None:
            self._gust = 0.9 * self._gust + math.sqrt(0.19) * GUST * self._draws.normal()
        commanded = BANK * min(max(min(max(aileron, -1.0), 1.0) + self._gust, -1.0), 1.0)
        self.roll += STEP_S / LAG_S * (commanded - self.roll)
        self.yaw += STEP_S * GRAVITY / SPEED * math.tan(self.roll)  # level turn
        self.x += STEP_S * SPEED * math.cos(self.yaw)
        self.offset += STEP_S * (self.wind - SPEED * math.sin(self.yaw))


def expert(flight: Flight, parts: Any = None) -> float:
    """Aileron of a pilot with access to the state: a roll proportional to the commanded turn.

    Args:
        flight: to be flown.
        parts: whose lab 7 leads to the pad's centre line; None for the lines below.
    """
    if parts is not None:
        p = np.array([flight.x, CENTRE_Y + flight.offset])
        v = SPEED * np.array([math.cos(flight.yaw), -math.sin(flight.yaw)]) + [0.0, flight.wind]
        line = np.array([[START_X, CENTRE_Y], [TOUCH_X, CENTRE_Y]])
        return float(parts.expert.guidance(p, v, *line, BANK)) / BANK
    commanded_yaw = min(max(0.25 * flight.offset, -0.35), 0.35)
    roll = 1.8 * (commanded_yaw - flight.yaw) * SPEED / GRAVITY
    return min(max(roll / BANK, -1.0), 1.0)


def load_flights(kind: str) -> dict[str, Array]:
    """SIMULATED flights of the expert.

    Args:
        kind: "clean": the expert flew undisturbed. "noisy": noise was added to its command.
            "held_out": clean, not for training.

    Returns:
        "images" (n, 30, 40, 3) uint8; "flown" (n,) aileron that the aircraft got; "expert" (n,)
        aileron that the expert commanded; "offset" (n,) [m]; "starts" (flights,) number of each
        flight's first frame.
    """
    with np.load(HERE / "data" / "flights.npz", allow_pickle=False) as file:
        return {
            name: file[f"{kind}_{name}"]
            for name in ("images", "flown", "expert", "offset", "starts")
        }


def test_starts(flights: int = 20, seed: int = 99) -> Array:
    """Starts of test flights (flights, 4): offset [m], yaw [rad], wind [m/s] and the gusts' seed.

    New to everybody.
    """
    rng = np.random.default_rng(seed)
    low, high = np.array([-1.0, -0.08, -0.3]), np.array([1.0, 0.08, 0.3])
    return np.column_stack([rng.uniform(low, high, (flights, 3)), np.arange(flights)])


def camera_view(scene: Any) -> Callable[[Flight], Array]:
    """Pictures (30, 40, 3) uint8 from the nose of a flight in a scene, by the kit's renderer."""
    from falconwing_kit.core import camera_pose, pose_matrix, rotation_world_body
    from falconwing_kit.flight import fpv_camera
    from falconwing_kit.scene import render

    camera = fpv_camera(40, 30)

    def look(flight: Flight) -> Array:
        p_world = np.array([flight.x, CENTRE_Y + flight.offset, flight.height])
        T_world_body = pose_matrix(rotation_world_body(flight.roll, -0.07, flight.yaw), p_world)
        return np.asarray(
            255.0 * render(scene, camera, camera_pose(T_world_body, np.zeros(3))).rgb + 0.5,
            np.uint8,
        )

    return look


def own_view(parts: Any, scene: Any) -> Callable[[Flight], Array]:
    """Pictures as of `camera_view`, drawn by your lab 3.

    Args:
        parts: yours or the kit's.
        scene: a scene of the kit.
    """
    from falconwing_kit.core import camera_pose, pose_matrix, rotation_world_body
    from falconwing_kit.flight import fpv_camera

    camera, renderer = fpv_camera(40, 30), parts.renderer
    lens = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")}
    quaternions = scene.quaternions.astype(float)[:, [1, 2, 3, 0]]
    covs = renderer.cov3d_from_scale_quat(np.log(scene.scales.astype(float)), quaternions)
    colours = np.clip(0.5 + 0.28209479 * scene.sh[:, 0].astype(float), 0.0, 1.0)
    v, u = np.mgrid[:30, :40] + 0.5
    tiles = [(slice(a, a + 5), slice(b, b + 5)) for a in range(0, 30, 5) for b in range(0, 40, 5)]

    def look(flight: Flight) -> Array:
        p_world = np.array([flight.x, CENTRE_Y + flight.offset, flight.height])
        T_world_body = pose_matrix(rotation_world_body(flight.roll, -0.07, flight.yaw), p_world)
        T = camera_pose(T_world_body, np.zeros(3)) @ np.diag([1.0, -1.0, -1.0, 1.0])
        x, y, z = means = ((scene.means - T[:3, 3]) @ T[:3, :3]).T  # right, up, backwards
        seen = (z < -0.3) & (np.abs(x) < -1.3 * z) & (np.abs(y) < -1.1 * z)
        turned = T[:3, :3].T @ covs[seen] @ T[:3, :3]
        means_px, covs_px = renderer.project_gaussians(means.T[seen], turned, lens, 0.3)
        reach = 3.3 * np.sqrt(np.diagonal(covs_px, axis1=1, axis2=2))  # of each splat's box [px]
        low, high, ahead = means_px - reach, means_px + reach, -z[seen]
        image = np.zeros((30, 40, 3))
        for rows, columns in tiles:
            near = (high > [columns.start, rows.start]) & (low < [columns.stop, rows.stop])
            touched = np.flatnonzero(near.all(axis=1))
            pixels = np.stack([u[rows, columns], v[rows, columns]], axis=-1).reshape(-1, 2)
            mine = (means_px[touched], covs_px[touched], scene.opacities[seen][touched])
            alphas = renderer.splat_alphas(pixels, *mine)
            rgb, _ = renderer.alpha_composite(
                alphas, colours[seen][touched], ahead[touched], np.zeros(3)
            )
            image[rows, columns] = rgb.reshape(5, 5, 3)
        return np.asarray(255.0 * np.clip(image, 0.0, 1.0) + 0.5, np.uint8)

    return look


def new_network(
    channels: Sequence[int] = (8, 16, 16), hidden: int = 32, history: int = HISTORY, seed: int = 0
) -> Any:
    """A network for pictures and past commands: (n, 3, 30, 40), (n, history) -> (n,) aileron.

    Args:
        channels: of the convolutions, each of which halves the picture.
        hidden: units of the layer behind them.
        history: past commands.
        seed: of the weights to start from.
    """
    import torch
    from torch import nn

    torch.manual_seed(seed)
    torch.set_num_threads(1)
    layers: list[nn.Module] = []
    height, width = 30, 40
    for before, after in zip((3, *channels[:-1]), channels, strict=True):
        layers += [nn.Conv2d(before, after, 3, stride=2, padding=1), nn.ReLU()]
        height, width = (height + 1) // 2, (width + 1) // 2
    eye = nn.Sequential(*layers, nn.Flatten())
    head = nn.Sequential(
        nn.Linear(channels[-1] * height * width + history, hidden), nn.ReLU(), nn.Linear(hidden, 1)
    )
    return _TwoInputs(eye, head)


def _TwoInputs(eye: Any, head: Any) -> Any:
    """A module of two arguments: image features and history are concatenated for the head."""
    import torch

    class TwoInputs(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.eye, self.head = eye, head

        def forward(self, images: Any, history: Any) -> Any:
            return self.head(torch.cat([self.eye(images), history], dim=1))[:, 0]

    return TwoInputs()


def run_bc_steps(
    function: Callable[..., Any],
    weights: list[Array],
    images: Array,
    history: Array,
    labels: Array,
    rate: float,
) -> dict[str, Any]:
    """Calls `bc_loss_step` on a tiny network, once per batch, with plain gradient descent.

    Args:
        function: bc_loss_step.
        weights: [(hidden, pixels + k), (hidden,), (1, hidden), (1,)] of two layers with a tanh
            between.
        images: (steps, n, 3, H, W).
        history: (steps, n, k).
        labels: (steps, n).
        rate: of the descent.

    Returns:
        "losses" (steps,), what the function returned; "weights", a list of the arrays afterwards.
    """
    import torch

    torch.set_num_threads(1)
    hidden, inputs = weights[0].shape
    head = torch.nn.Sequential(
        torch.nn.Linear(inputs, hidden), torch.nn.Tanh(), torch.nn.Linear(hidden, 1)
    ).double()
    with torch.no_grad():
        for parameter, values in zip(head.parameters(), weights, strict=True):
            parameter.copy_(torch.tensor(np.asarray(values, float)))
    network = _TwoInputs(torch.nn.Flatten(), head)
    optimiser = torch.optim.SGD(network.parameters(), lr=rate)
    losses = []
    for batch in zip(images, history, labels, strict=True):
        losses.append(
            float(
                function(
                    network, optimiser, *(torch.tensor(np.asarray(each, float)) for each in batch)
                )
            )
        )
    return {
        "losses": np.array(losses),
        "weights": [each.detach().numpy().copy() for each in head.parameters()],
    }


def run_closed_loop(
    function: Callable[..., Any], gains: Array, memory: Array, starts: Array
) -> Mapping[str, Any]:
    """Calls `closed_loop_eval` with a linear policy and without pictures.

    Args:
        function: closed_loop_eval.
        gains: (3,) aileron for offset, yaw and roll.
        memory: (k,) aileron for each past command, the newest first.
        starts: (flights, 4) as `test_starts` gives them.
    """

    def policy(image: Array, history: Array) -> float:
        return float(gains @ np.asarray(image)[0] + memory @ np.asarray(history))

    return function(policy, lambda start: Flight(*start), starts, len(memory))


def plot_flights(data: Mapping[str, Array], title: str) -> None:
    """Eight pictures along the first flight, and the tracks of all."""
    import matplotlib.pyplot as plt

    first, last = data["starts"][:2]
    figure = plt.figure(figsize=(11.0, 3.4), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(1, 1.5))
    for axes, frame in zip(
        above.subplots(1, 8), np.linspace(first, last - 1, 8).astype(int), strict=True
    ):
        axes.imshow(data["images"][frame])
        axes.set_title(f"{STEP_S * (frame - first):.1f} s", fontsize=8)
        axes.axis("off")
    axes = below.subplots()
    for a, b in zip(data["starts"], [*data["starts"][1:], len(data["offset"])], strict=True):
        axes.plot(STEP_S * np.arange(b - a), data["offset"][a:b], lw=1.0, color=BLUE)
    axes.axhspan(-PAD_HALF, PAD_HALF, color="0.9")
    axes.set(xlabel="time [s]", ylabel="offset [m]", title=title, ylim=(-2.0, 2.0))


def plot_losses(losses: Mapping[str, tuple[list[float], list[float]]]) -> None:
    """For each pilot, the loss after every epoch on its own flights and on the held-out ones."""
    import matplotlib.pyplot as plt

    _, axes = plt.subplots(figsize=(7.0, 3.4), layout="constrained")
    for name, (own, held_out) in losses.items():
        colour, line = STYLES[name]
        axes.plot(
            range(1, len(own) + 1), own, color=colour, lw=0.8, ls=line, label=f"{name}: own flights"
        )
        axes.plot(
            range(1, len(own) + 1),
            held_out,
            color=colour,
            lw=2.2,
            ls=line,
            label=f"{name}: held-out clean flights",
        )
    axes.set(
        xlabel="epoch [-]",
        ylabel="loss [-]",
        yscale="log",
        title="Open loop: how well the expert is copied",
    )
    axes.legend(fontsize=8)


def plot_drift(tracks: Mapping[str, list[Array]], results: Mapping[str, Mapping[str, Any]]) -> None:
    """Tracks of the test flights, one panel for each pilot."""
    import matplotlib.pyplot as plt

    _, row = plt.subplots(
        1, len(tracks), figsize=(11.0, 3.4), sharex=True, sharey=True, layout="constrained"
    )
    for axes, (name, flights) in zip(np.atleast_1d(row), tracks.items(), strict=True):
        axes.add_patch(plt.Rectangle((1.0, -PAD_HALF), 13.0, 2 * PAD_HALF, color="0.85"))
        for track, landed in zip(flights, results[name]["landed"], strict=True):
            axes.plot(track[:, 0], track[:, 1], color=STYLES[name][0], ls=STYLES[name][1], lw=1.0)
            axes.plot(*track[-1], "ko" if landed else "kx", ms=4)
        count = int(np.sum(results[name]["landed"]))
        axes.set(
            title=f"{name}: {count} of {len(flights)} land",
            xlabel="along the runway [m]",
            ylim=(-6.5, 6.5),
        )
    np.atleast_1d(row)[0].set_ylabel("right of the line  -  offset [m]  -  left")


def moving_flight(kind: str, number: int = 0) -> Any:
    """A film of one shipped flight: the picture, the offset, and the expert's aileron.

    Args:
        kind: as for `load_flights`.
        number: of the flight.
    """
    from matplotlib.figure import Figure

    from falconwing_kit.tools.grading import moving_figure

    data = load_flights(kind)
    first, last = (*data["starts"], len(data["offset"]))[number : number + 2]
    rows = slice(first, last)
    t = STEP_S * np.arange(last - first)
    figure = Figure(figsize=(8.4, 3.2), layout="constrained")
    picture, right = figure.subfigures(1, 2)
    eye = picture.subplots()
    shown = eye.imshow(data["images"][first])
    eye.axis("off")
    place, stick = right.subplots(2, 1, sharex=True)
    place.axhspan(-PAD_HALF, PAD_HALF, color="0.9")
    line = place.plot([], [], color=BLUE)[0]
    flown = stick.plot([], [], color=ORANGE, ls="--", label="flown")[0]
    own = stick.plot([], [], color=GREEN, label="expert")[0]
    place.set(ylabel="offset [m]", ylim=(-1.5, 1.5), xlim=(0.0, t[-1]))
    stick.set(ylabel="aileron [-]", ylim=(-1.05, 1.05), xlabel="time [s]")
    stick.legend(fontsize=7, loc="lower right")

    def draw(frame: int) -> None:
        shown.set_data(data["images"][first + frame])
        eye.set_title(f"what the network sees, {t[frame]:.1f} s (simulated)", fontsize=9)
        for curve, name in ((line, "offset"), (flown, "flown"), (own, "expert")):
            curve.set_data(t[: frame + 1], data[name][rows][: frame + 1])

    words = "A landing through 40 x 30 pixels; the blue pad grows while the offset goes to zero."
    return moving_figure(figure, draw, last - first, STEP_S, words)
