"""Appearance of flights: images of B flights -> the same with each flight's own light, lens, video
link and covered parts, as one camera keeps them through a flight.

Single images are varied by appearance.py, from which the analog link and the blur are taken.
"""

import torch
from torch import Tensor
from torch.nn import functional

from falconwing_kit.learning.appearance import analog_link, luma

CLEAN_SHARE = 0.15  # of flights, left as they are
ANALOG_SHARE, BLUR_SHARE, COVER_SHARE, SPOT_SHARE = 0.25, 0.35, 0.15, 0.15
GRID = (3, 4)  # of the uneven light, interpolated
KERNEL = 5  # width of the blur [px]


class FlightAppearance:
    """One draw for B flights."""

    def __init__(self, count: int, generator: torch.Generator) -> None:
        """Draw it; tensors are on the generator's device."""
        self._generator, self._device = generator, generator.device
        uniform, normal = self._uniform, self._normal
        self.clean = uniform(count, 0.0, 1.0) < CLEAN_SHARE
        # exposure, white balance and uneven light are factors
        self._gain = torch.exp(
            uniform(count, -0.8, 0.8)[:, None, None, None] + 0.06 * normal(count, 3, 1, 1)
        )
        self._field = 0.15 * normal(count, 1, *GRID)
        self._gamma = torch.exp(0.2 * normal(count, 1, 1, 1))
        self._saturation = uniform(count, 0.5, 1.4)[:, None, None, None]
        self._contrast = torch.exp(0.15 * normal(count, 1, 1, 1))
        self._tint = 0.02 * normal(count, 3, 1, 1)
        self._noise = (0.06 * uniform(count, 0.0, 1.0) ** 2)[:, None, None, None]
        self._salt = torch.where(
            uniform(count, 0.0, 1.0) < 0.06,
            uniform(count, 0.0, 0.2),
            torch.zeros(1, device=self._device),
        )
        self._analog = uniform(count, 0.0, 1.0) < ANALOG_SHARE
        self._sigma_px = torch.where(
            uniform(count, 0.0, 1.0) < BLUR_SHARE,
            uniform(count, 0.3, 1.3),
            torch.zeros(1, device=self._device),
        )
        # a side of the image is covered up to a share of it; and spots
        self._cover = torch.where(
            uniform(count, 0.0, 1.0) < COVER_SHARE,
            uniform(count, 0.1, 0.55),
            torch.zeros(1, device=self._device),
        )
        self._side = (4.0 * uniform(count, 0.0, 1.0)).long()
        self._spots = torch.rand(count, 2, 4, generator=generator, device=self._device)
        self._has_spot = uniform(count, 0.0, 1.0) < SPOT_SHARE
        self._colour = torch.rand(count, 3, 1, 1, generator=generator, device=self._device)
        self._is_black = uniform(count, 0.0, 1.0) < 0.4
        self._colour = self._colour * ~self._is_black[:, None, None, None]

    def apply(self, images: Tensor, flights: Tensor) -> Tensor:
        """Images (N, 3, h, w) in 0..1 as the cameras of their flights (N,) take them."""
        clean = images
        size = images.shape[2:]
        field = functional.interpolate(
            self._field[flights], size, mode="bilinear", align_corners=True
        )
        images = images * self._gain[flights] * torch.exp(field)
        images = images.clamp(1e-3, 1.0) ** self._gamma[flights]
        grey = luma(images)
        images = grey + self._saturation[flights] * (images - grey)
        middle = images.mean(dim=(1, 2, 3), keepdim=True)
        images = middle + self._contrast[flights] * (images - middle) + self._tint[flights]
        images = images.clamp(0.0, 1.0)
        images = self._blur(images, flights)
        hidden = self.covers((size[0], size[1]), flights)
        images = torch.where(hidden[:, None], self._colour[flights], images)
        rows = torch.nonzero(self._analog[flights])[:, 0]
        if len(rows):
            images = images.index_copy(0, rows, analog_link(images[rows], self._generator))
        images = images + self._noise[flights] * self._normal(*images.shape)
        images = self._salted(images.clamp(0.0, 1.0), flights)
        return torch.where(self.clean[flights][:, None, None, None], clean, images)

    def _blur(self, images: Tensor, flights: Tensor) -> Tensor:
        """Defocus by a Gaussian kernel, of those flights that have it."""
        rows = torch.nonzero(self._sigma_px[flights] > 0.0)[:, 0]
        if not len(rows):
            return images
        reach = torch.arange(KERNEL, device=self._device) - KERNEL // 2
        sigma = self._sigma_px[flights][rows]
        line = torch.exp(-0.5 * (reach / sigma[:, None]) ** 2)
        line = line / line.sum(dim=1, keepdim=True)
        part, edge, count = images[rows].transpose(0, 1), KERNEL // 2, len(rows)
        wide = functional.pad(part, (edge, edge, edge, edge), mode="replicate")
        wide = functional.conv2d(wide, line[:, None, None, :], groups=count)
        part = functional.conv2d(wide, line[:, None, :, None], groups=count)
        return images.index_copy(0, rows, part.transpose(0, 1))

    def covers(self, size: tuple[int, int], flights: Tensor) -> Tensor:
        """What is covered (N, h, w) of images of a size (h, w): a side of them and an ellipse."""
        height, width = size
        y = (torch.arange(height, device=self._device) + 0.5)[:, None] / height
        x = (torch.arange(width, device=self._device) + 0.5)[None, :] / width
        y, x = y.expand(height, width), x.expand(height, width)
        from_side = torch.stack([x, 1.0 - x, y, 1.0 - y])[self._side[flights]]
        hidden = from_side < self._cover[flights][:, None, None]
        cx, cy, rx, ry = self._spots[flights][:, 0].unbind(-1)
        shape = (-1, 1, 1)
        rx, ry = (0.05 + 0.2 * r.reshape(shape) for r in (rx, ry))
        spot = ((x - cx.reshape(shape)) / rx) ** 2 + ((y - cy.reshape(shape)) / ry) ** 2 < 1.0
        hidden = hidden | (spot & self._has_spot[flights].reshape(shape))
        return hidden & ~self.clean[flights].reshape(shape)

    def _salted(self, images: Tensor, flights: Tensor) -> Tensor:
        """Salt and pepper: a share of the pixels white or black."""
        rows = torch.nonzero(self._salt[flights] > 0.0)[:, 0]
        if not len(rows):
            return images
        part = images[rows]
        draw = torch.rand(
            len(rows), 1, *images.shape[2:], generator=self._generator, device=self._device
        )
        share = self._salt[flights][rows][:, None, None, None]
        part = torch.where(draw < 0.5 * share, 0.0, part)
        part = torch.where(draw > 1.0 - 0.5 * share, 1.0, part)
        return images.index_copy(0, rows, part)

    def _uniform(self, count: int, low: float, high: float) -> Tensor:
        unit = torch.rand(count, generator=self._generator, device=self._device)
        return low + (high - low) * unit

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self._generator, device=self._device)
