"""Delays on the bench: trainer port, LED and camera -> delay from light to image, and to pulse.

The LED on the board's pin 13 is on while the board is ACTIVE. A hand-back switches it off when it
arrives, at any moment between two images. Each image then shows how much of its exposure the LED
was on; over many hand-backs the images sample the fall of its brightness at many delays, as a
sampling oscilloscope does (equivalent-time sampling), far more finely than the camera's period.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.messages import CONTROL_PERIOD_S, SAFE_COMMAND, Image
from falconwing_kit.flight.loop import ImageSource
from falconwing_kit.trainer_port.clock import BYTE_S
from falconwing_kit.trainer_port.port import TrainerPort
from falconwing_kit.trainer_port.protocol import encode_channels
from falconwing_kit.vision.images import to_grey

POLL_S = 0.001  # between two looks for an image
ENGAGE_S = 5.0  # longest wait for the board to follow
DARK_S = 0.5  # observed after a hand-back; longer delays are refused
MIN_CONTRAST = 20.0  # of the LED in the image [grey levels]
MIN_CYCLES = 10
RAMPS_S = np.arange(0.004, 0.0605, 0.003)  # durations of the fall that are tried: the exposure
RESOLUTION_S = 0.00025  # of the delays that are tried
RESAMPLES = 200  # of the hand-backs, for the error
MAX_ERROR_S = 0.002  # of a delay that is written

Sleep = Callable[[float], Any]


@dataclass(frozen=True)
class LatencyFit:
    """Delays [s], means over the PPM frame's phase."""

    led_s: float  # command sent -> its light in an image at this computer: measured
    error95_s: float  # of it, half of the interval
    exposure_s: float  # duration of the fall in the images: exposure and jitter
    link_s: float  # command sent -> read by the board: bytes on the wire and half of a round trip
    camera_s: float  # light -> image at this computer
    pulse_s: float  # command sent -> last pulse of the first PPM frame that carries it
    camera_to_pulse_s: float  # camera_s + pulse_s
    cycles: int


@dataclass(frozen=True)
class FrameTimes:
    """How regularly images arrive."""

    rate_hz: float
    jitter_s: float  # standard deviation of arrivals about a regular grid
    lost_share: float  # of the grid's images that did not come
    images: int


@dataclass(frozen=True)
class PpmTimes:
    """What the board reports about its pulses, at rest."""

    frame_us: float  # from one frame to the next, on the board's clock
    channels_us: tuple[int, ...]
    clock_ppm: float  # frequency error of the board's clock against this computer's [1e-6]


def measure_frames(
    images: ImageSource, now: Callable[[], float], sleep: Sleep, seconds: float = 5.0
) -> FrameTimes:
    """Rate and jitter of a camera, from the times at which its images arrive.

    Raises:
        InputError: fewer than ten images came.
    """
    arrivals = [image.t for image in _watch(images, now, sleep, now() + seconds)]
    if len(arrivals) < 10:
        raise InputError(
            f"camera: expected ten images or more in {seconds:g} s, got {len(arrivals)}; is it"
            " plugged in, and is it this one (--camera)?"
        )
    t = np.array(arrivals)
    steps = np.maximum(np.round(np.diff(t) / np.median(np.diff(t))), 1.0)
    number = np.concatenate([[0.0], np.cumsum(steps)])  # lost images leave a gap in it
    period, zero = np.polyfit(number, t, 1)
    residual = t - (period * number + zero)
    lost = 1.0 - len(t) / (number[-1] + 1.0)
    return FrameTimes(1.0 / float(period), float(residual.std(ddof=2)), float(lost), len(t))


def measure_ppm(port: TrainerPort, sleep: Sleep, seconds: float = 5.0) -> PpmTimes:
    """Period and levels of the pulses at rest, from the board's STATUS.

    Raises:
        InputError: the board stopped answering, or sends no pulses.
    """
    readings: list[tuple[int, int]] = []
    end = port.now() + seconds
    while port.now() < end:
        port.poll()
        if port.status is not None:
            reading = (port.status.ppm_frames, port.status.device_time_us)
            if not readings or reading != readings[-1]:
                readings.append(reading)
        sleep(POLL_S)
    frames, device_us = np.array(readings, np.float64).reshape(-1, 2).T
    if port.status is None or port.state != "open" or len(frames) < 10 or np.ptp(frames) < 10:
        raise InputError(
            f"{port.what or 'board'}: expected pulses and a STATUS 20 times a second, got"
            f" {len(frames)} with {np.ptp(frames) if len(frames) else 0:.0f} frames; see"
            " falconwing bridge"
        )
    period_us = float(np.polyfit(frames, device_us, 1)[0])
    return PpmTimes(period_us, port.status.channels_us, float(port.clock.drift_ppm))


