"""Frame monitor: the live pictures, one by one -> whether they can be flown by, and why not.

The paper's rule is an alert when the SSIM of consecutive frames is below 0.7 five times in a row.
In a turn that rule alarms on perfect video, and a frozen or blank picture scores one. So the
picture before is first moved to where the aircraft's own motion has taken it, and what SSIM does
not see has checks of its own: fine noise over strong contrasts, and pictures that are frozen, old,
or of one colour.
"""

import math
from collections import deque
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeGuard

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.config import from_toml
from falconwing_kit.core.messages import Image
from falconwing_kit.vision.ssim import RADIUS_PX, ssim, ssim_map

RULES = ("motion", "paper")
MIN_SIDE_PX = 32
MIN_OVERLAP = (
    0.1  # share of the picture that must be in both frames; with less there is nothing to compare
)
MIN_CHROMA = 40  # grey levels between the channels of what is not called grey

Pixels = NDArray[np.uint8]


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
    """What `monitor.toml` holds; the file says where each number comes from."""

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
            "width_px": (MIN_SIDE_PX, 4096), "blur_px": (0.1, 10), "threshold": (0, 1), "noise_levels": (0, 255),
            "frames": (1, self.window), "window": (1, 1000), "clear_frames": (1, 1000), "max_age_s": (0.01, 10),
            "frozen_levels": (0, 255), "flat_levels": (0, 255), "flat_share": (0, 1),
        }  # fmt: skip
        for name, (low, high) in limits.items():
            require_range(name, getattr(self, name), low=low, high=high)


@dataclass(frozen=True)
class FrameVerdict:
    """What the monitor says after a frame."""

    # of this picture and the one before, by the monitor's rule; nan where there are not two to
    # compare
    ssim: float
    alert: bool  # True: the pilot should take over now
    reason: str  # why, in words; empty without an alert
    noise: float = (
        math.nan
    )  # standard deviation of the picture's noise [grey levels]; nan by the paper's rule


@cache
def load_monitor_settings(path: str | Path | None = None) -> MonitorSettings:
    """The settings in a file, by default those that ship.

    Raises:
        FileNotFoundError: there is no file.
        InputError: it is not TOML, or a key is unknown, missing or out of its range.
    """
    return from_toml(MonitorSettings, path or Path(__file__).with_name("monitor.toml"))


