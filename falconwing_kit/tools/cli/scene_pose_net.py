"""falconwing scene pose-net: a scene and its photos with poses -> a pose network, its errors."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from falconwing_kit.tools.cli.show import next_line, print_json, print_table

PLAN_OPTIONS = ("steps", "minutes", "batch", "fresh", "pool", "first", "rate", "seed")
ROWS = (
    ("renders", "renders"),
    ("worse", "renders, other appearance"),
    ("photos", "held-out photos"),
)
HEADERS = (
    "images",
    "count",
    "position [m]",
    "yaw [deg]",
    "in 68 % (position)",
    "in 68 % (attitude)",
)


@dataclass(frozen=True)
class TrainPoseNet:
    """Train a pose network for a room, calibrate its sigmas and evaluate it on held-out photos.

    With an NVIDIA GPU and gsplat it takes minutes; without, give few --steps and a small --width.
    An interrupted training is resumed by the same command.
    """

    scene: Annotated[Path, tyro.conf.Positional]
    """the trained scene, such as scene.npz of `scene fit`"""
    photos: Annotated[Path, tyro.conf.Positional]
    """the folder that `scene align` wrote, or the folder `corrected` of `scene fit`"""
    out: Path
    """folder for pose_net.safetensors, pose_net.json with the errors, and views.png"""
    images: Path | None = None
    """folder of the photos, if they are not where the reconstruction says"""
    held_out: Path | None = None
    """names of the photos for evaluation, such as the figures.json of `scene fit`"""
    leader: Path | None = None
    """a scene of the leader in its body axes, drawn into some views"""
    vit: Path | None = None
    """pretrained ViT weights (.safetensors) for --stem patch"""
    start: Path | None = None
    """a trained pose_net.safetensors to go on from, of the same shape and --box"""
    box: tuple[float, float, float, float, float, float] | None = None
    """lower and upper corner x y z x y z of the space to fly in [m]; from the scene if not given"""
    antialiased: bool = False
    """the scene was trained with --antialiased"""
    backend: Literal["auto", "gsplat", "fast", "reference"] = "auto"
    """the renderer"""
    stem: Literal["conv", "patch"] = "conv"
    """first layers: convolutions, or the patches of a plain ViT"""
    width: int = 192
    """of the network's images in pixels, a multiple of 16"""
    features: int = 160
    """of a token"""
    layers: int = 5
    """of the transformer"""
    heads: int = 5
    """of its attention; a divisor of the features"""
    photo_share: float = 0.15
    """share of the training views that are copied from photos; 0: renders only"""
    near_share: float = 0.35
    """share of the training views near photos"""
    approach_share: float = 0.0
    """share of the other views low before and above the kit's pad, for pilots that land"""
    steps: int = 1_000_000
    """of training at most"""
    minutes: float = 8.0
    """of training at most"""
    batch: int = 256
    """views in a step"""
    fresh: int = 64
    """new views in a step"""
    pool: int = 40_000
    """views kept for training"""
    first: int = 4096
    """views before the first step"""
    rate: float = 1e-3
    """learning rate"""
    seed: int = 0
    """of everything that is drawn at random"""
    json: bool = False
    """print the errors as JSON"""

    def run(self) -> int:
        """Train and print the errors.

        Returns:
            0: the net is written.

        Raises:
            FileNotFoundError: a file is missing.
            InputError: an option is out of range, the photos cannot be used, or PyTorch or gsplat
                is missing.
        """
        report = self._train(_print_nothing if self.json else _print_line)
        if self.json:
            print_json(report)
            return 0
        print_table(HEADERS, [_row(title, report[key]) for key, title in ROWS])
        next_line(f"falconwing poses FLIGHT --network {self.out / 'pose_net.safetensors'}")
        return 0

    def _train(self, report_line: Callable[[str], None]) -> dict[str, Any]:
        from falconwing_kit.learning.pose_net_loop import TrainSchedule
        from falconwing_kit.tools.capture.pose_net_training import PoseNetConfig, train_pose_net

        options = {name: value for name, value in vars(self).items() if name != "json"}
        plan = TrainSchedule(**{name: options.pop(name) for name in PLAN_OPTIONS})
        job = PoseNetConfig(plan=plan, **(options | {"box": self.box or ()}))
        return train_pose_net(job, report_line)


def _print_line(line: str) -> None:
    print(line, flush=True)


def _print_nothing(line: str) -> None:
    pass


def _row(title: str, errors: dict[str, Any]) -> tuple[object, ...]:
    """A line of the table: medians, and shares in the stated 68 % ellipsoids."""
    return (
        title,
        errors["images"],
        errors["position_m"]["median"],
        errors["yaw_deg"]["median"],
        errors["position_in_stated"]["68%"],
        errors["attitude_in_stated"]["68%"],
    )
