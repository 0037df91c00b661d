"""Pose net (the paper's iGSplat): one image -> the camera's pose and its uncertainty; the file of
its weights.

    from falconwing_kit.vision import PoseNet
    estimate = PoseNet.load("hall").estimate(image, camera)
    estimate.T_world_camera, estimate.sigma_position, estimate.sigma_attitude

A net is trained for one hall (`falconwing scene pose-net`) and one field of view; images of other
cameras are cropped or padded to it. The layers are in pose_network.py.
"""

import json
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from falconwing_kit.core.checks import Array, InputError, require_file
from falconwing_kit.core.files import atomic_write, short_name
from falconwing_kit.core.frames import pose_matrix
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.vision.images import Pixels, require_image

if TYPE_CHECKING:
    from torch import Tensor

    from falconwing_kit.vision.pose_network import PoseNetOutput, PoseNetwork

NETS = ("hall",)  # the names that ship, as pose_net_NAME.safetensors
MAX_FILE_BYTES = 256 * 1024**2
TRAINING_MARGIN = 0.5  # distance of the cameras in training from the sides of the hall's box [m]
MAX_MISSING = 0.25  # share of the trained field of view that a camera may lack
VERSION = 1
Box = tuple[tuple[float, float, float], tuple[float, float, float]]  # lower, upper corner [m]


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A camera's pose and its uncertainty."""

    T_world_camera: Array  # (4, 4)
    covariance: Array  # (6, 6) of position [m] and rotation vector [rad] in world axes

    @property
    def sigma_position(self) -> float:
        """Standard deviation of a coordinate, root mean square of the three [m]."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3]) / 3.0))

    @property
    def sigma_attitude(self) -> float:
        """Standard deviation about an axis, root mean square of the three [rad]."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:]) / 3.0))


@dataclass(frozen=True)
class PoseNetRecord:
    """What a network was trained for; stored in the metadata of its weights."""

    shape: dict[str, Any]  # of pose_network.PoseNetShape
    focal: float  # in image widths
    low: tuple[float, float, float]  # corners of the hall [m]
    high: tuple[float, float, float]
    sigma_scales: tuple[float, float] = (1.0, 1.0)  # of position and rotation, from calibration
    source: str = ""  # scene and photos it was trained on
    approach: Box | None = None  # of the cameras of approaches to a pad, if there were any
    version: int = VERSION

    @property
    def camera(self) -> PinholeCamera:
        """The camera that the network was trained for."""
        width, height = int(self.shape["width"]), int(self.shape["height"])
        focal = self.focal * width
        return PinholeCamera(focal, focal, 0.5 * width, 0.5 * height, width, height)


