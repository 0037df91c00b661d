"""Analog video link: clean image + signal-to-noise ratio -> the image after FM link and grabber.

A model of 525-line composite video sent by frequency modulation; every step is a small function
with its source. For measured links, whose bandwidths and noise come from photos (the toolbox's
`capture/survey/link.py`), analog.toml has the numbers under the scene's name.
"""

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, InputError, require_range

LINE_S = 52.66e-6  # visible part of a line [ITU-R BT.1700, 525 lines]
FRAME_S = 1.0 / 29.97  # two fields
LUMA_HZ, CHROMA_HZ = 4.2e6, 0.6e6  # bandwidths; chroma of a plain decoder [ITU-R BT.1700]
DEVIATION_HZ = 3.5e6  # peak, of a common 5.8 GHz video transmitter
RISE_S = 0.25e-6  # of a sync edge behind the luma filter
SYNC_SHARE = 0.4  # height of a sync pulse over that of white (40 of 100)
SYNC_HZ = 0.5e6  # low-pass of the sync separator
CLICK_DECAY_S = 0.3e-6  # of the tail that de-emphasis leaves behind a click
LOCK = 0.5  # share of its error that the line oscillator keeps from line to line
TEAR_LOCK = 0.85  # the same after a lost lock
DROPOUT_LINES = 6.0  # mean length of a fade
MIN_SIDE_PX = 16  # of an image

Pixels = NDArray[np.uint8]
Plane = NDArray[np.float32]


@dataclass(frozen=True)
class AnalogVideo:
    """A link of constant quality; the same seed and frame number give the same image."""

    # peak-to-peak luma over rms thermal noise, unweighted [CCIR Rec. 567]; clicks are added to it
    snr_db: float
    seed: int = 0
    dropouts: float = 0.02  # mean number of fades in a frame
    dropout_lines: float = DROPOUT_LINES
    luma_hz: float = LUMA_HZ
    chroma_hz: float = CHROMA_HZ
    chroma_noise: float = 1.0  # factor of the law of `low_pass_chroma`
    # time along a line over which luma noise decorrelates to 1/e; 0: flat in the luma band
    noise_s: float = 0.0

    def __post_init__(self) -> None:
        require_range("snr_db", self.snr_db, low=0.0, high=80.0)
        require_range("seed", self.seed, low=0)
        require_range("dropouts", self.dropouts, low=0.0, high=100.0)
        require_range("dropout_lines", self.dropout_lines, low=1.0, high=1000.0)
        for name in ("luma_hz", "chroma_hz"):
            require_range(name, getattr(self, name), low=0.1e6, high=20e6)
        require_range("chroma_noise", self.chroma_noise, low=0.0, high=100.0)
        require_range("noise_s", self.noise_s, low=0.0, high=1e-6)

    def apply(self, image: Pixels, frame_number: int, earlier: Pixels | None = None) -> Pixels:
        """The image as received.

        Args:
            image: (H, W, 3) uint8 RGB, at least 16 pixels a side.
            frame_number: from 0; each has its own noise.
            earlier: (H, W, 3) the view 1/60 s before, for the other field; None for a scene at
                rest.

        Returns:
            (H, W, 3) uint8 RGB.

        Raises:
            InputError: an image is no colour image, or the two differ in size.
        """
        import cv2

        _require_picture(image, earlier)
        number = int(require_range("frame_number", frame_number, low=0))
        rng = np.random.default_rng([self.seed, number])
        height, width = image.shape[:2]
        pixel_s = LINE_S / width
        shifts = line_shifts_s(height, self.snr_db, rng) / pixel_s
        fields = image.copy()
        if earlier is not None:
            fields[1::2] = earlier[1::2]  # interlaced: the odd lines are the earlier field's
        luma, chroma = to_luma_chroma(shift_lines(fields, shifts))
        noise = luma_noise(luma.shape, self.snr_db, pixel_s, rng, self.noise_s, self.luma_hz)
        add_clicks(noise, self.snr_db, pixel_s, rng)
        luma = low_pass_luma(luma, pixel_s, self.luma_hz)
        luma = np.asarray(cv2.add(luma, noise, dtype=cv2.CV_8U), np.uint8)  # rounds and clips
        chroma = low_pass_chroma(
            chroma, self.snr_db, pixel_s, rng, self.chroma_hz, self.chroma_noise
        )
        add_dropouts(luma, self.dropouts, rng, self.dropout_lines)
        return to_rgb(luma, chroma)


def scene_link(name: str) -> AnalogVideo | None:
    """Name of a scene that ships -> its analog link, measured on photos; None for a direct view.

    The links stand in analog.toml; of the scenes that ship only "hall_analog" has one.
    """
    links = tomllib.loads(Path(__file__).with_name("analog.toml").read_text(encoding="utf-8"))
    return AnalogVideo(**links[name]) if name in links else None


