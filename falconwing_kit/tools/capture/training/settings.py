"""Training settings: the caller's choices -> checked numbers. Loads no torch."""

from dataclasses import dataclass

import numpy as np

from falconwing_kit.core.checks import InputError, require_range

CAMERAS = "cameras.json"  # the file that makes a folder one of turntable photos


@dataclass(frozen=True)
class FitSettings:
    """Training settings; the defaults are for a hall on a GPU."""

    judge_by: tuple[str, ...] = ()  # names of the held-out photos; empty: chosen by hold_out
    gaussians: int = 200_000  # maximum number
    steps: int = 30_000
    batch: int = 1  # photos a step
    sh_degree: int = 1  # of the colours
    antialiased: bool = False  # train for the renderers' antialiased mode
    width: int = 0  # of the training images [px]; 0 keeps the photos' size
    hold_out: float = 0.11  # share of held-out photos, as whole clusters of places
    exposures: bool = True  # optimise each photo's gain and offset
    poses: bool = False  # optimise the poses of the training photos
    ssim_weight: float = 0.2  # of 1 - SSIM against the mean absolute error
    opacity_cost: float = 0.03
    scale_cost: float = 0.05
    # maximum standard deviation of a Gaussian [m]; 0: unlimited. Larger ones veil cameras near them
    largest: float = 0.5
    dropout: float = 0.1  # share of the Gaussians dropped in steps near the end
    minutes: float = 8.0  # time limit of the training
    # x, y, z of the room's lowest and highest corner [m]; empty: from cameras and survey
    room: tuple[float, ...] = ()
    # optimisation steps of each held-out photo's pose in the finished scene; 0: none
    pose_steps: int = 200
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