def measure_latency(
    port: TrainerPort,
    images: ImageSource,
    sleep: Sleep,
    ppm: PpmTimes,
    cycles: int = 60,
    seed: int = 0,
    progress: Callable[[], Any] = lambda: None,
) -> LatencyFit:
    """Switch the LED and watch it in the images; aircraft absent, propeller off.

    Args:
        port: ready; its clock is that of the images. Commands are idle and neutral.
        images: the camera, which sees the LED; the time of an image is that of its arrival.
        sleep: waits [s]; for a simulated board it advances that.
        ppm: of `measure_ppm`.
        cycles: hand-backs, each at a moment drawn at random.
        seed: of these moments.
        progress: called after each.

    Raises:
        InputError: the board does not engage, the LED is not seen, or the result is too uncertain.
    """
    rng = np.random.default_rng(seed)
    mask = _find_led(port, images, sleep)
    falls: list[Array] = []
    for _ in range(cycles):
        falls.append(_watch_fall(port, images, sleep, mask, rng.uniform(0.0, 0.1)))
        progress()
    led_s, exposure_s, error95_s = fit_fall(falls)
    if error95_s > MAX_ERROR_S:
        raise InputError(
            f"LED: expected its delay to {1e3 * MAX_ERROR_S:g} ms, got {1e3 * led_s:.0f} +-"
            f" {1e3 * error95_s:.1f}; more --cycles, and a camera with a fixed exposure"
        )
    command = encode_channels(0, port.calibration.channels_us(SAFE_COMMAND), True)
    link_s = len(command) * BYTE_S + 0.5 * port.clock.round_trip
    # A command waits half a frame for the next one on average, and its channels follow each other.
    pulse_s = link_s + 1e-6 * (0.5 * ppm.frame_us + sum(ppm.channels_us))
    camera_s = led_s - link_s
    return LatencyFit(
        led_s, error95_s, exposure_s, link_s, camera_s, pulse_s, camera_s + pulse_s, cycles
    )


def fit_fall(falls: Sequence[Array]) -> tuple[float, float, float]:
    """Delay and duration of the fall that many hand-backs sampled.

    brightness(tau) = 1 - clip((tau - delay) / duration + 1/2, 0, 1), by least squares.

    Args:
        falls: (N, 2) of each hand-back: time since it [s], brightness.

    Returns:
        The delay of the fall's middle and its duration [s], and half of the delay's 95 % interval,
        by the bootstrap over hand-backs.

    Raises:
        InputError: too few hand-backs.
    """
    if len(falls) < MIN_CYCLES:
        raise InputError(
            f"LED: expected {MIN_CYCLES} hand-backs or more, got {len(falls)}; more --cycles"
        )
    coarse = np.arange(0.0, DARK_S - 0.1, 16 * RESOLUTION_S)
    about, _ = _best(_squares(falls, coarse, RAMPS_S[::4]).sum(axis=0), coarse, RAMPS_S[::4])
    near = about + np.arange(-0.012, 0.012, RESOLUTION_S)
    squares = _squares(falls, near, RAMPS_S)
    delay, duration = _best(squares.sum(axis=0), near, RAMPS_S)
    rng = np.random.default_rng(len(falls))
    counts = rng.multinomial(len(falls), np.full(len(falls), 1.0 / len(falls)), RESAMPLES)
    drawn = np.tensordot(counts, squares, axes=1)  # (RESAMPLES, durations, delays)
    spread = float(np.std([_best(each, near, RAMPS_S)[0] for each in drawn]))
    return delay, duration, max(1.96 * spread, RESOLUTION_S)


def _squares(falls: Sequence[Array], delays: Array, durations: Array) -> Array:
    """Squared errors of each hand-back: (falls, durations, delays)."""
    squares = np.empty((len(falls), len(durations), len(delays)))
    for number, (tau, brightness) in enumerate(fall.T for fall in falls):
        late = tau - delays[:, None]
        for row, duration in enumerate(durations):
            model = 1.0 - np.clip(late / duration + 0.5, 0.0, 1.0)
            squares[number, row] = ((model - brightness) ** 2).sum(axis=1)
    return squares