def carrier_to_noise(snr_db: float) -> float:
    """Carrier-to-noise power ratio in the channel of an FM video link.

    S/N = 12 D^2 (D + 1) C/N,  D = peak deviation / luma bandwidth
    [Roddy, Satellite Communications, eq. 9.23]
    """
    ratio = DEVIATION_HZ / LUMA_HZ
    return float(10.0 ** (snr_db / 10.0) / (12.0 * ratio**2 * (ratio + 1.0)))


def clicks_per_frame(snr_db: float) -> float:
    """Mean number of FM clicks, short bright or dark streaks, in a frame.

    B / sqrt(12) erfc(sqrt(C/N)) a second, B = 2 (deviation + bandwidth)
    [Rice, Noise in FM receivers, 1963; Carson]
    """
    channel_hz = 2.0 * (DEVIATION_HZ + LUMA_HZ)
    return channel_hz / math.sqrt(12.0) * math.erfc(math.sqrt(carrier_to_noise(snr_db))) * FRAME_S


def tear_chance(snr_db: float) -> float:
    """Probability that a line's sync pulse is missed: the noise exceeds half of the pulse.

    Flat noise scales with the square root of the bandwidth, here that of the sync separator.
    """
    noise = 10.0 ** (-snr_db / 20.0) * math.sqrt(SYNC_HZ / LUMA_HZ)  # in heights of white
    return 0.5 * math.erfc(0.5 * SYNC_SHARE / noise / math.sqrt(2.0))