class PoseNet:
    """A trained network that estimates camera poses."""

    def __init__(self, network: "PoseNetwork", record: PoseNetRecord) -> None:
        import torch

        from falconwing_kit.vision.pose_network import fold_batch_norm

        self.network = network.eval()
        # channels beside each other in memory: convolutions on a CPU take a fifth less time
        self._folded = fold_batch_norm(network).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.record = record
        self._rays = cell_rays(record.camera)

    @classmethod
    def load(cls, name: str | Path) -> "PoseNet":
        """Read a network.

        Args:
            name: "hall", which ships, or a .safetensors file of `falconwing scene pose-net`.

        Raises:
            FileNotFoundError: there is no file.
            InputError: the file is damaged or of another kind, or PyTorch is missing.
        """
        path = Path(name)
        if str(name) in NETS:
            path = Path(str(files("falconwing_kit.data") / f"pose_net_{name}.safetensors"))
        if path.suffix != ".safetensors":
            raise InputError(
                "pose net: expected a .safetensors file or a name that ships "
                f"({', '.join(NETS)}), got {name}; train one with falconwing scene pose-net"
            )
        data = require_file(path).read_bytes()
        try:
            import torch
            from safetensors.torch import load

            from falconwing_kit.vision.pose_network import PoseNetShape, PoseNetwork
        except ModuleNotFoundError as error:
            raise InputError(
                f"pose net: expected {error.name}, which is missing; run: pip install {error.name}"
            ) from None
        try:
            if len(data) > MAX_FILE_BYTES:
                raise ValueError
            # safetensors: 8 bytes with the length of a JSON header, the header, the tensors
            length = int.from_bytes(data[:8], "little")
            metadata = json.loads(data[8 : 8 + length])["__metadata__"]
            record = PoseNetRecord(**json.loads(metadata["pose_net"]))
            network = PoseNetwork(
                PoseNetShape(**record.shape), torch.tensor(record.low), torch.tensor(record.high)
            )
            tensors = {key: tensor.float() for key, tensor in load(data).items()}
            network.load_state_dict(tensors, strict=False)
            complete = set(tensors) >= {key for key, _ in network.named_parameters()}
            is_finite = all(bool(torch.isfinite(tensor).all()) for tensor in tensors.values())
        except Exception:  # a damaged file can fail at any of these steps
            raise InputError(
                f"{short_name(path)}: expected weights of a pose net, got a damaged or other file; "
                "copy it again"
            ) from None
        if not is_finite:
            raise InputError(
                f"{short_name(path)}: expected finite weights, got nan or infinity; train it again"
            )
        if record.version != VERSION or not complete:
            raise InputError(
                f"{short_name(path)}: expected a pose net of version {VERSION}, got another; "
                "use a newer kit"
            )
        return cls(network, record)

    def save(self, path: str | Path) -> None:
        """Write weights in half precision, with the record.

        Raises:
            InputError: the path is no .safetensors file or cannot be written.
        """
        import torch
        from safetensors.torch import save

        if Path(path).suffix != ".safetensors":
            raise InputError(
                f"{short_name(path)}: expected a name ending in .safetensors for weights, "
                "got another; rename it"
            )
        tensors = {}
        for key, tensor in self.network.state_dict().items():
            # the running statistics of batch normalisation keep single precision
            is_weight = tensor.dtype == torch.float32 and "running" not in key
            tensors[key] = (tensor.half() if is_weight else tensor).contiguous().cpu()
        record = {key: value for key, value in asdict(self.record).items() if value is not None}
        with atomic_write(path) as file:
            file.write(save(tensors, {"pose_net": json.dumps(record)}))

    def extrapolation(self, p_world_camera: Array) -> float:
        """Distance [m] of a place (3,) outside the boxes of the cameras in training; 0 inside.

        Outside them, as just above the floor, poses are drawn towards the box and their covariances
        are too small.
        """
        low, high = np.array(self.record.low), np.array(self.record.high)
        boxes = [(low + TRAINING_MARGIN, high - TRAINING_MARGIN)]
        if self.record.approach is not None:
            boxes.append((np.array(self.record.approach[0]), np.array(self.record.approach[1])))
        return min(
            float(np.linalg.norm(p_world_camera - np.clip(p_world_camera, *box))) for box in boxes
        )

    def estimate(self, image: Pixels, camera: PinholeCamera) -> PoseEstimate:
        """Estimate the pose of the camera that took an image.

        Args:
            image: (H, W, 3) RGB.
            camera: intrinsics at the image's size.

        Raises:
            InputError: the image is not of the camera's size, or the camera's field of view lacks
                more than a quarter of the trained one.
        """
        return self.pose_estimates(self.predict(image, camera))[0]

    def predict(self, image: Pixels, camera: PinholeCamera) -> "PoseNetOutput":
        """The network's output before cells and token are fused; arguments as `estimate`."""
        import torch

        image = require_image(image, camera, rgb=True, min_side_px=32)
        with torch.inference_mode():
            return self._folded(self.resample(torch.from_numpy(image)[None], camera))

    def resample(self, images: "Tensor", camera: PinholeCamera) -> "Tensor":
        """Images (B, H, W, 3) of bytes as the trained camera would take them: (B, 3, h, w) in 0..1.

        Raises:
            InputError: the camera lacks more than a quarter of the field of view.
        """
        import torch
        from torch.nn.functional import interpolate

        trained = self.record.camera
        left, top, right, bottom = crop_window(camera, trained)
        # clamped indices crop, and repeat the edge where the window exceeds the image
        columns = torch.arange(left, right, device=images.device).clamp(0, camera.width - 1)
        rows = torch.arange(top, bottom, device=images.device).clamp(0, camera.height - 1)
        if (right - left, bottom - top) != (camera.width, camera.height) or left or top:
            images = images[:, rows][:, :, columns]
        size = (trained.height, trained.width)
        small = interpolate(images.permute(0, 3, 1, 2), size, mode="bilinear", antialias=True)
        return small.float() / 255.0

    def pose_estimates(self, output: "PoseNetOutput") -> list[PoseEstimate]:
        """The estimates of a network's output for B images."""
        import torch

        from falconwing_kit.vision.pose_network import fuse_pose

        rays = torch.from_numpy(self._rays).float()
        with torch.inference_mode():
            R, position, information = fuse_pose(output, rays, self.network.log_trust)
        scale = np.repeat(self.record.sigma_scales, 3)
        covariances = torch.linalg.inv(information.double()).numpy() * scale * scale[:, None]
        Ts_world_camera = pose_matrix(_orthonormal(R.double().numpy()), position.double().numpy())
        return [PoseEstimate(T, C) for T, C in zip(Ts_world_camera, covariances, strict=True)]


def cell_rays(camera: PinholeCamera) -> Array:
    """(K, 3) unit directions in camera axes of the network's cells, row by row.

    A cell is 8 x 8 pixels; its ray goes through the centre of the pixel right of and below its
    middle.
    """
    from falconwing_kit.vision.pose_network import CELL

    rays = camera.pixel_rays()[CELL // 2 :: CELL, CELL // 2 :: CELL].reshape(-1, 3)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def crop_window(camera: PinholeCamera, trained: PinholeCamera) -> tuple[int, int, int, int]:
    """Left, top, right, bottom [px] of the trained field of view in a camera's image."""
    scale_x, scale_y = camera.fx / trained.fx, camera.fy / trained.fy
    left = camera.cx - scale_x * trained.cx
    right = camera.cx + scale_x * (trained.width - trained.cx)
    top = camera.cy - scale_y * trained.cy
    bottom = camera.cy + scale_y * (trained.height - trained.cy)
    seen_x = min(right, camera.width) - max(left, 0.0)
    seen_y = min(bottom, camera.height) - max(top, 0.0)
    least = (1.0 - MAX_MISSING) * (right - left) * (bottom - top)
    if seen_x <= 0.0 or seen_x * seen_y < least:
        expected, got = (
            np.degrees(2.0 * np.arctan(0.5 * lens.width / lens.fx)) for lens in (trained, camera)
        )
        raise InputError(
            "camera: expected at least three quarters of the trained field of view, "
            f"{expected:.0f} deg across, got {got:.0f} deg; use a wider lens, or train a network "
            "for this one"
        )
    return round(left), round(top), round(right), round(bottom)


def _orthonormal(R: Array) -> Array:
    """The nearest rotations (B, 3, 3), by singular values; float32 has errors of 1e-7."""
    left, _, right = np.linalg.svd(R)
    return np.asarray(left @ right)
