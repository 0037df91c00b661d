"""SIMULATED bench: a board in virtual time -> images of its LED, or of a checkerboard.

What `falconwing bench` measures is known here, so that the measurement can be tried and tested.
"""

import math
from collections import deque
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np

from falconwing_kit.core.checks import Array
from falconwing_kit.core.messages import Image
from falconwing_kit.tools.bridge.python_board import Board
from falconwing_kit.tools.devices.lens import Lens
from falconwing_kit.vision.images import Pixels

STEP_S = 0.0005  # resolution of the LED's time
SAMPLES = 2  # rays through a pixel, along each side
PATTERN = (9, 6)  # inner corners of its checkerboard
NOISES = 16  # noise images, drawn once
# A wide lens of strong distortion, as FPV cameras have it.
LENS = Lens(320, 240, 205.0, 207.0, 163.5, 117.0, -0.31, 0.09, 0.0008, -0.0005)
LEVELS = (40.0, 160.0)  # brightness of the LED's place: off, on


@dataclass(frozen=True)
class BenchTruth:
    """What is simulated."""

    lens: Lens = LENS
    camera_s: float = 0.062  # middle of the exposure -> image at the computer
    exposure_s: float = 0.012
    rate_hz: float = 30.0
    jitter_s: float = 0.0015  # standard deviation of arrivals
    noise_levels: float = 2.0  # [grey levels]


class SimulatedBench:
    """A board, a camera above its LED, and a checkerboard that is held before the camera.

    Args:
        board: in virtual time; it is closed with the bench.
        truth: what is to be measured.
        seed: of noise and jitter.
    """

    def __init__(self, board: Board, truth: BenchTruth | None = None, seed: int = 0) -> None:
        self.board, self.truth = board, truth or BenchTruth()
        self._rng = np.random.default_rng([seed, 3])
        shape = (NOISES, self.truth.lens.height_px, self.truth.lens.width_px)
        self._noises = self._rng.normal(0.0, self.truth.noise_levels, shape).astype(np.float32)
        self._switched: deque[tuple[float, bool]] = deque([(-math.inf, False)], maxlen=1000)
        self._next, self._next_arrival = 0, self._arrival(0)
        self._image: Image | None = None
        self._checkerboard: Pixels | None = None

    def now(self) -> float:
        """Virtual time [s]."""
        return self.board.t

    def sleep(self, seconds: float) -> None:
        """Advance virtual time [s]."""
        end = self.board.t + seconds
        while self.board.t < end - 1e-9:
            self.board.run_until(min(self.board.t + STEP_S, end))
            if self.board.led != self._switched[-1][1]:
                self._switched.append((self.board.t, self.board.led))

    def hold_checkerboard(self, view: int) -> None:
        """Hold a checkerboard before the camera; -1 takes it away, and the LED is seen."""
        self._checkerboard = None if view < 0 else draw_checkerboard(self.truth.lens, view)

    def next_image(self, t: float) -> Image | None:
        """The newest image that has arrived by t [s]; its time is that of its arrival."""
        arrived = None
        while self._next_arrival <= t:
            arrived = (self._next, self._next_arrival)
            self._next += 1
            self._next_arrival = self._arrival(self._next)
        if arrived is not None:
            self._image = Image(*arrived, self._expose(arrived[0]))
        return self._image

    def close(self) -> None:
        """Release the board."""
        self.board.close()

    def _arrival(self, number: int) -> float:
        """When an image arrives [s]."""
        late = self._rng.normal(self.truth.camera_s, self.truth.jitter_s)
        return number / self.truth.rate_hz + max(float(late), 0.0)

    def _expose(self, number: int) -> Pixels:
        """(H, W, 3) an image."""
        noise = self._noises[number % NOISES]
        if self._checkerboard is not None:
            grey = self._checkerboard + noise
        else:
            grey = noise + LEVELS[0]
            height, width = grey.shape
            led = np.s_[height // 2 - 8 : height // 2 + 8, width // 2 - 8 : width // 2 + 8]
            grey[led] += (LEVELS[1] - LEVELS[0]) * self._lit_share(number / self.truth.rate_hz)
        return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[..., None], 3, axis=2)

    def _lit_share(self, middle: float) -> float:
        """Share of an exposure in which the LED was on."""
        begin, end = middle - 0.5 * self.truth.exposure_s, middle + 0.5 * self.truth.exposure_s
        changes = [*self._switched, (math.inf, False)]
        lit = 0.0
        for (since, is_on), (until, _) in pairwise(changes):
            if is_on:
                lit += max(0.0, min(until, end) - max(since, begin))
        return lit / self.truth.exposure_s


def draw_checkerboard(lens: Lens, view: int) -> Pixels:
    """(H, W) grey: a tilted checkerboard through a lens, ray by ray.

    Args:
        lens: that bends the rays; its distortion is inverted by fixed-point iteration.
        view: 0 and up; each has its own place and tilt.
    """
    import cv2

    rng = np.random.default_rng([view, 5])
    x, y = _rays(lens)
    # Pose of the board in camera axes, in squares: tilted about x and y, rolled about z.
    tilt, roll = np.radians(rng.uniform((15.0, -20.0), (40.0, 20.0)))
    R_camera_board, _ = cv2.Rodrigues(
        np.array([tilt * np.cos(2.4 * view), tilt * np.sin(2.4 * view), roll])
    )
    distance = rng.uniform(9.0, 13.0)
    side = rng.uniform(0.05, 0.2) * np.array([np.cos(1.9 * view), np.sin(1.9 * view)])
    half_view = np.array([lens.width_px / lens.fx_px, lens.height_px / lens.fy_px])
    place = distance * np.array([*(side * half_view), 1.0])
    directions = np.stack([x, y, np.ones_like(x)], axis=-1)
    normal = R_camera_board[:, 2]
    depth = (normal @ place) / (directions @ normal)
    p_board = (directions * depth[..., None] - place) @ R_camera_board  # rows: the inverse
    column, row = p_board[..., 0] + PATTERN[0] / 2 + 0.5, p_board[..., 1] + PATTERN[1] / 2 + 0.5
    is_inside = (column > 0) & (column < PATTERN[0] + 1) & (row > 0) & (row < PATTERN[1] + 1)
    is_black = is_inside & ((np.floor(column) + np.floor(row)) % 2 == 0)
    grey = np.where(is_black, 30.0, np.where(is_inside, 220.0, 200.0))
    grey = grey.reshape(lens.height_px, SAMPLES, lens.width_px, SAMPLES).mean(axis=(1, 3))
    return np.asarray(grey, np.uint8)


@cache
def _rays(lens: Lens) -> tuple[Array, Array]:
    """X/Z and Y/Z of SAMPLES x SAMPLES rays through each pixel, before the lens bent them."""
    u = (np.arange(lens.width_px * SAMPLES) + 0.5) / SAMPLES
    v = (np.arange(lens.height_px * SAMPLES) + 0.5) / SAMPLES
    bent_x, bent_y = np.meshgrid((u - lens.cx_px) / lens.fx_px, (v - lens.cy_px) / lens.fy_px)
    x, y = bent_x.copy(), bent_y.copy()
    for _ in range(50):
        again_x, again_y = lens.distort(x, y)
        x, y = x + bent_x - again_x, y + bent_y - again_y
    return x, y
