"""Frame monitor: a camera's frames, one by one -> whether they are fit for flying, and why.

The paper's rule is an alert when the SSIM of consecutive frames is below 0.7 five times in a row.
In a turn this rule alarms on perfect video, and a frozen or blank picture scores one. The kit's
rule therefore compensates the motion before it compares frames, and has separate checks for what
SSIM does not measure: fine noise over strong contrasts, and pictures that are frozen, old, or of
one colour.
"""

import math
from collections import deque
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeGuard

import numpy as np

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.config import from_toml
from falconwing_kit.core.messages import Image
from falconwing_kit.vision.images import Pixels, require_image, to_grey
from falconwing_kit.vision.ssim import RADIUS_PX, ssim, ssim_map

RULES = ("motion", "paper")
MIN_SIDE_PX = 32
MIN_OVERLAP = 0.1  # share of the picture that both frames must show
MIN_CHROMA = 40  # difference of the channels [grey levels]; less is grey
DARK_LEVEL, BRIGHT_LEVEL = 64.0, 192.0  # grey below is called black, above white
ROUNDING_S = 1e-9  # of an age
NORMAL_MEDIAN = 0.6745  # median absolute value of a standard normal variable


@dataclass(frozen=True)
class PaperRule:
    """The paper's own numbers."""

    threshold: float
    frames: int

    def __post_init__(self) -> None:
        require_range("threshold", self.threshold, low=0.0, high=1.0)
        require_range("frames", self.frames, low=1, high=1000)


@dataclass(frozen=True)
class MonitorSettings:
    """Content of `monitor.toml`; the file documents each number."""

    width_px: int
    blur_px: float
    threshold: float
    noise_levels: float
    frames: int
    window: int
    clear_frames: int
    max_age_s: float
    frozen_levels: float
    flat_levels: float
    flat_share: float
    paper: PaperRule

    def __post_init__(self) -> None:
        limits = {
            "width_px": (MIN_SIDE_PX, 4096), "blur_px": (0.1, 10), "threshold": (0, 1),
            "noise_levels": (0, 255), "frames": (1, self.window), "window": (1, 1000),
            "clear_frames": (1, 1000), "max_age_s": (0.01, 10), "frozen_levels": (0, 255),
            "flat_levels": (0, 255), "flat_share": (0, 1),
        }  # fmt: skip
        for name, (low, high) in limits.items():
            require_range(name, getattr(self, name), low=low, high=high)


@dataclass(frozen=True)
class FrameVerdict:
    """The monitor's result for one frame."""

    ssim: float  # with the previous picture, by the monitor's rule; nan without two to compare
    alert: bool  # True: the pilot should take over now
    reason: str  # in words; empty without an alert
    noise: float = math.nan  # standard deviation [grey levels]; nan by the paper's rule


@cache
def load_monitor_settings(path: str | Path | None = None) -> MonitorSettings:
    """The settings in a TOML file, by default those that ship.

    Raises:
        FileNotFoundError: there is no file.
        InputError: it is not TOML, or a key is unknown, missing or out of its range.
    """
    return from_toml(MonitorSettings, path or Path(__file__).with_name("monitor.toml"))