class FrameMonitor:
    """Watches one camera; call `update` in every step, with a new picture or without.

    Args:
        rule: "motion", or "paper" for that rule alone, false alarms and blind spots included.
        settings: None for the ones that ship.

    Raises:
        InputError: there is no such rule.
    """

    def __init__(self, rule: str = "motion", settings: MonitorSettings | None = None) -> None:
        if rule not in RULES:
            raise InputError(f"rule: expected one of {', '.join(RULES)}, got {rule!r}")
        self.rule, self.settings = rule, settings or load_monitor_settings()
        self._before: Pixels | None = None  # the newest picture that was new, ready to compare
        self._taken: float | None = None  # when it was taken [s]
        self._t = -math.inf
        self._bad: deque[str] = deque(
            maxlen=self.settings.window if rule == "motion" else self.settings.paper.frames
        )
        self._good_in_a_row, self._reason = 0, ""

    def update(self, image: Pixels | Image | None, t: float) -> FrameVerdict:
        """Take in the newest picture and judge.

        Args:
            image: (H, W, 3) RGB or (H, W) grey, uint8, 32 pixels a side or more; or an Image, whose
                own time counts as when it was taken (now, where it lies in the future: no clock may
                keep a picture young for ever); None where the camera has none. Pictures may come
                again while there is no newer one.
            t: now [s], on any clock that runs forward.

        Returns:
            The verdict.

        Raises:
            InputError: the picture is no such array, or time ran backward.
        """
        if require_range("t", t) < self._t:
            raise InputError(
                f"t: expected no time before the last, {self._t:g}, got {t}; a new flight needs a new monitor"
            )
        self._t = float(t)
        taken = (
            min(require_range("image.t", image.t), self._t) if isinstance(image, Image) else self._t
        )
        pixels = image.pixels if isinstance(image, Image) else image
        if pixels is not None:
            _require_picture(pixels)
        if self._taken is None:
            self._taken = self._t  # counts from here, even if no picture ever comes
        return self._by_paper(pixels) if self.rule == "paper" else self._by_motion(pixels, taken)

    def _by_paper(self, pixels: Pixels | None) -> FrameVerdict:
        """Consecutive frames as they are; no picture, no verdict."""
        rule = self.settings.paper
        grey = None if pixels is None else _grey(pixels)
        similarity = math.nan
        if grey is not None:
            if _comparable(self._before, grey):
                similarity = ssim(self._before, grey)
                self._bad.append("noise" if similarity < rule.threshold else "")
            self._before = grey.copy()  # a caller may write its next picture into the same array
        alert = sum(map(bool, self._bad)) >= rule.frames
        return FrameVerdict(
            similarity,
            alert,
            f"noise: SSIM below {rule.threshold:g}, {rule.frames} times" if alert else "",
        )

    def _by_motion(self, pixels: Pixels | None, taken: float) -> FrameVerdict:
        """Against the moved picture before; then what SSIM cannot see."""
        similarity = noise = math.nan
        if pixels is not None:
            small, noise = downscale(pixels, self.settings.width_px), noise_level(_grey(pixels))
            grey = _blur(_grey(small), self.settings.blur_px)
            if self._is_frozen(grey):
                similarity = 1.0  # not counted: a picture that comes twice must not hide noise
            else:
                if _comparable(self._before, grey):
                    similarity = motion_ssim(self._before, grey)
                self._count_picture(self._fault(small, similarity, noise))
                self._before, self._taken = grey, taken
        age = self._t - (self._t if self._taken is None else self._taken)
        if age > self.settings.max_age_s + 1e-9:
            shown = f"; {self._bad[-1]}" if self._bad and self._bad[-1] else ""
            self._reason, self._good_in_a_row = (
                f"old or frozen: no new picture for {age:.2f} s{shown}",
                0,
            )
        return FrameVerdict(similarity, bool(self._reason), self._reason, noise)

    def _is_frozen(self, grey: Pixels) -> bool:
        """Whether a picture is the one before: a live camera has noise, and a flying one moves."""
        return (
            _comparable(self._before, grey)
            and _difference(self._before, grey) < self.settings.frozen_levels
        )

    def _fault(self, small: Pixels, similarity: float, noise: float) -> str:
        """What is wrong with one picture, in words; empty if nothing."""
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
        """Count a new picture; enough bad ones raise the alert, enough good ones in a row take it
        back.
        """
        rule = self.settings
        self._bad.append(fault)
        self._good_in_a_row = 0 if fault else self._good_in_a_row + 1
        if fault and sum(map(bool, self._bad)) >= rule.frames:
            self._reason = fault
        elif self._good_in_a_row >= rule.clear_frames:
            self._reason = ""


def downscale(pixels: Pixels, width_px: int) -> Pixels:
    """A picture (H, W) or (H, W, 3) reduced to a width by averaging areas; a smaller one stays as
    it is.
    """
    import cv2

    height, width = pixels.shape[:2]
    if width <= width_px:
        return pixels
    size = (width_px, max(round(height * width_px / width), MIN_SIDE_PX))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)


