"""falconwing train: an expert and a hall -> the weights of a pilot that flies by images."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from falconwing_kit.tools.cli.show import next_line, print_json, print_table

CURVE, RECORD = "curve.png", "training.json"  # in --out
PILOTS = ("student", "rgb", "mask", "rgb_mask")
STATE = "state.safetensors"  # of an interrupted training
HEADERS = ("round", "time [s]", "flights", "images", "steps", "loss", "success")


@dataclass(frozen=True)
class Train:
    """Train a policy by imitation of the expert (DAgger), on simulated flights of many aircraft.

    With an NVIDIA GPU and gsplat the landing pilot that ships took three hours, in parts. Without a
    GPU take a small --size, few --flights and a scene of few Gaussians; that is enough to see it
    learn, not to land. An interrupted training is resumed by the same command.
    """

    out: Path
    """folder for the weights (policy.safetensors, or one of each pilot), training.json and
    curve.png"""
    task: Literal["landing", "follow"] = "landing"
    """what the policy does"""
    pilot: str = "student"
    """what it sees: rgb or student: the image's colours; rgb_mask: the leader's mask beside them,
    found in the image; mask: that alone; several separated by commas share flights"""
    memory: bool = True
    """whether the network has a memory; without one it reads the past 30 commands, as in the
    paper"""
    scene: str = "hall"
    """the hall: a name that ships, or a scene file"""
    size: str = "160x120"
    """of the network's images in pixels"""
    minutes: float = 8.0
    """of training"""
    flights: int = 512
    """in each round"""
    rounds: int = 40
    """of flying and learning, at most; 0 with --data alone"""
    batch: int = 48
    """flights in a training step"""
    rate: float = 1.5e-3
    """learning rate"""
    data: tuple[Path, ...] = ()
    """datasets of falconwing collect, learned from before the rounds; with --rounds 0 instead"""
    steps: int = 0
    """of training on --data; 0: by the time, all of --minutes or half of it before the rounds"""
    start: tuple[Path, ...] = ()
    """weights to begin from, a file for each pilot; the pilots fly from the first round on"""
    nominal: bool = False
    """only the kit's own aircraft in still air, from the usual starts"""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """where the network is trained; cuda needs gsplat too"""
    workers: int = 0
    """processes that fly; 0: this one"""
    seed: int = 0
    """of everything that is drawn at random; evaluations use others"""
    json: bool = False
    """print the rounds as JSON"""

    def run(self) -> int:
        """Train, print the rounds and write the weights.

        Returns:
            0: the weights are written.

        Raises:
            FileNotFoundError: there is no such scene.
            InputError: an option is wrong, or PyTorch is missing.
        """
        from falconwing_kit.core.checks import InputError, require_range

        for name in self.pilots:
            if name not in PILOTS or (self.task == "landing" and "mask" in name):
                known = PILOTS if self.task == "follow" else PILOTS[:2]
                raise InputError(
                    f"--pilot: expected {' or '.join(known)} for {self.task}, got {name!r}"
                )
        if {"student", "rgb"} <= set(self.pilots):
            raise InputError("--pilot: expected student or rgb, got both, which are one network")
        if self.start and len(self.start) != len(self.pilots):
            raise InputError(
                f"--start: expected {len(self.pilots)} files, one for each pilot, got"
                f" {len(self.start)}"
            )
        least = 0 if self.data else 1
        limits = {"minutes": (0.01, 1e4), "flights": (2, 1e5), "rounds": (least, 1e4),
                  "batch": (1, 1e4), "steps": (0, 1e7), "workers": (0, 256),
                  "seed": (0, 99)}  # fmt: skip
        for name, (low, high) in limits.items():
            require_range(f"--{name}", getattr(self, name), low=low, high=high)
        try:
            import torch

            from falconwing_kit.tools.trials.train_policy import train_policy
        except ModuleNotFoundError as error:
            raise InputError(
                f"train: expected {error.name}, which is missing; run: pip install {error.name}"
            ) from None
        device = self.device
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        elif device == "cuda" and not torch.cuda.is_available():
            raise InputError("--device: expected a GPU for cuda, got none; use --device cpu")
        try:
            rounds = train_policy(self, device)
        except torch.cuda.OutOfMemoryError:
            raise InputError(
                f"--batch: expected a batch that fits in the GPU's memory, got {self.batch}; use"
                " half of it, or a smaller --size"
            ) from None
        if self.json:
            print_json({"settings": settings_record(self), "rounds": rounds})
            return 0
        rows = [[r[key] for key in ("round", "s", "flights", "images", "steps", "loss", "success")]
                for r in rounds]  # fmt: skip
        print_table(HEADERS, rows, title=f"SIMULATED: {self.task} by {self.pilot}, imitated")
        weights = self.out / self.weights(self.pilots[0])
        next_line(f"falconwing fly --task {self.task} --pilot {self.pilots[0]} --weights {weights}")
        return 0

    @property
    def pilots(self) -> tuple[str, ...]:
        """The names in --pilot, each once."""
        return tuple(dict.fromkeys(self.pilot.split(",")))

    def weights(self, name: str) -> str:
        """Name of a pilot's file in --out."""
        return "policy.safetensors" if len(self.pilots) == 1 else f"policy_{name}.safetensors"


def settings_record(train: Train) -> dict[str, Any]:
    """The options as they go to training.json."""
    return asdict(train) | {
        "out": train.out.name,
        "data": [path.name for path in train.data],
        "start": [path.name for path in train.start],
    }
