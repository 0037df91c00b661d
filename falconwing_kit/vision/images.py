"""Camera images: arrays as they come -> checked uint8 images, as RGB or grey."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene.camera import PinholeCamera

Pixels = NDArray[np.uint8]


def require_image(
    image: Any, camera: PinholeCamera | None = None, *, rgb: bool = False, min_side_px: int = 1
) -> Pixels:
    """The image, after checking kind and size.

    Args:
        image: (H, W, 3) RGB, or (H, W) grey unless rgb.
        camera: whose size the image must have; None allows any.
        rgb: refuse grey images.
        min_side_px: of the shorter side.

    Raises:
        InputError: the image is of another kind or size.
    """
    shape, kind = getattr(image, "shape", ""), getattr(image, "dtype", type(image).__name__)
    got = f"{shape} {kind}".strip()
    is_image = shape[2:] == (3,) or (len(shape) == 2 and not rgb)
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or not is_image:
        expected = "(H, W, 3)" if rgb else "(H, W, 3) or (H, W)"
        raise InputError(f"image: expected {expected} uint8, got {got}; decode a JPEG first")
    if camera is not None and image.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"image: expected the camera's {camera.width} x {camera.height} pixels, got {got}; "
            "scale the camera"
        )
    if min(image.shape[:2]) < min_side_px:
        raise InputError(
            f"image: expected {min_side_px} pixels a side or more, got {got}; use a larger one"
        )
    return np.ascontiguousarray(image)


def to_grey(image: Pixels) -> Pixels:
    """(H, W) luma of an RGB image; a grey one unchanged."""
    import cv2

    return np.asarray(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
