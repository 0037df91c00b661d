"""Settings of a training: what the caller wishes -> checked numbers. Loads no torch."""

from dataclasses import dataclass

import numpy as np

from falconwing_kit.core.checks import InputError, require_range

CAMERAS = "cameras.json"  # the file that makes a folder one of turntable photos


@dataclass(frozen=True)
class FitSettings:
    """How to train; the defaults are for a hall and a GPU."""

    judge_by: tuple[str, ...] = ()  # names of the photos to judge by; empty: drawn by hold_out
    gaussians: int = 200_000  # the largest number
    steps: int = 30_000
    batch: int = 1  # photos a step
    sh_degree: int = 1  # of the colours
    antialiased: bool = False  # train for renderers that fade what is smaller than a pixel
    width: int = 0  # of the images to train on [px]; 0 takes the photos as they are
    hold_out: float = 0.11  # part of the photos to judge by, whole places of them
    exposures: bool = True  # learn each photo's gain and offset
    poses: bool = False  # correct the poses of the photos that are trained on
    ssim_weight: float = 0.2  # of 1 - SSIM against the mean absolute error
    opacity_cost: float = 0.03
    scale_cost: float = 0.05
    # standard deviation that a Gaussian may have [m]: larger ones veil a lens beside them; 0: any
    largest: float = 0.5
    # part of the Gaussians that steps near the end do without: those left learn to stand alone
    dropout: float = 0.1
    minutes: float = 8.0  # of training at most; it ends smoothly before
    room: tuple[
        float, ...
    ] = ()  # x, y, z of the lowest and of the highest corner [m]; empty: from cameras and survey
    # of finding each held-out photo's pose in the finished scene, for figures of their own and,
    pose_steps: int = 200
    # where poses are corrected, to judge another training by; 0 leaves them as they are
    seed: int = 0
    backend: str = "auto"  # gsplat, reference, or auto: gsplat where there is a GPU

    def __post_init__(self) -> None:
        """Check every number."""
        for name, low, high in (
            ("gaussians", 8, 10_000_000),
            ("steps", 1, 1_000_000),
            ("batch", 1, 64),
        ):
            require_range(name, getattr(self, name), low=low, high=high)
        require_range("sh_degree", self.sh_degree, low=0, high=3)
        require_range("hold_out", self.hold_out, low=0.0, high=0.5)
        require_range("dropout", self.dropout, low=0.0, high=0.9)
        require_range("ssim_weight", self.ssim_weight, low=0.0, high=1.0)
        require_range("minutes", self.minutes, low=0.01, high=10_000.0)
        for name in ("opacity_cost", "scale_cost", "largest", "pose_steps", "seed", "width"):
            require_range(name, getattr(self, name), low=0.0, high=2**31)
        corners = np.reshape(self.room, (2, 3)) if len(self.room) == 6 else None
        if self.room and (corners is None or not (corners[0] < corners[1]).all()):
            raise InputError(
                "room: expected x,y,z of the lowest and then of the highest corner, "
                f"got {self.room}"
            )


LEADER_SETTINGS = FitSettings(
    gaussians=5_000,
    steps=8_000,
    batch=2,
    hold_out=0.1,
    exposures=False,
    opacity_cost=0.002,
    scale_cost=0.01,
    largest=0.0,
    dropout=0.0,
    pose_steps=0,
)
