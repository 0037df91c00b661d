"""iGSplat: one image -> where its camera was, and how sure that is. The network is in
networks/pose.py.

    from falconwing_kit.vision import PoseNet
    estimate = PoseNet.load("hall").estimate(image, camera)
    estimate.T_world_camera, estimate.sigma_position, estimate.sigma_attitude

It knows one hall, the one it was trained in (learning/pose_net_training.py), and one field of view;
other cameras are cropped or padded to that.
"""

import json
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, InputError, require_file, require_range
from falconwing_kit.core.files import atomic_write, short_name
from falconwing_kit.core.frames import pose_matrix
from falconwing_kit.scene.camera import PinholeCamera

if TYPE_CHECKING:
    from torch import Tensor

    from falconwing_kit.vision.pose_network import PoseNetOutput, PoseNetwork

NETS = ("hall",)  # the names that ship, as pose_net_NAME.safetensors
MAX_FILE_BYTES = 256 * 1024**2
MAX_MISSING = 0.25  # share of the trained field of view that a camera may lack
VERSION = 1


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A camera's pose and its uncertainty; the standard deviations are root mean squares over the
    three axes.
    """

    T_world_camera: Array  # (4, 4), "world from camera"
    sigma_position: float  # of each axis [m]
    sigma_attitude: float  # about each axis [rad]
    covariance: Array  # (6, 6) of place [m] and turn [rad], both in world axes


@dataclass(frozen=True)
class PoseNetRecord:
    """What belongs to the weights and is kept with them."""

    shape: dict[str, Any]  # of networks.pose.Shape
    focal: float  # in image widths
    low: tuple[float, float, float]  # the hall's box [m]
    high: tuple[float, float, float]
    sigma_scales: tuple[float, float] = (1.0, 1.0)  # of place and turn, from calibration
    source: str = ""  # scene and photos it was trained on
    version: int = VERSION

    @property
    def camera(self) -> PinholeCamera:
        """The camera that the network was trained for."""
        width, height = int(self.shape["width"]), int(self.shape["height"])
        focal = self.focal * width
        return PinholeCamera(focal, focal, 0.5 * width, 0.5 * height, width, height)


class PoseNet:
    """A trained network; it gives poses.

    Args:
        network: the layers.
        record: what it was trained for.
    """

    def __init__(self, network: "PoseNetwork", record: PoseNetRecord) -> None:
        self.network, self.record = network.eval(), record
        self._rays = cell_rays(record.camera)

    @classmethod
    def load(cls, name: str | Path) -> "PoseNet":
        """Read a network.

        Args:
            name: "hall", which ships, or a .safetensors file that the training wrote.

        Raises:
            FileNotFoundError: there is no file.
            InputError: the file is damaged or of another kind, or PyTorch is missing.
        """
        path = Path(name)
        if str(name) in NETS:
            path = Path(str(files("falconwing_kit.data") / f"pose_net_{name}.safetensors"))
        if path.suffix != ".safetensors":
            raise InputError(
                f"pose net: expected a .safetensors file or a name that ships ({', '.join(NETS)}), got {name}"
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
            length = int.from_bytes(
                data[:8], "little"
            )  # the format begins with the length of its JSON header
            record = PoseNetRecord(
                **json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["pose_net"])
            )
            network = PoseNetwork(
                PoseNetShape(**record.shape), torch.tensor(record.low), torch.tensor(record.high)
            )
            network.load_state_dict(
                {key: tensor.float() for key, tensor in load(data).items()}, strict=False
            )
            complete = set(load(data)) >= {key for key, _ in network.named_parameters()}
        except Exception:  # a damaged file can fail anywhere on this way
            raise InputError(
                f"{short_name(path)}: expected weights of a pose net, got a damaged or other file"
            ) from None
        if record.version != VERSION or not complete:
            raise InputError(
                f"{short_name(path)}: expected a pose net of version {VERSION}, got another; use a newer kit"
            )
        return cls(network, record)

    def save(self, path: str | Path) -> None:
        """Write weights, in half precision, and record, whole or not at all.

        Raises:
            InputError: the path is no .safetensors file or cannot be written.
        """
        import torch
        from safetensors.torch import save

        if Path(path).suffix != ".safetensors":
            raise InputError(
                f"{short_name(path)}: expected a name ending in .safetensors for weights, got another"
            )
        tensors = {
            key: tensor.half() if tensor.dtype == torch.float32 and "running" not in key else tensor
            for key, tensor in self.network.state_dict().items()
        }
        tensors = {key: tensor.contiguous().cpu() for key, tensor in tensors.items()}
        with atomic_write(path) as file:
            file.write(save(tensors, {"pose_net": json.dumps(asdict(self.record))}))

    def estimate(self, image: NDArray[np.uint8], camera: PinholeCamera) -> PoseEstimate:
        """The pose of the camera that took an image.

        Args:
            image: (H, W, 3) red, green, blue.
            camera: which took it.

        Raises:
            InputError: the image is none or not the camera's, or the camera sees too little of what
                the network knows.
        """
        return self.pose_estimates(self.answer(image, camera))[0]

    def answer(self, image: NDArray[np.uint8], camera: PinholeCamera) -> "PoseNetOutput":
        """What the network itself says about an image, before cells and token are fused; arguments
        as `estimate`'s.
        """
        import torch

        image = _require_image(image, camera)
        with torch.no_grad():
            return self.network(self.prepared(torch.from_numpy(image)[None], camera))

    def prepared(self, images: "Tensor", camera: PinholeCamera) -> "Tensor":
        """Images (B, H, W, 3) of bytes as the network's own camera had taken them: (B, 3, h, w) in
        0..1.

        Raises:
            InputError: the camera lacks more than a quarter of the field of view.
        """
        import torch
        from torch.nn.functional import interpolate

        own = self.record.camera
        left, top, right, bottom = _window(camera, own)
        columns = torch.arange(left, right, device=images.device).clamp(
            0, camera.width - 1
        )  # repeats what lies outside
        rows = torch.arange(top, bottom, device=images.device).clamp(0, camera.height - 1)
        if (right - left, bottom - top) != (camera.width, camera.height) or left or top:
            images = images[:, rows][:, :, columns]
        small = interpolate(
            images.permute(0, 3, 1, 2), (own.height, own.width), mode="bilinear", antialias=True
        )
        return small.float() / 255.0

    def pose_estimates(self, answer: "PoseNetOutput") -> list[PoseEstimate]:
        """The estimates of a network's answer about B images."""
        import torch

        from falconwing_kit.vision.pose_network import fuse_pose

        with torch.no_grad():
            R, place, information = fuse_pose(
                answer, torch.from_numpy(self._rays).float(), self.network.log_trust
            )
        scale = np.repeat(self.record.sigma_scales, 3)
        covariances = torch.linalg.inv(information.double()).numpy() * scale * scale[:, None]
        Ts_world_camera = pose_matrix(_orthonormal(R.double().numpy()), place.double().numpy())
        return [
            PoseEstimate(
                T,
                float(np.sqrt(np.trace(C[:3, :3]) / 3.0)),
                float(np.sqrt(np.trace(C[3:, 3:]) / 3.0)),
                C,
            )
            for T, C in zip(Ts_world_camera, covariances, strict=True)
        ]