def to_luma_chroma(image: Pixels) -> tuple[Pixels, Plane]:
    """Luma (H, W), and chroma (H, W / 4, 2), all that its bandwidth resolves [ITU-R BT.601]."""
    import cv2

    colours = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2YCrCb), np.uint8)
    size = max(image.shape[1] // 4, 1), image.shape[0]
    chroma = cv2.resize(colours, size, interpolation=cv2.INTER_AREA)
    return colours[..., 0], chroma[..., 1:].astype(np.float32)


def to_rgb(luma: Pixels, chroma: Plane) -> Pixels:
    """RGB image (H, W, 3) of luma (H, W) and chroma (H, W / 4, 2)."""
    import cv2

    narrow = np.clip(chroma + 0.5, 0.0, 255.0).astype(np.uint8)
    wide = cv2.resize(narrow, luma.shape[::-1], interpolation=cv2.INTER_LINEAR)
    merged = cv2.merge([luma, *cv2.split(wide)])
    return np.asarray(cv2.cvtColor(merged, cv2.COLOR_YCrCb2RGB), np.uint8)


def low_pass_luma(luma: Pixels, pixel_s: float, luma_hz: float = LUMA_HZ) -> Pixels:
    """Luma (H, W) behind a low-pass of the luma bandwidth."""
    import cv2

    return np.asarray(cv2.sepFilter2D(luma, -1, _low_pass(pixel_s, luma_hz), np.ones(1)), np.uint8)


def low_pass_chroma(
    chroma: Plane,
    snr_db: float,
    pixel_s: float,
    rng: np.random.Generator,
    chroma_hz: float = CHROMA_HZ,
    chroma_noise: float = 1.0,
) -> Plane:
    """Chroma (H, W / 4, 2) with noise, behind the decoder's causal first-order low-pass.

    White noise of the luma band, demodulated from both sides of the subcarrier:
    sd = sd_luma sqrt(2 B_chroma / B_luma), times chroma_noise where a link was measured.
    """
    import cv2

    # Backward Euler keeps the filter's mean lag.
    decay = 1.0 / (1.0 + 2.0 * math.pi * chroma_hz * 4.0 * pixel_s)
    tail = decay ** np.arange(12)
    tail /= tail.sum()
    kernel = np.concatenate([tail[::-1], np.zeros(11)])  # sepFilter2D correlates: past on the left
    share = math.sqrt(2.0 * chroma_hz / LUMA_HZ)
    sigma = chroma_noise * _sigma(snr_db) * share / np.linalg.norm(tail)
    noise = rng.standard_normal(chroma.shape, np.float32) * np.float32(sigma)
    return np.asarray(cv2.sepFilter2D(chroma + noise, -1, kernel, np.ones(1)), np.float32)


def luma_noise(
    shape: tuple[int, ...],
    snr_db: float,
    pixel_s: float,
    rng: np.random.Generator,
    noise_s: float = 0.0,
    luma_hz: float = LUMA_HZ,
) -> Plane:
    """Noise (H, W) [grey levels] of the luma band; rms 255 / 10^(snr_db / 20).

    Thermal noise is flat in the band, due to emphasis. That of a measured link may be smoother: it
    is then also filtered by exp(-|t| / noise_s) along the line.
    """
    import cv2

    kernel = _low_pass(pixel_s, luma_hz)
    if noise_s:
        kernel = np.convolve(kernel, np.exp(-np.abs(np.arange(-12, 13)) * pixel_s / noise_s))
    white = rng.standard_normal(shape, np.float32)
    gain = _sigma(snr_db) / np.linalg.norm(kernel)  # white noise keeps sum(kernel^2) of its power
    return np.asarray(cv2.sepFilter2D(white, -1, gain * kernel, np.ones(1)), np.float32)


def add_clicks(noise: Plane, snr_db: float, pixel_s: float, rng: np.random.Generator) -> None:
    """Add streaks to the noise (H, W): of the height of white, either sign, and decaying."""
    height, width = noise.shape
    number = rng.poisson(clicks_per_frame(snr_db))
    rows, columns = rng.integers(0, height, number), rng.integers(0, width, number)
    signs = rng.choice((-255.0, 255.0), number).astype(np.float32)
    decay = math.exp(-pixel_s / CLICK_DECAY_S)
    for k in range(math.ceil(3.0 * CLICK_DECAY_S / pixel_s)):
        inside = columns + k < width
        np.add.at(noise, (rows[inside], columns[inside] + k), signs[inside] * np.float32(decay**k))


def line_shifts_s(height: int, snr_db: float, rng: np.random.Generator) -> Array:
    """Delay of each line (H,) [s]: its oscillator follows noisy sync edges, or none when missed.

    An edge is timed with an error of rise time * noise / height; the lock is of first order.
    """
    edge_s = RISE_S * 10.0 ** (-snr_db / 20.0) / SYNC_SHARE * rng.standard_normal(height)
    jitter = np.convolve(edge_s, (1.0 - LOCK) * LOCK ** np.arange(16))[:height]
    lost = rng.random(height) < tear_chance(snr_db)
    jumps = np.where(lost, rng.uniform(-0.1, 0.1, height) * LINE_S, 0.0)
    return np.asarray(jitter + np.convolve(jumps, TEAR_LOCK ** np.arange(40))[:height], np.float64)


def shift_lines(image: Pixels, shifts_px: Array) -> Pixels:
    """Each line of (H, W, 3) moved to the right by its shift (H,) [px]; the edge pixel repeats."""
    import cv2

    height, width = image.shape[:2]
    x = np.arange(width, dtype=np.float32) - shifts_px.astype(np.float32)[:, None]
    y = np.repeat(np.arange(height, dtype=np.float32)[:, None], width, axis=1)
    shifted = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(shifted, np.uint8)


def add_dropouts(
    luma: Pixels, dropouts: float, rng: np.random.Generator, dropout_lines: float = DROPOUT_LINES
) -> None:
    """Replace bands of lines by noise: their number is Poisson, their lengths geometric."""
    for _ in range(rng.poisson(dropouts)):
        row, lines = int(rng.integers(0, luma.shape[0])), int(rng.geometric(1.0 / dropout_lines))
        band = luma[row : row + lines]
        band[:] = rng.integers(0, 256, band.shape, dtype=np.uint8)


def _sigma(snr_db: float) -> float:
    """Rms luma noise [grey levels]."""
    return float(255.0 * 10.0 ** (-snr_db / 20.0))


def _low_pass(pixel_s: float, luma_hz: float = LUMA_HZ) -> Array:
    """Windowed sinc (15,) along a line, with gain one half at the luma bandwidth [Hamming window].

    An image too coarse for the band, 320 pixels wide, passes unchanged.
    """
    cycles = min(luma_hz * pixel_s, 0.5)  # per pixel
    kernel = 2.0 * cycles * np.sinc(2.0 * cycles * np.arange(-7, 8)) * np.hamming(15)
    return np.asarray(kernel / kernel.sum(), np.float64)


def _require_picture(image: Pixels, earlier: Pixels | None) -> None:
    """Raise InputError unless both are RGB bytes of one size; the earlier one may be missing."""
    for picture in (image,) if earlier is None else (image, earlier):
        shape: tuple[int, ...] = getattr(picture, "shape", ())
        kind = getattr(picture, "dtype", type(picture).__name__)
        if len(shape) != 3 or shape[2] != 3 or kind != np.uint8 or min(shape[:2]) < MIN_SIDE_PX:
            raise InputError(
                f"analog video: expected (H, W, 3) uint8 of {MIN_SIDE_PX} pixels or more,"
                f" got {shape} {kind}"
            )
    if earlier is not None and earlier.shape != image.shape:
        raise InputError(f"earlier: expected the image's size, {image.shape}, got {earlier.shape}")