class FrameMonitor:
    """Monitor of one camera; call `update` in every step, with a new image or without.

    Args:
        rule: "motion", or "paper" for the paper's rule alone, with its false alarms and misses.
        settings: None for the ones that ship.

    Raises:
        InputError: there is no such rule.
    """

    def __init__(self, rule: str = "motion", settings: MonitorSettings | None = None) -> None:
        if rule not in RULES:
            raise InputError(f"rule: expected one of {', '.join(RULES)}, got {rule!r}")
        self.rule, self.settings = rule, settings or load_monitor_settings()
        self._previous: Pixels | None = None  # newest picture that was new, prepared to compare
        self._taken: float | None = None  # its time [s]
        self._t = -math.inf
        window = self.settings.window if rule == "motion" else self.settings.paper.frames
        self._faults: deque[str] = deque(maxlen=window)  # of the newest pictures; empty: none
        self._good_in_a_row, self._reason = 0, ""

    def update(self, image: Pixels | Image | None, t: float) -> FrameVerdict:
        """Evaluate the newest image.

        Args:
            image: (H, W, 3) RGB or (H, W) grey, uint8, 32 pixels a side or more; or an Image, with
                its own time (limited to t: a wrong clock must not make an image look new); None
                where the camera has none. The same image may be given repeatedly.
            t: now [s], on any clock that runs forward.

        Raises:
            InputError: the image is no such array, or time ran backward.
        """
        if require_range("t", t) < self._t:
            raise InputError(
                f"t: expected no time before the last, {self._t:g}, got {t}; "
                "use a new monitor for a new flight"
            )
        self._t = float(t)
        pixels = image.pixels if isinstance(image, Image) else image
        taken = self._t
        if isinstance(image, Image):
            taken = min(require_range("image.t", image.t), self._t)
        if pixels is not None:
            require_image(pixels, min_side_px=MIN_SIDE_PX)
        if self._taken is None:
            self._taken = self._t  # the age counts from here, even if no picture ever comes
        return self._by_paper(pixels) if self.rule == "paper" else self._by_motion(pixels, taken)

    def _by_paper(self, pixels: Pixels | None) -> FrameVerdict:
        """SSIM of consecutive frames as they are; a missing picture is ignored."""
        rule, similarity = self.settings.paper, math.nan
        if pixels is not None:
            grey = to_grey(pixels)
            if _is_comparable(self._previous, grey):
                similarity = ssim(self._previous, grey)
                self._faults.append("noise" if similarity < rule.threshold else "")
            self._previous = grey.copy()  # a caller may write its next picture into the same array
        alert = sum(map(bool, self._faults)) >= rule.frames
        reason = f"noise: SSIM below {rule.threshold:g}, {rule.frames} times" if alert else ""
        return FrameVerdict(similarity, alert, reason)

    def _by_motion(self, pixels: Pixels | None, taken: float) -> FrameVerdict:
        """SSIM after motion compensation, noise, uniform colour, and age."""
        similarity = noise = math.nan
        if pixels is not None:
            small, noise = downscale(pixels, self.settings.width_px), noise_level(to_grey(pixels))
            grey = _blur(to_grey(small), self.settings.blur_px)
            if self._is_frozen(grey):
                similarity = 1.0  # not counted: repeated pictures must not hide noise
            else:
                if _is_comparable(self._previous, grey):
                    similarity = motion_ssim(self._previous, grey)
                self._count_picture(self._fault(small, similarity, noise))
                self._previous, self._taken = grey, taken
        age = self._t - (self._t if self._taken is None else self._taken)
        if age > self.settings.max_age_s + ROUNDING_S:
            last_fault = f"; {self._faults[-1]}" if self._faults and self._faults[-1] else ""
            self._reason = f"old or frozen: no new picture for {age:.2f} s{last_fault}"
            self._good_in_a_row = 0
        return FrameVerdict(similarity, bool(self._reason), self._reason, noise)

    def _is_frozen(self, grey: Pixels) -> bool:
        """Whether a picture equals the previous one; a live camera has noise and moves."""
        if not _is_comparable(self._previous, grey):
            return False
        return _difference(self._previous, grey) < self.settings.frozen_levels

    def _fault(self, small: Pixels, similarity: float, noise: float) -> str:
        """Fault of one picture in words; empty if there is none."""
        rule = self.settings
        share, colour = flat_share(small, rule.flat_levels)
        if share > rule.flat_share:
            return f"blank: {100.0 * share:.0f} % of the picture is {colour}"
        if similarity < rule.threshold:
            return f"noise: SSIM {similarity:.2f}, expected {rule.threshold:g} or more"
        if noise > rule.noise_levels:
            return f"noise: {noise:.0f} grey levels, expected {rule.noise_levels:g} or less"
        return ""

    def _count_picture(self, fault: str) -> None:
        """Count a picture; faults in the window raise the alert, good ones in a row clear it."""
        rule = self.settings
        self._faults.append(fault)
        self._good_in_a_row = 0 if fault else self._good_in_a_row + 1
        if fault and sum(map(bool, self._faults)) >= rule.frames:
            self._reason = fault
        elif self._good_in_a_row >= rule.clear_frames:
            self._reason = ""