def cell_rays(camera: PinholeCamera) -> Array:
    """(K, 3) unit directions in camera axes that the network's cells look along, row by row.

    A cell is 8 x 8 pixels; its ray goes through the centre of the pixel right of and below its
    middle.
    """
    from falconwing_kit.vision.pose_network import CELL

    rays = camera.pixel_rays()[CELL // 2 :: CELL, CELL // 2 :: CELL].reshape(-1, 3)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _window(camera: PinholeCamera, own: PinholeCamera) -> tuple[int, int, int, int]:
    """Left, top, right and bottom edge [px], in a camera's image, of what the network's camera
    would see.
    """
    across, down = camera.fx / own.fx, camera.fy / own.fy
    left, right = camera.cx - across * own.cx, camera.cx + across * (own.width - own.cx)
    top, bottom = camera.cy - down * own.cy, camera.cy + down * (own.height - own.cy)
    seen = (min(right, camera.width) - max(left, 0.0)) * (
        min(bottom, camera.height) - max(top, 0.0)
    )
    if min(right, camera.width) <= max(left, 0.0) or seen < (1.0 - MAX_MISSING) * (right - left) * (
        bottom - top
    ):
        wanted, got = (
            np.degrees(2.0 * np.arctan(0.5 * lens.width / lens.fx)) for lens in (own, camera)
        )
        raise InputError(
            f"camera: expected at least three quarters of the view the network was trained on, {wanted:.0f} deg across, "
            f"got {got:.0f} deg; use a wider lens, or train a network for this one"
        )
    return round(left), round(top), round(right), round(bottom)


def _require_image(image: NDArray[np.uint8], camera: PinholeCamera) -> NDArray[np.uint8]:
    """The image, if it is one and the camera's."""
    image = np.asarray(image)
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise InputError(
            f"image: expected (H, W, 3) of bytes, red, green, blue, got {image.shape} of {image.dtype}"
        )
    if image.shape[:2] != (camera.height, camera.width):
        want, got = f"{camera.width} x {camera.height}", f"{image.shape[1]} x {image.shape[0]}"
        raise InputError(
            f"image: expected the camera's size, {want} px, got {got}; scale the camera as the image"
        )
    require_range("image's shorter side [px]", min(image.shape[:2]), low=32)
    return np.ascontiguousarray(image)


def _orthonormal(R: Array) -> Array:
    """The nearest rotations (B, 3, 3), by singular values; float32 leaves them off by 1e-7."""
    left, _, right = np.linalg.svd(R)
    return np.asarray(left @ right)