def motion_ssim(before: Pixels, now: Pixels) -> float:
    """SSIM of two views after the first is moved to where the second sees the same things.

    The motion of each pixel is the optical flow of Kroeger, Timofte, Dai & Van Gool, Fast optical
    flow using dense inverse search, ECCV 2016, by OpenCV. Noise is new in each frame, so no motion
    explains it. What came into view only now is left out.

    Args:
        before: (H, W) grey uint8, 32 pixels a side or more.
        now: (H, W) of the same size.

    Returns:
        Mean SSIM over what both frames show; 0 where that is less than a tenth of the picture.
    """
    import cv2

    height, width = now.shape
    still = np.zeros((height, width, 2), np.float32)
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(now, before, still)
    x = np.arange(width, dtype=np.float32) + flow[..., 0]
    y = np.arange(height, dtype=np.float32)[:, None] + flow[..., 1]
    moved = np.asarray(
        cv2.remap(before, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8
    )
    seen = (x >= 0.0) & (x <= width - 1.0) & (y >= 0.0) & (y <= height - 1.0)
    seen = seen[RADIUS_PX:-RADIUS_PX, RADIUS_PX:-RADIUS_PX]
    return float(ssim_map(moved, now)[seen].mean()) if seen.mean() > MIN_OVERLAP else 0.0


def noise_level(grey: Pixels) -> float:
    """Standard deviation of the noise in one picture [grey levels], where less than half of it is
    finely textured.

    The mask is zero on planes and along edges, and turns white noise of sigma into one of 6 sigma.
    [Immerkaer, Fast noise variance estimation, 1996; the median in place of the mean, so that edges
    do not count]

    Args:
        grey: (H, W) uint8, as it came: reducing a picture averages noise away.
    """
    import cv2

    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    left = cv2.filter2D(grey, cv2.CV_16S, mask)[1:-1:2, 1:-1:2]
    return float(np.median(np.abs(left))) / (
        6.0 * 0.6745
    )  # 0.6745 sigma: the median of a normal's absolute value


def flat_share(pixels: Pixels, levels: float) -> tuple[float, str]:
    """How much of a picture has one colour: a receiver without signal shows black or blue, perhaps
    with a few words.

    Args:
        pixels: (H, W, 3) RGB or (H, W) grey.
        levels: by how much each channel may differ from its median [grey levels].

    Returns:
        The share 0..1, and a word for the colour.
    """
    channels = pixels.reshape(-1, pixels.shape[2] if pixels.ndim == 3 else 1).astype(np.int16)
    colour = np.median(channels, axis=0)
    share = float((np.abs(channels - colour) <= levels).all(axis=1).mean())
    if np.ptp(colour) > MIN_CHROMA:
        return share, ("red", "green", "blue")[int(np.argmax(colour))]
    return share, "black" if colour.mean() < 64.0 else "white" if colour.mean() > 192.0 else "grey"


def _grey(pixels: Pixels) -> Pixels:
    import cv2

    return np.asarray(
        pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), np.uint8
    )


def _blur(grey: Pixels, sigma_px: float) -> Pixels:
    import cv2

    return np.asarray(cv2.GaussianBlur(grey, (0, 0), sigma_px), np.uint8)


def _difference(first: Pixels, second: Pixels) -> float:
    """Mean absolute difference [grey levels]."""
    import cv2

    return float(cv2.norm(first, second, cv2.NORM_L1) / first.size)


def _comparable(before: Pixels | None, grey: Pixels) -> TypeGuard[Pixels]:
    return before is not None and before.shape == grey.shape


def _require_picture(pixels: Pixels) -> None:
    got = (
        f"{getattr(pixels, 'shape', '')} {getattr(pixels, 'dtype', type(pixels).__name__)}".strip()
    )
    if not isinstance(pixels, np.ndarray) or pixels.dtype != np.uint8 or pixels.ndim not in (2, 3):
        raise InputError(
            f"image: expected (H, W, 3) or (H, W) uint8, got {got}; decode a JPEG first"
        )
    if min(pixels.shape[:2]) < MIN_SIDE_PX or pixels.shape[2:] not in ((), (3,)):
        raise InputError(
            f"image: expected (H, W, 3) or (H, W) of {MIN_SIDE_PX} pixels a side or more, got {got}"
        )