def downscale(pixels: Pixels, width_px: int) -> Pixels:
    """A picture (H, W[, 3]) reduced to a width by averaging areas; smaller ones unchanged."""
    import cv2

    height, width = pixels.shape[:2]
    if width <= width_px:
        return pixels
    size = (width_px, max(round(height * width_px / width), MIN_SIDE_PX))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)


def motion_ssim(previous: Pixels, grey: Pixels) -> float:
    """Motion-compensated SSIM of two frames, used to measure noise.

    The first is warped onto the second by optical flow: that of Kroeger, Timofte, Dai & Van Gool,
    Fast optical flow using dense inverse search, ECCV 2016, by OpenCV. Noise is new in each frame,
    so that no motion explains it. Areas that only the second frame shows are left out.

    Args:
        previous: (H, W) uint8, 32 pixels a side or more.
        grey: (H, W) of the same size.

    Returns:
        Mean over what both frames show; 0 where that is less than a tenth of the picture.
    """
    import cv2

    height, width = grey.shape
    no_flow = np.zeros((height, width, 2), np.float32)
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow_px = flow.calc(grey, previous, no_flow)
    # where each pixel of the second frame was in the first
    x = np.arange(width, dtype=np.float32) + flow_px[..., 0]
    y = np.arange(height, dtype=np.float32)[:, None] + flow_px[..., 1]
    warped = cv2.remap(previous, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    visible = (x >= 0.0) & (x <= width - 1.0) & (y >= 0.0) & (y <= height - 1.0)
    visible = visible[RADIUS_PX:-RADIUS_PX, RADIUS_PX:-RADIUS_PX]
    if visible.mean() <= MIN_OVERLAP:
        return 0.0
    return float(ssim_map(np.asarray(warped, np.uint8), grey)[visible].mean())


def noise_level(grey: Pixels) -> float:
    """Standard deviation of the noise [grey levels] of a picture mostly without fine texture.

    The mask is zero on linear gradients and along edges, and turns white noise of sigma into noise
    of 6 sigma [Immerkaer, Fast noise variance estimation, 1996; here with the median instead of the
    mean, so that the remaining edges do not count].

    Args:
        grey: (H, W) uint8 in its original size: scaling down averages noise away.
    """
    import cv2

    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    filtered = cv2.filter2D(grey, cv2.CV_16S, mask)[1:-1:2, 1:-1:2]
    return float(np.median(np.abs(filtered))) / (6.0 * NORMAL_MEDIAN)


def flat_share(pixels: Pixels, levels: float) -> tuple[float, str]:
    """Share of a picture in its median colour, and that colour's name.

    A receiver without signal shows black or blue, perhaps with a few words.

    Args:
        pixels: (H, W, 3) RGB or (H, W) grey.
        levels: allowed difference of each channel from its median [grey levels].
    """
    channels = pixels.reshape(-1, pixels.shape[2] if pixels.ndim == 3 else 1).astype(np.int16)
    colour = np.median(channels, axis=0)
    share = float((np.abs(channels - colour) <= levels).all(axis=1).mean())
    if np.ptp(colour) > MIN_CHROMA:
        return share, ("red", "green", "blue")[int(np.argmax(colour))]
    level = colour.mean()
    return share, "black" if level < DARK_LEVEL else "white" if level > BRIGHT_LEVEL else "grey"


def _blur(grey: Pixels, sigma_px: float) -> Pixels:
    """Gaussian blur of a grey picture."""
    import cv2

    return np.asarray(cv2.GaussianBlur(grey, (0, 0), sigma_px), np.uint8)


def _difference(first: Pixels, second: Pixels) -> float:
    """Mean absolute difference [grey levels]."""
    import cv2

    return float(cv2.norm(first, second, cv2.NORM_L1) / first.size)


def _is_comparable(previous: Pixels | None, grey: Pixels) -> TypeGuard[Pixels]:
    """Whether there is a previous picture, of the same size."""
    return previous is not None and previous.shape == grey.shape