def _best(squares: Array, delays: Array, durations: Array) -> tuple[float, float]:
    """The pair of the grid with the least squared error."""
    row, column = divmod(int(squares.argmin()), len(delays))
    # Without noise many delays between two images fit equally well: their middle.
    equal = np.flatnonzero(squares[row] <= squares[row, column] + 1e-9)
    return float(delays[equal].mean()), float(durations[row])


def _engage(port: TrainerPort, images: ImageSource, sleep: Sleep) -> None:
    """Command idle and neutral until the board is ACTIVE."""
    port.send(SAFE_COMMAND, engage=False)
    end = port.now() + ENGAGE_S
    while port.engagement != "engaged":
        if port.now() > end:
            state = port.status.state if port.status else "nothing"
            raise InputError(
                f"{port.what or 'board'}: expected it to engage at idle and neutral, got {state};"
                " switch the radio off, and see falconwing bridge"
            )
        _hold(port, images, sleep, CONTROL_PERIOD_S)


def _hold(port: TrainerPort, images: ImageSource, sleep: Sleep, seconds: float) -> list[Image]:
    """Command idle and neutral at 20 Hz; the images of that time."""
    seen, end = [], port.now() + seconds
    while (t := port.now()) < end - 1e-9:
        port.send(SAFE_COMMAND, engage=True)
        seen += _watch(images, port.now, sleep, min(t + CONTROL_PERIOD_S, end), port)
    return seen


def _find_led(port: TrainerPort, images: ImageSource, sleep: Sleep) -> NDArray[np.bool_]:
    """(H, W) the pixels that the LED lights."""
    _engage(port, images, sleep)
    _hold(port, images, sleep, DARK_S)  # longer than any delay
    lit = _hold(port, images, sleep, DARK_S)
    port.hand_back()
    _watch(images, port.now, sleep, port.now() + DARK_S, port)
    dark = _watch(images, port.now, sleep, port.now() + DARK_S, port)
    if not lit or not dark:
        raise InputError("camera: expected images while the LED was switched, got none")
    on, off = (
        np.mean([to_grey(image.pixels) for image in some], axis=0, dtype=np.float64)
        for some in (lit, dark)
    )
    rise = on - off
    contrast = float(np.percentile(rise, 99.9))
    if contrast < MIN_CONTRAST:
        raise InputError(
            f"LED: expected the light of pin 13 in the image, {MIN_CONTRAST:g} grey levels or more,"
            f" got {contrast:.0f}; hold the camera some centimetres above it, and darken the room"
        )
    return np.asarray(rise > 0.5 * contrast)


def _watch_fall(
    port: TrainerPort, images: ImageSource, sleep: Sleep, mask: NDArray[np.bool_], extra: float
) -> Array:
    """One hand-back: (N, 2) time of each image since it [s], brightness from 1 to 0."""
    _engage(port, images, sleep)
    _hold(port, images, sleep, DARK_S)
    lit = _hold(port, images, sleep, 0.2 + extra)
    t_off = port.now()
    port.hand_back()
    after = _watch(images, port.now, sleep, t_off + DARK_S, port)
    samples = np.array(
        [(image.t - t_off, to_grey(image.pixels)[mask].mean()) for image in (*lit, *after)]
    )
    on = float(np.median(samples[samples[:, 0] < 0.0, 1]))
    off = float(np.median(samples[samples[:, 0] > DARK_S - 0.1, 1]))
    if not on - off >= 0.5 * MIN_CONTRAST:  # nan, too, where images are missing
        raise InputError(
            f"LED: expected it to go dark within {DARK_S:g} s of each hand-back, got brightness"
            f" {on:.0f} before and {off:.0f} after; hold camera and board still"
        )
    samples[:, 1] = (samples[:, 1] - off) / (on - off)
    return samples


def _watch(
    images: ImageSource, now: Callable[[], float], sleep: Sleep, end: float,
    port: TrainerPort | None = None,
) -> list[Image]:  # fmt: skip
    """The new images until a time, each once; a port is polled meanwhile."""
    first = images.next_image(now())
    newest, seen = -1 if first is None else first.sequence, []
    while now() < end - 1e-9:
        sleep(min(POLL_S, end - now()))
        if port is not None:
            port.poll()
        image = images.next_image(now())
        if image is not None and image.sequence != newest:
            newest = image.sequence
            seen.append(image)
    return seen
