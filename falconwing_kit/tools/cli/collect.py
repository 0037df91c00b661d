"""falconwing collect: simulated flights by the expert or a policy -> a dataset for training."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from falconwing_kit.tools.cli.show import next_line, print_json, print_table

if TYPE_CHECKING:
    from falconwing_kit.learning.datasets import Dataset

HEADERS = ("flights", "images", "landed or kept the lock", "size [MB]")


@dataclass(frozen=True)
class Collect:
    """Fly many aircraft by the expert, and write what their cameras see as a dataset.

    The expert flies on the true state, with noise on its commands; its own commands, without that
    noise, are the labels. With --weights a policy flies and the expert labels (DAgger). The format
    is LeRobot's v3.0, with images in the Parquet files. The same command goes on where it was
    ended, which costs at most the flights of one file.
    """

    out: Path
    """folder of the dataset"""
    task: Literal["landing", "follow"] = "landing"
    """what is flown"""
    flights: int = 100
    """in all"""
    size: str = "160x120"
    """of the images in pixels"""
    scene: str = "hall"
    """the hall: a name that ships, or a scene file"""
    expert_noise: float = 0.15
    """largest standard deviation of the noise on the commands, as a share of full travel; each
    flight has its own, from none to this
    """
    weights: Path | None = None
    """a policy's file of falconwing train, which flies in place of the expert"""
    nominal: bool = False
    """only the kit's own aircraft in still air, from the usual starts"""
    per_file: int = 32
    """flights in a file"""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """where images are rendered; cuda needs gsplat"""
    workers: int = 0
    """processes that fly; 0: this one"""
    seed: int = 0
    """of everything that is drawn at random"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Fly, and write the dataset.

        Returns:
            0: the dataset is complete.

        Raises:
            FileNotFoundError: there is no such scene, or no such weights.
            InputError: an option is wrong, a library is missing, or the folder holds other files.
        """
        from falconwing_kit.core.checks import InputError, require_range

        limits = {"flights": (1, 1e6), "per_file": (1, 1e4), "expert_noise": (0, 1),
                  "workers": (0, 256), "seed": (0, 99)}  # fmt: skip
        for name, (low, high) in limits.items():
            option = f"--{name.replace('_', '-')}"
            require_range(option, getattr(self, name), low=low, high=high)
        try:
            from falconwing_kit.tools.trials.collect_dataset import collect_dataset
        except ModuleNotFoundError as error:
            raise InputError(
                f"collect: expected {error.name}, which is missing; run: pip install {error.name}"
            ) from None
        dataset = collect_dataset(self)
        record = dataset_summary(dataset)
        if self.json:
            print_json({"simulated": True, **record})
            return 0
        title = f"SIMULATED: flights of the task {self.task}, labelled by the expert"
        print_table(HEADERS, [tuple(record.values())], title=title)
        rounds = "" if self.weights else " --rounds 0"
        size = f" --size {self.size}" * (self.size != "160x120")
        next_line(f"falconwing train --data {self.out}{rounds}{size} --out trained")
        return 0


def dataset_summary(dataset: "Dataset") -> dict[str, float]:
    """Number of flights and images, share that succeeded, and size on the disk."""
    successes = [bool(row["success"]) for row in dataset.episodes]
    data = (path.stat().st_size for path in dataset.folder.rglob("*.parquet"))
    return {
        "flights": len(dataset), "images": dataset.frames,
        "success": sum(successes) / len(successes), "size_mb": round(sum(data) / 1e6, 2),
    }  # fmt: skip
