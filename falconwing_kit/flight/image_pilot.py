"""Image pilot: images and past commands -> commands, by a trained policy alone; no state is read.

image -> features (new images only) ; features, past commands, memory -> command
"""

import math

import numpy as np

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.messages import SAFE_COMMAND, Command, Image, Observation
from falconwing_kit.flight.pose_pilot import finite_commands, is_repeated
from falconwing_kit.flight.sources import decode_jpeg
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.vision.images import Pixels
from falconwing_kit.vision.layers import SMALLEST_DEVIATION, Array32
from falconwing_kit.vision.occlusion import Seen
from falconwing_kit.vision.policy import Policy, policy_inputs

LOST_AFTER_S = 1.0  # without a new image the commands are guesses; training had 0.55 s at most
LEAST_CORRELATION = 0.05  # of neighbouring pixels in a picture
TIME_ROUNDING = 1e-6  # [s]


class ImagePilot:
    """Flies by a policy; without a new image it flies on by its memory."""

    reads_state = False  # the loop of a trial gives it none

    def __init__(self, policy: Policy, camera: PinholeCamera, p_body_camera: Array) -> None:
        """Take a policy for a camera.

        Args:
            policy: that flies.
            camera: the lens; images of another size are not used.
            p_body_camera: (3,) its position in body axes [m].

        Raises:
            InputError: the camera lacks more than a quarter of the trained field of view.
        """
        self.policy, self._camera, self._p_body_camera = policy, camera, p_body_camera
        policy.encode(policy.resample(_black(camera), camera))  # refuses, and warms up
        self.reset()

    def reset(self) -> None:
        """Begin a new flight."""
        self._memory = self.policy.start_memory()
        self._features = np.zeros(self.policy.shape.features, np.float32)
        self._last: Image | None = None  # the newest image that was used
        self._pixels: Array32 | None = None  # of it, resampled
        self.seen: Seen | None = None  # what the last command was made of; None before an image
        self._begin = math.nan  # time of the first step [s]
        self.mode = "approach"

    def act(self, observation: Observation) -> Command:
        """The policy's command; the safe command where there was no new image for a second."""
        t = observation.t
        if math.isnan(self._begin):
            self._begin = t
        note = self._look(observation.image, t)
        seen_at = self._begin if self._last is None else self._last.t
        if note and t - seen_at > LOST_AFTER_S + TIME_ROUNDING:
            self.mode = f"lost: {note}"
            return SAFE_COMMAND
        self.mode = f"policy, predicting: {note}" if note else "policy"
        age = math.nan if self._last is None else t - self._last.t
        past_commands = finite_commands(observation.past_commands)
        inputs = policy_inputs(past_commands, age, self._p_body_camera, self.policy.shape.history)
        if self._pixels is not None:
            self.seen = Seen(self._pixels, inputs, self._memory)
        commands, self._memory = self.policy.step(self._features, inputs, self._memory)
        sequence = -1 if self._last is None else self._last.sequence
        throttle, aileron, elevator, rudder = commands.tolist()
        return Command.clip(throttle, aileron, elevator, rudder, image_sequence=sequence)

    def _look(self, image: Image | None, t: float) -> str:
        """Take in an image; why not, or ""."""
        if image is None:
            return "no image"
        if self._last is not None and is_repeated(image, self._last):
            return "repeated image"
        if not math.isfinite(image.t) or image.t > t + TIME_ROUNDING:
            return "image of a wrong time"
        if not isinstance(image.pixels, np.ndarray):
            return "image of another size or kind"
        try:
            pixels = self.policy.resample(decode_jpeg(image), self._camera)
        except InputError:
            return "image of another size or kind"
        if note := blank_or_noise(pixels):
            return note
        self._features, self._last = self.policy.encode(pixels), image
        self._pixels = pixels
        return ""


def blank_or_noise(image: Array32) -> str:
    """What is wrong with an image (h, w, 3) in 0..1 that shows nothing; else "".

    A picture has contrast, and its neighbouring pixels are alike; white noise has a correlation of
    zero to within 0.01, and a picture with salt and pepper on a third of its pixels about 0.1.
    """
    grey = image.mean(axis=2)
    grey = grey - grey.mean()
    variance = float((grey**2).mean())
    if variance < SMALLEST_DEVIATION**2:
        return "blank image"
    if float((grey[:, 1:] * grey[:, :-1]).mean()) < LEAST_CORRELATION * variance:
        return "noise"
    return ""


def _black(camera: PinholeCamera) -> Pixels:
    return np.zeros((camera.height, camera.width, 3), np.uint8)
