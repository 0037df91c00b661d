"""Views of policies: camera and leader poses -> images and masks of the leader, many in a call."""

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from falconwing_kit.core.checks import Array
from falconwing_kit.learning.pose_views import make_renderer, upscale_camera
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene

SUPERSAMPLING = 2
BATCH = 128  # views in a call of the GPU renderer


class PolicyViews:
    """Renders what the cameras of many flights see."""

    def __init__(
        self, hall: GaussianScene, leader: GaussianScene | None, camera: PinholeCamera,
        backend: str, device: str,
    ) -> None:  # fmt: skip
        """Prepare the renderers, of the camera's size and of twice that, which is averaged."""
        self._device, self._camera = device, camera
        self._hall, self._leader = [], []
        for lens in (camera, upscale_camera(camera, SUPERSAMPLING)):
            self._hall.append(make_renderer(hall, lens, backend, batch=BATCH))
            if leader is not None:
                self._leader.append(make_renderer(leader, lens, backend, batch=BATCH))

    def render(
        self, Ts_world_camera: Array, Ts_world_leader: Array, fine: bool
    ) -> tuple[Tensor, Tensor | None]:
        """Images (N, 3, h, w) of bytes, and the leaders' masks (N, h, w) of bytes.

        Args:
            Ts_world_camera: (N, 4, 4).
            Ts_world_leader: (N, 4, 4) of the leaders' bodies; not read without a leader.
            fine: render at twice the size and average, as a larger camera image scaled down.
        """
        colours, _, depths = self._hall[fine](Ts_world_camera)
        masks = None
        if self._leader:
            Ts_leader_camera = np.linalg.inv(Ts_world_leader) @ Ts_world_camera
            drawn, alphas, leader_depths = self._leader[fine](Ts_leader_camera)
            alphas = alphas * ((leader_depths < depths) | (depths <= 0.0))
            colours = torch.where(
                alphas[..., None] > 0.0, drawn + (1.0 - alphas[..., None]) * colours, colours
            )
            masks = alphas[:, None]
        images = colours.permute(0, 3, 1, 2)
        if fine:
            images = functional.avg_pool2d(images, SUPERSAMPLING)
            masks = None if masks is None else functional.avg_pool2d(masks, SUPERSAMPLING)
        return _bytes(images), None if masks is None else _bytes(masks)[:, 0]


def _bytes(images: Tensor) -> Tensor:
    return (images.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
