"""Image faults: a world's camera and link, source of clean images -> what reaches the pilot.

In the order of a real one: exposure, what covers the lens, the analog link, the receiver that shows
nothing, frames lost and frames late.
"""

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.messages import Image
from falconwing_kit.flight.loop import ImageSource
from falconwing_kit.scene.analog import AnalogVideo, scene_link
from falconwing_kit.scene.sh import GAMMA
from falconwing_kit.tools.trials.worlds import World

Pixels = NDArray[np.uint8]
ANALOG_SCENE = "hall_analog"  # whose link was measured
BLACK_FROM_S = (0.3, 1.5)  # the picture goes between these times [s]
DISCS = 6  # on the lens
GREY = 128
# Keys of random generators, with the trial's seed
EXPOSURE, DIRT, LOSS, BLACK = range(21, 25)


@dataclass(frozen=True)
class ImageFaults:
    """The faults of a world as `TrialSettings.degrade` takes them: (source, seed) -> source."""

    world: World

    def __call__(self, source: ImageSource, seed: int) -> ImageSource:
        """The source of what reaches the pilot in the trial of a seed."""
        return FaultyImages(source, self.world, seed)


class FaultyImages:
    """Images of a source with the faults of a world."""

    def __init__(self, source: ImageSource, world: World, seed: int) -> None:
        """Draw the faults of a trial's seed."""
        self._source, self._world = source, world
        stops = np.random.default_rng([seed, EXPOSURE]).uniform(*world.exposure_ev)
        self._exposed = exposure_table(float(stops))
        self._dirt_rng = np.random.default_rng([seed, DIRT])
        self._dirt: NDArray[np.bool_] | None = None
        self._loss = np.random.default_rng([seed, LOSS])
        self._black = float(np.random.default_rng([seed, BLACK]).uniform(*BLACK_FROM_S))
        self._link = world_link(world, seed)
        self._on_the_way: deque[tuple[Image, bool]] = deque()  # image, whether it arrives
        self._newest: Image | None = None

    def next_image(self, t: float) -> Image | None:
        """The newest image that has arrived at t [s]; None before the first."""
        image = self._source.next_image(t)
        if image is None:
            return self._newest
        arrives = bool(self._loss.random() >= self._world.lost)
        self._on_the_way.append((replace(image, pixels=self._seen(image)), arrives))
        if len(self._on_the_way) > self._world.late:
            image, arrives = self._on_the_way.popleft()
            self._newest = image if arrives else self._newest
        return self._newest

    def _seen(self, image: Image) -> Pixels:
        """The pixels (H, W, 3) of a frame as they reach the receiver's output."""
        world, pixels = self._world, image.pixels
        if world.exposure_ev != (0.0, 0.0):
            pixels = self._exposed[pixels]
        if world.occluded:
            if self._dirt is None:
                self._dirt = draw_discs(self._dirt_rng, world.occluded, pixels.shape[:2])
            pixels = np.where(self._dirt[..., None], np.uint8(12), pixels)
        if world.covered:
            pixels = pixels.copy()
            pixels[:, : round(world.covered * pixels.shape[1])] = 0
        if world.is_grey:
            pixels = np.full_like(pixels, GREY)
        if self._link is not None:
            pixels = self._link.apply(pixels, image.sequence)
        if world.black_s and self._black <= image.t < self._black + world.black_s:
            pixels = np.zeros_like(pixels)
        return pixels


def world_link(world: World, seed: int) -> AnalogVideo | None:
    """The analog link of a trial; None for a direct view."""
    link = scene_link(ANALOG_SCENE) if world.is_analog else None
    if link is None:
        return None
    return replace(link, seed=seed, snr_db=link.snr_db if world.snr_db is None else world.snr_db)


def exposure_table(stops: float) -> Pixels:
    """(256,) pixel value -> that at another exposure [EV]: light times 2^EV, values its 1/2.2th
    power, cut at white.
    """
    light = (np.arange(256) / 255.0) ** GAMMA * 2.0**stops
    return np.clip(255.0 * light ** (1.0 / GAMMA) + 0.5, 0.0, 255.0).astype(np.uint8)


def draw_discs(rng: np.random.Generator, share: float, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """(H, W) mask of discs on the lens whose areas add up to a share of the image.

    Where they overlap or leave the image they cover less.
    """
    height, width = shape
    centres = rng.uniform((0.0, 0.0), (width, height), (DISCS, 2))
    radius = np.sqrt(share * width * height / (np.pi * DISCS))
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    discs = [np.hypot(x - u, y - v) <= radius for u, v in centres]
    return np.asarray(np.logical_or.reduce(discs))
