"""Streams of steps with a camera, a pilot and one fault, drawn at random, for the supervisor."""

import math
from dataclasses import dataclass

import numpy as np

from falconwing_kit.core.messages import Command, Image, State
from falconwing_kit.flight.supervisor import Supervisor, SupervisorSettings

PERIOD = 0.05
FLIGHT_S, BEFORE_S = 6.0, (1.0, 4.0)  # of a flight; when its fault begins
FAULTS = {  # what happens -> the longest time until it must be noticed [s]
    "camera stops": 0.4 + PERIOD,
    "same image under new numbers": 5 * 0.12 + PERIOD,  # five images, at most 120 ms apart
    "late images": 0.4 + PERIOD,
    "pilot stops seeing": 0.4 + PERIOD,
    "nan": PERIOD,
    "exception": PERIOD,
    "overrun": PERIOD,
    "rolls over": PERIOD,
    "noses over": PERIOD,
    "climbs away": PERIOD,
    "battery": PERIOD,
}


@dataclass
class Camera:
    """30 images a second, each 30 to 120 ms old when it arrives, one in twenty lost."""

    rng: np.random.Generator

    def __post_init__(self) -> None:
        self.sequence, self.newest, self.extra_delay = -1, None, 0.0
        self.stopped = self.frozen = False
        self._waiting: list[Image] = []
        self._next = 0.0

    def newest_at(self, t: float) -> Image | None:
        """The newest image that has arrived by t [s]."""
        while self._next <= t:
            self.sequence += 1
            if self.rng.random() > 0.05 and not self.stopped:
                pixels = self.rng.integers(0, 256, (24, 32, 3), np.uint8)
                if self.frozen and self._waiting:
                    pixels = self._waiting[-1].pixels
                self._waiting.append(Image(self.sequence, self._next, pixels))
            self._next += 1.0 / 30.0
        latency = self.rng.uniform(0.03, 0.12) + self.extra_delay
        there = [image for image in self._waiting if image.t <= t - latency]
        if there and (self.newest is None or there[-1].sequence > self.newest.sequence):
            self.newest = there[-1]
        self._waiting = self._waiting[-40:]
        return self.newest


def fly(rng: np.random.Generator, fault: str, seconds: float = FLIGHT_S) -> tuple[float, float]:
    """One flight with a fault ("": none): when it began and when it was noticed [s]; inf: never."""
    began = rng.uniform(*BEFORE_S) if fault else math.inf
    settings = SupervisorSettings(battery_s=began if fault == "battery" else math.inf)
    supervisor, camera = Supervisor(settings, by_images=True), Camera(rng)
    last = answered = None
    for k in range(round(seconds / PERIOD)):
        t = k * PERIOD
        is_faulty = t >= began
        camera.stopped = is_faulty and fault == "camera stops"
        camera.frozen = is_faulty and fault == "same image under new numbers"
        camera.extra_delay = rng.uniform(0.5, 1.0) if is_faulty and fault == "late images" else 0.0
        image = camera.newest_at(t)
        if is_faulty and fault == "late images":
            image = Image(last.sequence + 1, t - camera.extra_delay, last.pixels ^ (k % 256))
        if image is not None and image is not last:
            supervisor.see(image, t)
            last = image
        if not (is_faulty and fault == "pilot stops seeing"):
            answered = last
        value = math.nan if is_faulty and fault == "nan" else rng.uniform(-1.0, 1.0)
        command = Command(0.5, value, 0.0, 0.0, -1 if answered is None else answered.sequence)
        failed = is_faulty and fault == "exception"
        pilot_s = rng.lognormal(math.log(0.01), 0.5)
        pilot_s += rng.uniform(0.2, 2.0) if is_faulty and fault == "overrun" else 0.0
        state = _state(rng, fault if is_faulty else "")
        if supervisor.check(t, None if failed else command, state, pilot_s):
            return began, t
    return began, math.inf


def _state(rng: np.random.Generator, fault: str) -> State:
    """A state in the middle of the envelope, or outside of it."""
    bank, pitch = np.radians(rng.uniform((-60.0, -30.0), (60.0, 30.0)))
    height = rng.uniform(0.0, 4.0)
    if fault == "rolls over":
        bank = np.radians(rng.uniform(81.0, 279.0))
    elif fault == "noses over":
        pitch = math.copysign(np.radians(rng.uniform(61.0, 89.0)), pitch)
    elif fault == "climbs away":
        height = rng.uniform(4.7, 20.0)
    return State(np.array([0.0, 0.0, height]), pitch, 0.3, bank, np.array([7.0, 0.0, 0.0]))
