"""Training state: initial points -> parameters and Adam's moments, kept in a checkpoint file."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.files import atomic_write, short_name
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.ply import SH_C0
from falconwing_kit.scene.reference import GaussianTensors

# one row per Gaussian
GAUSSIAN_PARAMETERS = ("means", "quaternions", "log_scales", "logits", "dc", "rest")
# one row per photo: log gains and offsets of red, green, blue; rotation [rad], translation
# [extents]
PHOTO_PARAMETERS = ("exposures", "twists")
INITIAL_OPACITY, INITIAL_SCALE = 0.5, 0.3  # scale in mean distances to the neighbours
BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15  # Adam's, as in 3D Gaussian Splatting
CHUNK = 1024


@dataclass
class TrainState:
    """Everything that a training changes, so that it can be resumed."""

    values: dict[str, Tensor]  # GAUSSIAN and PHOTO by name
    first: dict[str, Tensor]  # Adam's mean of the gradients
    second: dict[str, Tensor]  # and of their squares
    step: int = 0
    seconds: float = 0.0  # spent so far

    def gaussians(self, sh_degree: int) -> GaussianTensors:
        """The Gaussians as renderer input, with colours up to a SH degree."""
        values, count = self.values, (sh_degree + 1) ** 2
        sh = torch.cat([values["dc"][:, None], values["rest"][:, : count - 1]], dim=1)
        opacities = torch.sigmoid(values["logits"])
        return GaussianTensors(
            values["means"], values["quaternions"], values["log_scales"].exp(), opacities, sh
        )

    def adam(self, gradients: dict[str, Tensor | None], rates: dict[str, float]) -> None:
        """One step of Adam [Kingma & Ba 2015, algorithm 1], in place.

        Args:
            gradients: by name; None where a parameter did not affect the loss.
            rates: learning rates by name.
        """
        steps = self.step + 1
        bias_correction = math.sqrt(1.0 - BETA2**steps) / (1.0 - BETA1**steps)
        for name, gradient in gradients.items():
            if gradient is None:
                continue
            first = self.first[name].lerp_(gradient, 1.0 - BETA1)
            second = self.second[name].mul_(BETA2).addcmul_(gradient, gradient, value=1.0 - BETA2)
            self.values[name].addcdiv_(
                first, second.sqrt().add_(EPSILON), value=-rates[name] * bias_correction
            )

    def save(self, path: Path, settings: str) -> None:
        """Write a checkpoint, complete or not at all.

        Args:
            path: an .npz.
            settings: of the training as text; only a training with the same text may resume.
        """
        sets = {"values": self.values, "first": self.first, "second": self.second}
        arrays = {
            f"{kind} {name}": t.cpu().numpy()
            for kind, tensors in sets.items()
            for name, t in tensors.items()
        }
        with atomic_write(path) as file:
            np.savez(file, step=self.step, seconds=self.seconds, settings=settings, **arrays)  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: Path, settings: str, device: str) -> "TrainState":
        """Read a checkpoint.

        Raises:
            InputError: the file is damaged, or belongs to a training with other settings.
        """
        sets: dict[str, dict[str, Tensor]] = {"values": {}, "first": {}, "second": {}}
        try:
            with np.load(path, allow_pickle=False) as arrays:
                same = str(arrays["settings"]) == settings
                for kind, tensors in sets.items() if same else ():
                    for name in (*GAUSSIAN_PARAMETERS, *PHOTO_PARAMETERS):
                        tensors[name] = torch.from_numpy(arrays[f"{kind} {name}"]).to(device)
                step, seconds = int(arrays["step"]), float(arrays["seconds"])
        except Exception:  # NumPy fails in many ways on a damaged file
            raise InputError(
                f"{short_name(path)}: expected an interrupted training, got a damaged file; "
                "delete it"
            ) from None
        if not same:
            raise InputError(
                f"{short_name(path)}: expected the photos and settings of the interrupted "
                "training, got others; give "
                "those, delete the file, or choose another --out"
            )
        return cls(**sets, step=step, seconds=seconds)


def initialise(
    points: Array, colours: NDArray[np.uint8], photos: int, sh_degree: int, device: str
) -> TrainState:
    """Initial state: isotropic Gaussians at points, sized by the distance to their neighbours.

    Args:
        points: (N, 3) world [m], at least 4.
        colours: (N, 3) red, green, blue.
        photos: their number.
        device: of the tensors.

    Raises:
        InputError: there are fewer than 4 points.
    """
    count = len(points)
    if count < 4:
        raise InputError(
            f"points: expected at least 4 to begin with, got {count}; ask for more Gaussians"
        )
    means = torch.tensor(points, dtype=torch.float32, device=device)
    quaternions = torch.zeros(count, 4, device=device)
    quaternions[:, 0] = 1.0
    values = {
        "means": means,
        "quaternions": quaternions,
        "log_scales": (INITIAL_SCALE * neighbour_distances(means)).log()[:, None].repeat(1, 3),
        "logits": torch.full(
            (count,), math.log(INITIAL_OPACITY / (1.0 - INITIAL_OPACITY)), device=device
        ),
        "dc": (torch.tensor(colours, dtype=torch.float32, device=device) / 255.0 - 0.5) / SH_C0,
        "rest": torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3, device=device),
        "exposures": torch.zeros(photos, 6, device=device),
        "twists": torch.zeros(photos, 6, device=device),
    }
    first, second = (
        {name: torch.zeros_like(value) for name, value in values.items()} for _ in range(2)
    )
    return TrainState(values, first, second)


def neighbour_distances(means: Tensor) -> Tensor:
    """(N,) mean distance to the three nearest neighbours [m], at least a millimetre."""
    nearest = min(4, len(means))  # the point itself and three neighbours
    near = [
        torch.cdist(part, means).topk(nearest, largest=False).values[:, 1:]
        for part in means.split(CHUNK)
    ]
    return torch.cat(near).mean(dim=1).clamp(min=1e-3)


def to_scene(gaussians: GaussianTensors, source: str) -> GaussianScene:
    """The Gaussians as a scene, without those that are not finite."""
    arrays = [tensor.detach().cpu().numpy() for tensor in gaussians]
    good = np.all(
        [np.isfinite(array).reshape(len(array), -1).all(axis=1) for array in arrays], axis=0
    )
    means, quaternions, scales, opacities, sh = (array[good] for array in arrays)
    return GaussianScene(means, quaternions, scales, opacities, sh, source=source)
