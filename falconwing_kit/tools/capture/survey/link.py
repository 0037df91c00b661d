"""Video link identification: photos with and without the link -> `AnalogVideo` parameters.

The two sets need not show the same views, only the same place. The parameters are those with which
clean photos, sent through the model, have the same statistics as the transmitted ones (method of
simulated moments). Texture and JPEG compression affect both sets in the same way.

    falconwing scene link PHOTOS_ANALOG PHOTOS
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.scene.analog import LINE_S, AnalogVideo
from falconwing_kit.tools.capture.photo_files import read_photo

Pixels = NDArray[np.uint8]
BLOCK = (16, 32)  # rows and columns of a block [px]
FLAT = 0.2  # share of the blocks that count as flat: those with the least variance
LUMA_BANDS = np.array([4, 8, 16, 32, 64, 96, 128, 192, 256, 320])  # cycles a line
CHROMA_BANDS = np.array([2, 4, 8, 16, 32, 64])
REFERENCE_BANDS = 2  # lowest bands, unaffected by the link: they normalise different views
LUMA_GRID, CHROMA_GRID = np.arange(1.5e6, 6.01e6, 0.1e6), np.arange(0.2e6, 1.51e6, 0.05e6)  # [Hz]
NOISE_ITERATIONS = 4  # of fitting the noise
JPEG_QUALITY = 90  # of the simulated photos, as of the real ones
FADE, MIN_FADE = 6.0, 3.0  # noise of a lost line: multiple of the photo's median, plus grey levels
MAX_PHOTOS = 24  # clean photos that are sent through the model; more change no result by a tenth


@dataclass(frozen=True, eq=False)
class ImageStatistics:
    """Image statistics that a video link changes: medians over the photos."""

    luma_noise: float  # rms noise of flat areas [grey levels]
    correlation: float  # of the noise with that one pixel to the right
    chroma_noise: float  # rms, of red and blue difference [grey levels]
    luma: Array  # (9,) log amplitude in LUMA_BANDS, relative to the reference bands
    chroma: Array  # (5,) of the red and blue difference in CHROMA_BANDS
    fades: float  # dropouts per photo
    fade_lines: float  # mean length of a dropout, NaN without one


def image_statistics(images: Sequence[Pixels]) -> ImageStatistics:
    """Statistics of a set of photos.

    Args:
        images: (H, W, 3) uint8 RGB, of one size, at least 64 pixels a side.

    Raises:
        InputError: there are none.
    """
    if not images:
        raise InputError("link: expected at least one photo to measure, got none")
    lengths = [length for image in images for length in _fades(_planes(image)[0])]
    return ImageStatistics(
        *_noise(images),
        luma=_log_amplitude(images, "luma"),
        chroma=_log_amplitude(images, "chroma"),
        fades=len(lengths) / len(images),
        fade_lines=float(np.mean(lengths)) if lengths else math.nan,
    )


def measure_link(through: Sequence[Pixels], clean: Sequence[Pixels]) -> AnalogVideo:
    """The link with which the clean photos have the statistics of the transmitted ones.

    Args:
        through: photos (H, W, 3) that came through the link.
        clean: photos without it, of the same place and size.

    Raises:
        InputError: a set is empty, or the sizes differ.
    """
    if {image.shape for image in through} != {image.shape for image in clean} or not through:
        raise InputError(
            "link: expected photos of one size in both sets, got others; "
            "scale them to the link's size"
        )
    target, clean_statistics, width = (
        image_statistics(through),
        image_statistics(clean),
        through[0].shape[1],
    )
    noise = math.sqrt(max(target.luma_noise**2 - clean_statistics.luma_noise**2, 0.01))
    link = AnalogVideo(20.0 * math.log10(255.0 / noise), chroma_noise=0.2, dropouts=target.fades)
    link = replace(link, dropout_lines=target.fade_lines) if target.fades else link
    for _ in range(2):  # noise and sharpness share the higher bands
        link = _fit_noise(link, target, clean_statistics, clean, LINE_S / width)
        link = _fit_bandwidth(link, target, clean, "luma", LUMA_GRID)
        link = _fit_bandwidth(link, target, clean, "chroma", CHROMA_GRID)
    return replace(link, snr_db=round(link.snr_db, 1))


def transmit(link: AnalogVideo, clean: Sequence[Pixels]) -> list[Pixels]:
    """Clean photos (H, W, 3) after the simulated link and JPEG compression."""
    return [_jpeg(link.apply(image, number)) for number, image in enumerate(clean)]


def _fit_noise(
    link: AnalogVideo,
    target: ImageStatistics,
    clean_statistics: ImageStatistics,
    clean: Sequence[Pixels],
    pixel_s: float,
) -> AnalogVideo:
    """The link with matching noise, corrected iteratively by simulation."""
    for _ in range(NOISE_ITERATIONS):
        luma_noise, correlation, chroma_noise = _noise(transmit(link, clean))
        target_noise, simulated_noise = (
            math.sqrt(max(noise**2 - clean_statistics.luma_noise**2, 1e-3))
            for noise in (target.luma_noise, luma_noise)
        )
        snr_db = link.snr_db + 20.0 * math.log10(simulated_noise / target_noise)
        target_chroma = max(target.chroma_noise**2 - clean_statistics.chroma_noise**2, 0.0) ** 0.5
        simulated_chroma = max(chroma_noise**2 - clean_statistics.chroma_noise**2, 1e-4) ** 0.5
        decay = (
            _decay(target.correlation)
            * _decay(_correlation_from_noise_s(link.noise_s, pixel_s))
            / _decay(correlation)
        )
        link = replace(
            link,
            snr_db=float(np.clip(snr_db, 10.0, 70.0)),
            chroma_noise=float(
                np.clip(link.chroma_noise * target_chroma / simulated_chroma, 0.0, 3.0)
            ),
            noise_s=-pixel_s / math.log(min(max(decay, 0.05), 0.9)),
        )
    return link


def _decay(correlation: float) -> float:
    """d of a filter d^|k| whose noise correlates by 2 d / (1 + d^2) between neighbouring pixels."""
    rho = min(max(correlation, 0.01), 0.999)
    return (1.0 - math.sqrt(1.0 - rho**2)) / rho


def _correlation_from_noise_s(noise_s: float, pixel_s: float) -> float:
    """Noise correlation of neighbouring pixels for a `noise_s`; that of white noise for 0."""
    d = math.exp(-pixel_s / noise_s) if noise_s else 0.24
    return 2.0 * d / (1.0 + d**2)


def _fit_bandwidth(
    link: AnalogVideo, target: ImageStatistics, clean: Sequence[Pixels], name: str, grid: Array
) -> AnalogVideo:
    """The link with the bandwidth of least L1 distance between log spectra.

    The sum of absolute values is robust against a single odd band, such as the colour carrier's.
    """
    changes: list[dict[str, Any]] = [{f"{name}_hz": float(hertz)} for hertz in grid]
    links = [replace(link, **change) for change in changes]
    some = clean[:: max(1, len(clean) // 6)]
    want = getattr(target, name) - _log_amplitude(clean, name) + _log_amplitude(some, name)
    off = [np.abs(_log_amplitude(transmit(one, some), name) - want).sum() for one in links]
    return links[int(np.argmin(off))]


def _noise(images: Sequence[Pixels]) -> tuple[float, float, float]:
    """The first three of `ImageStatistics`."""
    covariances = [[_grain(plane) for plane in _planes(image)] for image in images]
    grain = np.median(covariances, axis=0)
    correlation = float(grain[0, 1] / max(grain[0, 0], 1e-9))
    return math.sqrt(grain[0, 0]), correlation, math.sqrt(grain[1:, 0].mean())


def _planes(image: Pixels) -> list[Array]:
    """Luma, red and blue difference, (H, W) each."""
    import cv2

    colours = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2YCrCb)
    return [plane.astype(np.float64) for plane in cv2.split(colours)]


def _grain(plane: Array) -> Array:
    """(2,) variance of the grain in flat places, and its covariance with the pixel to the right.

    The difference of a line from the mean of its neighbours has 3/2 of the variance of white noise
    and suppresses the scene.
    """
    across = (plane[1:-1] - 0.5 * (plane[:-2] + plane[2:])) / math.sqrt(1.5)
    rows, columns = BLOCK
    high, wide = across.shape[0] // rows, across.shape[1] // columns
    whole = across[: high * rows, : wide * columns].reshape(high, rows, wide, columns)
    blocks = whole.swapaxes(1, 2).reshape(-1, rows, columns)
    spread = blocks.var(axis=(1, 2))
    flat = blocks[spread <= np.quantile(spread, FLAT)]
    return np.array([(flat**2).mean(), (flat[..., 1:] * flat[..., :-1]).mean()])


def _log_amplitude(images: Sequence[Pixels], name: str) -> Array:
    """Log amplitude by frequency of "luma" or "chroma", as in `ImageStatistics`."""
    planes, bands = {"luma": (slice(0, 1), LUMA_BANDS), "chroma": (slice(1, 3), CHROMA_BANDS)}[name]
    spectra = [[_spectrum(plane) for plane in _planes(image)[planes]] for image in images]
    return _bands(np.median(spectra, axis=0).mean(axis=0), bands)


def _spectrum(plane: Array) -> Array:
    """(W / 2 + 1,) mean power of the lines, by cycles per line."""
    lines = plane - plane.mean(axis=1, keepdims=True)
    return np.asarray(
        (np.abs(np.fft.rfft(lines * np.hanning(plane.shape[1]), axis=1)) ** 2).mean(axis=0)
    )


def _bands(power: Array, edges: Array) -> Array:
    """Log amplitude in bands, relative to the mean of the first bands."""
    bands = np.array([power[low:high].mean() for low, high in pairwise(edges)])
    log = 0.5 * np.log(bands + 1e-9)
    return np.asarray(log - log[:REFERENCE_BANDS].mean())


def _fades(luma: Array) -> list[int]:
    """Lengths of the dropouts: runs of lines lost in noise."""
    grain = np.abs(luma[1:-1] - 0.5 * (luma[:-2] + luma[2:])).mean(axis=1)
    lost = np.concatenate([[0], grain > FADE * np.median(grain) + MIN_FADE, [0]])
    starts, ends = (np.flatnonzero(np.diff(lost.astype(int)) == sign) for sign in (1, -1))
    return [int(end - start) for start, end in zip(starts, ends, strict=True)]


def _jpeg(image: Pixels) -> Pixels:
    import cv2

    data = cv2.imencode(".jpg", image[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)[..., ::-1]


def read_photos(folder: Path) -> list[Pixels]:
    """All photos (H, W, 3) of a folder, by name; InputError for fewer than two."""
    paths = sorted(
        path for path in folder.glob("*") if path.suffix.lower() in (".jpg", ".jpeg", ".png")
    )
    if len(paths) < 2:
        raise InputError(f"{folder}: expected two photos or more (.jpg, .png), got {len(paths)}")
    return [read_photo(path)[..., :3] for path in paths]


def subsample(images: list[Pixels]) -> list[Pixels]:
    """At most MAX_PHOTOS, evenly spread over all."""
    return [images[k] for k in np.unique(np.linspace(0, len(images) - 1, MAX_PHOTOS).astype(int))]
