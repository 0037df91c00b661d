"""Lab 9, given: your course's numbers, simulated views, random draws, a small U-Net, plots.

torch is imported only where it is needed, so that the exercises without it stay quick.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
COHORT: dict[str, float] = json.loads((HERE / "cohort.json").read_text(encoding="utf-8"))
POS_WEIGHT = COHORT[
    "pos_weight"
]  # how much more a pixel of the leader counts than one of the hall [-]
DICE_WEIGHT = COHORT["dice_weight"]  # of the overlap's part of the loss [-]

FOCAL_PX = 0.62 * 64  # focal length of the follower's lens for pictures 64 pixels wide [px]
CENTRE_BODY = np.array([-0.072, 0.0, -0.006])  # middle of the leader's box, in its body axes [m]
HALF_AXES = np.array(
    [0.272, 0.349, 0.113]
)  # from there to nose and tail, wing tips, top and bottom [m]
NEVER = np.full((48, 64), np.inf)  # depth of a hall in which nothing hides the leader [m]
MIN_PIXELS = 6  # fewer do not count as an aircraft [px]
GAMMA = 2.2  # light is the 2.2th power of a screen's numbers

BLUE, ORANGE, GREEN, PINK = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
)  # distinct for colour-blind eyes as well

Array = np.ndarray


def load_views(kind: str) -> dict[str, Array]:
    """SIMULATED views from the follower's camera.

    Args:
        kind: "train", "seen": along the runway and to the wall with the posters. "unseen": towards
            the windows. "empty": towards the windows, without a leader. "hidden": one view, a part
            of the leader behind a board.

    Returns:
        "images" (n, 48, 64, 3) uint8; "poses" (n, 4, 4), T_camera_body of the leader, camera axes x
        right, y down, z forward; "masks" (n, 48, 64) bool, exact, rendered; with "hidden" also
        "depth" (n, 48, 64) of the hall [m].
    """
    with np.load(HERE / "data" / "views.npz", allow_pickle=False) as file:
        return {
            name.removeprefix(f"{kind}_"): file[name]
            for name in file.files
            if name.startswith(f"{kind}_")
        }


def fly_kit_pilot(name: str) -> str:
    """One SIMULATED flight of a shipped pilot behind the leader through a climbing right S.

    Args:
        name: "rgb", "mask" or "rgb_mask"; it sees images of 320x240 and knows its past commands.

    Returns:
        What it came to, in words.
    """
    from falconwing_kit.flight import FollowTask, fpv_camera, load_pilot
    from falconwing_kit.scene import load_scene
    from falconwing_kit.tools.trials import TrialSettings, fly_trials

    camera = fpv_camera(320, 240)
    pilot = load_pilot(name, "follow", "hall", camera)

    def fresh(trial: object) -> Any:
        pilot.reset()
        return pilot

    setting = TrialSettings(scene=load_scene("hall"), camera=camera, scene_name="hall")
    (flown,) = fly_trials(FollowTask("right_turn_s_ascent"), fresh, 1, pilot=name, setting=setting)
    if not flown["success"]:
        return f"{name}: lost the leader after {flown['lost_at_s']:.1f} s"
    kept, off = 100.0 * flown["locked_share"], 100.0 * flown["ate_m"]
    return f"{name}: kept it in view for {kept:.0f} % of the time, {off:.0f} cm off on average"


def look_alike(rng: np.random.Generator) -> Array:
    """A distractor: a bright panel with bars, of random size and colours (h, w, 3), 0..255."""
    height, width = rng.integers(5, 22), rng.integers(5, 26)
    panel = rng.integers(130, 256) + rng.integers(-25, 26, 3)
    bars = rng.integers(0, 256) + rng.integers(-25, 26, 3)
    row, column = np.indices((height, width))
    barred = (row % rng.integers(3, 9) == 0) | (column % rng.integers(3, 9) == 0)
    colours = np.where(barred[:, :, None], bars, panel) + rng.normal(0.0, 12.0, (height, width, 1))
    return np.clip(colours, 0.0, 255.0)


def draw(rng: np.random.Generator, look_alike_only: bool = False) -> dict[str, Any]:
    """Random numbers for one call of `randomize`, by the names of its arguments.

    Or only another look-alike.
    """
    changes = {"tint": np.ones(3), "brightness": 1.0, "salt": 0.0}
    if not look_alike_only:
        changes = {
            "tint": rng.uniform(0.8, 1.1, 3),
            "brightness": rng.uniform(0.8, 1.25),
            "salt": rng.uniform(0.0, 0.08),
        }
    corner = (int(rng.integers(0, 44)), int(rng.integers(0, 60)))
    return {**changes, "draws": rng.random((48, 64)), "patch": look_alike(rng), "corner": corner}


def new_unet(base: int = 6, seed: int = 0) -> Any:
    """A small U-Net: pictures (n, 3, H, W) in -1..1 -> logits (n, H, W).

    H and W are multiples of 4.

    Args:
        base: channels at full size; twice and four times as many at half and quarter size. It can
            grow.
        seed: of the weights to start from.
    """
    import torch
    from torch import nn

    torch.manual_seed(seed)
    torch.set_num_threads(1)

    def double(before: int, after: int) -> nn.Module:
        first, second = (
            nn.Conv2d(before, after, 3, padding=1),
            nn.Conv2d(after, after, 3, padding=1),
        )
        return nn.Sequential(first, nn.ReLU(), second, nn.ReLU())

    class UNet(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.in_full, self.in_half, self.in_quarter = (
                double(3, base),
                double(base, 2 * base),
                double(2 * base, 4 * base),
            )
            self.out_half, self.out_full = double(6 * base, 2 * base), double(3 * base, base)
            self.down, self.up, self.last = (
                nn.MaxPool2d(2),
                nn.Upsample(scale_factor=2),
                nn.Conv2d(base, 1, 1),
            )

        def forward(self, images: Any) -> Any:
            full = self.in_full(images)
            half = self.in_half(self.down(full))
            quarter = self.in_quarter(self.down(half))
            half = self.out_half(torch.cat([self.up(quarter), half], dim=1))
            return self.last(self.out_full(torch.cat([self.up(half), full], dim=1)))[:, 0]

    return UNet()


def to_tensor(images: Array) -> Any:
    """Pictures (n, H, W, 3) uint8 as network input: (n, 3, H, W) in -1..1."""
    import torch

    return torch.tensor(np.asarray(images, np.float32).transpose(0, 3, 1, 2) / 127.5 - 1.0)


def probabilities(network: Any, images: Array) -> Array:
    """A network's probability of each pixel (n, H, W), 0..1."""
    import torch

    with torch.no_grad():
        return torch.sigmoid(network(to_tensor(images))).numpy()


