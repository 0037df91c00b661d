"""Policy: images, past commands and a memory -> commands, by a small network in NumPy alone; the
file of its weights.

    image, mask -> convolutions -> features (F,)    each new image, `encode`
    features, inputs, memory -> commands, memory    each step, `step`

The layers are those of policy_network.py, which trains them; batch normalisation is folded into
the convolutions when a network is saved, so that flying needs neither PyTorch nor a GPU.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from falconwing_kit.core.checks import InputError, require_file
from falconwing_kit.core.files import short_name
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.vision.images import Pixels, require_image
from falconwing_kit.vision.layers import (
    Array32,
    convolve,
    gated_recurrent_unit,
    layer_norm,
    standardise,
)
from falconwing_kit.vision.leader_mask import PREFIX, leader_mask, mask_weight_shapes
from falconwing_kit.vision.pose_net import crop_window

Memory = Array32  # (M,) state of the recurrent unit; empty for a network without one

MAX_FILE_BYTES = 64 * 1024**2
VERSION = 1
CHANNELS = {"rgb": 3, "mask": 1, "rgb_mask": 4}  # of the input image, by its kind
AGE_UNIT_S, MOUNT_UNIT_M = 0.1, 0.25  # scales of the inputs
CONTROLS = 4


@dataclass(frozen=True)
class PolicyShape:
    """Size of a policy's network."""

    width: int = 160  # of the image [px]
    height: int = 120
    sees: str = "rgb"  # one of CHANNELS
    # of each convolution: output channels, width of the kernel, stride
    convolutions: tuple[tuple[int, int, int], ...] = (
        (24, 5, 2), (32, 3, 2), (48, 3, 1), (64, 3, 2), (96, 3, 1), (96, 3, 2), (28, 1, 1),
    )  # fmt: skip
    features: int = 192  # of an image
    memory: int = 192  # of the recurrent unit; 0: none, a layer of the same place instead
    history: int = 3  # past commands that are read
    hidden: int = 96  # of the head

    @property
    def inputs(self) -> int:
        """Numbers that are read besides the image; see `policy_inputs`."""
        return CONTROLS * self.history + 2 + 3

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns after the convolutions."""
        rows, columns = self.height, self.width
        for _, _, stride in self.convolutions:
            rows, columns = math.ceil(rows / stride), math.ceil(columns / stride)
        return rows, columns


@dataclass(frozen=True)
class PolicyRecord:
    """What a policy was trained for; stored in the metadata of its weights."""

    shape: dict[str, Any]  # of PolicyShape
    task: str  # "landing" or "follow"
    focal: float  # of the camera, in image widths
    source: str = ""  # scene, seeds and length of the training
    version: int = VERSION


class Policy:
    """A trained policy, in NumPy."""

    def __init__(self, weights: Mapping[str, Array32], record: PolicyRecord) -> None:
        shape = dict(record.shape)
        shape["convolutions"] = tuple(tuple(layer) for layer in shape["convolutions"])
        self.shape, self.record = PolicyShape(**shape), record
        self._w = {name: np.ascontiguousarray(w, np.float32) for name, w in weights.items()}
        _require_weights(self._w, self.shape)

    @classmethod
    def load(cls, path: str | Path) -> "Policy":
        """Read a .safetensors file of `falconwing train`.

        Raises:
            FileNotFoundError: there is no file.
            InputError: the file is damaged, of another kind, or holds numbers that are not finite.
        """
        path = Path(path)
        file = require_file(path)
        try:
            from safetensors.numpy import load

            if file.stat().st_size > MAX_FILE_BYTES:
                raise ValueError
            data = file.read_bytes()
            # safetensors: 8 bytes with the length of a JSON header, the header, the tensors
            length = int.from_bytes(data[:8], "little")
            metadata = json.loads(data[8 : 8 + length])["__metadata__"]
            record = PolicyRecord(**json.loads(metadata["policy"]))
            if record.version != VERSION:
                raise ValueError
            policy = cls({k: w.astype(np.float32) for k, w in load(data).items()}, record)
        except InputError:
            raise
        except Exception:  # a damaged file can fail at any of these steps
            raise InputError(
                f"{short_name(path)}: expected weights of a policy of version {VERSION}, got a"
                " damaged or other file; train one with falconwing train"
            ) from None
        return policy

    @property
    def weights(self) -> dict[str, Array32]:
        """The arrays by their names in the file."""
        return dict(self._w)

    @property
    def camera(self) -> PinholeCamera:
        """The camera that the policy was trained for."""
        focal, width, height = self.record.focal, self.shape.width, self.shape.height
        return PinholeCamera(focal * width, focal * width, 0.5 * width, 0.5 * height, width, height)

    def resample(self, image: Pixels, camera: PinholeCamera) -> Array32:
        """An image (H, W, 3) as the trained camera would take it: (h, w, 3) in 0..1.

        Raises:
            InputError: the image is not of the camera's size, or the camera lacks more than a
                quarter of the trained field of view.
        """
        import cv2

        image = require_image(image, camera, rgb=True, min_side_px=8)
        left, top, right, bottom = crop_window(camera, self.camera)
        if (left, top, right, bottom) != (0, 0, camera.width, camera.height):
            # clamped indices crop, and repeat the edge where the window exceeds the image
            rows = np.arange(top, bottom).clip(0, camera.height - 1)
            image = image[rows[:, None], np.arange(left, right).clip(0, camera.width - 1)]
        size = (self.shape.width, self.shape.height)
        if image.shape[1::-1] != size:
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
        return np.asarray(image, np.float32) / np.float32(255.0)

    def encode(self, image: Array32) -> Array32:
        """Features (F,) of an image (h, w, 3) in 0..1; its mask of the leader is found here."""
        x = standardise(self.see(image)).transpose(2, 0, 1)
        for layer, (_, _, stride) in enumerate(self.shape.convolutions):
            weight, bias = self._w[f"conv{layer}.weight"], self._w[f"conv{layer}.bias"]
            x = np.maximum(convolve(x, weight, stride) + bias[:, None, None], 0.0)
        return layer_norm(self._dense("features", x.reshape(-1)))

    def see(self, image: Array32) -> Array32:
        """What the convolutions get of an image (h, w, 3): it, its mask, or both (h, w, C)."""
        if self.shape.sees == "rgb":
            return image
        mask = leader_mask(image, self._w)[..., None]
        return mask if self.shape.sees == "mask" else np.concatenate([image, mask], axis=-1)

    def start_memory(self) -> Memory:
        """The memory at the begin of a flight."""
        return np.zeros(self.shape.memory, np.float32)

    def step(self, features: Array32, inputs: Array32, memory: Memory) -> tuple[Array32, Memory]:
        """One step.

        Args:
            features: (F,) of the newest image; zeros before the first.
            inputs: of `policy_inputs`.
            memory: of the last step.

        Returns:
            Commands (4,) in the order of COMMAND_NAMES, which may exceed their limits, and the
            memory.
        """
        x = np.concatenate([features, inputs])
        if self.shape.memory:
            memory = gated_recurrent_unit(
                x, memory, self._w["memory.weight_ih"], self._w["memory.weight_hh"],
                self._w["memory.bias_ih"], self._w["memory.bias_hh"],
            )  # fmt: skip
            x = memory
        else:
            x = np.maximum(self._dense("mix", x), 0.0)
        hidden = np.maximum(self._dense("head", np.concatenate([x, features])), 0.0)
        return self._dense("commands", hidden), memory

    def _dense(self, name: str, x: Array32) -> Array32:
        return np.asarray(self._w[f"{name}.weight"] @ x + self._w[f"{name}.bias"])


def policy_inputs(
    past_commands: ArrayLike, age: ArrayLike, p_body_camera: ArrayLike, history: int
) -> Array32:
    """What a policy reads besides the image, on a scale of about one.

    Args:
        past_commands: (..., n, 4) sent before, oldest first, n >= history.
        age: (...) of the newest image [s]; nan before the first.
        p_body_camera: (..., 3) the camera in body axes [m].
        history: number of the newest commands to read.

    Returns:
        (..., 4 history + 5): those commands, whether there is an image, its age, the camera's
        place.
    """
    commands = np.asarray(past_commands, np.float32)
    flat = commands[..., commands.shape[-2] - history :, :].reshape(*commands.shape[:-2], -1)
    age = np.asarray(age, np.float32)[..., None]
    has_image = np.isfinite(age)
    scaled_age = np.where(has_image, age / AGE_UNIT_S, 0.0)
    mount = np.asarray(p_body_camera, np.float32) / MOUNT_UNIT_M
    mount = np.broadcast_to(mount, (*flat.shape[:-1], 3))
    return np.concatenate([flat, has_image, scaled_age, mount], axis=-1, dtype=np.float32)


def weight_shapes(shape: PolicyShape) -> dict[str, tuple[int, ...]]:
    """Name and shape of each array of a policy's weights."""
    shapes: dict[str, tuple[int, ...]] = {}
    channels = CHANNELS[shape.sees]
    for layer, (out, k, _) in enumerate(shape.convolutions):
        shapes |= {f"conv{layer}.weight": (out, channels, k, k), f"conv{layer}.bias": (out,)}
        channels = out
    dense = [("features", channels * math.prod(shape.grid), shape.features)]
    read, M = shape.features + shape.inputs, shape.memory
    if M:
        shapes |= {"memory.weight_ih": (3 * M, read), "memory.weight_hh": (3 * M, M)}
        shapes |= {"memory.bias_ih": (3 * M,), "memory.bias_hh": (3 * M,)}
    else:
        dense.append(("mix", read, shape.features))
    dense.append(("head", (M or shape.features) + shape.features, shape.hidden))
    dense.append(("commands", shape.hidden, CONTROLS))
    for name, before, after in dense:
        shapes |= {f"{name}.weight": (after, before), f"{name}.bias": (after,)}
    if shape.sees != "rgb":
        shapes |= {PREFIX + name: size for name, size in mask_weight_shapes().items()}
    return shapes


def _require_weights(weights: Mapping[str, Array32], shape: PolicyShape) -> None:
    """InputError unless all arrays are there, of the right shapes, and finite."""
    for name, expected in weight_shapes(shape).items():
        got = weights[name].shape if name in weights else "none"
        if got != expected:
            raise InputError(
                f"weights: expected {name} of shape {expected}, got {got}; they are of another"
                " network"
            )
        if not np.isfinite(weights[name]).all():
            raise InputError(
                f"weights: expected finite numbers, got nan or infinity in {name}; train it again"
            )