def run_mask_loss(function: Callable[..., Any], logits: Array, truth: Array) -> dict[str, Any]:
    """Calls `mask_loss` and takes its gradient.

    Args:
        function: mask_loss.
        logits: (n, H, W).
        truth: (n, H, W), 0 or 1.

    Returns:
        "loss", a number; "gradient" (n, H, W), of the loss by each logit.
    """
    import torch

    torch.set_num_threads(1)
    at = torch.tensor(np.asarray(logits, float), requires_grad=True)
    loss = function(at, torch.tensor(np.asarray(truth, float)))
    loss.backward()
    return {"loss": float(loss.detach()), "gradient": at.grad.numpy().copy()}


def plot_labels(
    views: Mapping[str, Array], made: Array, title: str, frames: tuple[int, ...] = (0, 1, 2, 3, 4)
) -> None:
    """Pictures with the outline of the made masks (solid) and of the exact ones (dashed)."""
    import matplotlib.pyplot as plt

    _, row = plt.subplots(1, len(frames), figsize=(11.0, 2.2), layout="constrained", squeeze=False)
    for axes, frame in zip(row[0], frames, strict=True):
        axes.imshow(views["images"][frame])
        axes.contour(
            views["masks"][frame], levels=[0.5], colors=ORANGE, linestyles="--", linewidths=1.2
        )
        if made[frame].any():
            axes.contour(made[frame], levels=[0.5], colors=BLUE, linewidths=1.5)
        axes.axis("off")
    row[0, 0].set_title(f"{title}  (blue: yours, orange dashed: exact)", fontsize=9, loc="left")


def plot_randomised(pictures: list[Array]) -> None:
    """Randomised pictures in a row."""
    import matplotlib.pyplot as plt

    _, row = plt.subplots(1, len(pictures), figsize=(11.0, 1.6), layout="constrained")
    for axes, picture in zip(row, pictures, strict=True):
        axes.imshow(picture)
        axes.axis("off")


def plot_window(
    said: Mapping[str, Mapping[str, Array]], frames: tuple[int, ...] = (0, 1, 2, 3)
) -> None:
    """A row of pictures for each network, four with and four without a leader, with its masks."""
    import matplotlib.pyplot as plt

    if not said:
        print("No network yet: run the two cells that train them.")
        return
    views = {kind: load_views(kind)["images"] for kind in ("unseen", "empty")}
    columns = [(kind, frame) for kind in views for frame in frames]
    _, grid = plt.subplots(
        len(said),
        len(columns),
        squeeze=False,
        figsize=(11.0, 1.05 * len(said) + 0.3),
        layout="constrained",
    )
    for row, (name, kinds) in zip(grid, said.items(), strict=True):
        for axes, (kind, frame) in zip(row, columns, strict=True):
            axes.imshow(views[kind][frame])
            if (kinds[kind][frame] > 0.5).any():
                axes.contour(kinds[kind][frame], levels=[0.5], colors=PINK, linewidths=1.5)
            axes.set(xticks=[], yticks=[])
        row[0].set_ylabel(name, fontsize=8)
    grid[0, 0].set_title("with a leader", fontsize=9, loc="left")
    grid[0, len(frames)].set_title("no leader", fontsize=9, loc="left")


def moving_leader() -> Any:
    """A film of training views, from the farthest leader to the nearest, with the exact outline."""
    from matplotlib.figure import Figure

    from falconwing_kit.tools.grading import moving_figure

    views = load_views("train")
    distance = np.linalg.norm(views["poses"][:, :3, 3].astype(float), axis=1)
    order = np.argsort(-distance)[::5]
    figure = Figure(figsize=(8.4, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    shown = left.imshow(views["images"][0])
    marked = right.imshow(views["masks"][0], cmap="gray", vmin=0, vmax=1)
    for ax in (left, right):
        ax.axis("off")
    left.set_title("what the follower sees (simulated)", fontsize=9)

    def draw(number: int) -> None:
        view = order[number]
        shown.set_data(views["images"][view])
        marked.set_data(views["masks"][view])
        share = 100.0 * views["masks"][view].mean()
        right.set_title(
            f"the leader alone, {distance[view]:.1f} m away: {share:.1f} % of the pixels",
            fontsize=9,
        )

    words = "Views of a hall with a white aircraft ahead, and beside each its mask, white on black."
    return moving_figure(figure, draw, len(order), 0.25, words)
