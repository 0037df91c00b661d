"""Camera images: arrays as they come -> checked uint8 images, as RGB or grey."""

import io
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import require_size, short_name
from falconwing_kit.scene.camera import PinholeCamera

Pixels = NDArray[np.uint8]
MAX_FILE_BYTES = 512 * 1024**2
MAX_PIXELS = 120_000_000  # of a photo or frame: a larger one would fill the memory when decoded


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


def decode_image(data: bytes, *, as_stored: bool = False) -> Pixels | None:
    """A JPEG, PNG or other image as (H, W, 3) RGB; None if the bytes are no image.

    Args:
        data: of the file.
        as_stored: ignore an orientation in its EXIF record.

    Raises:
        InputError: it has more than MAX_PIXELS pixels; they are not decoded.
    """
    import cv2

    pixels = _pixels_in_header(data)
    if pixels > MAX_PIXELS:
        raise InputError(
            f"image: expected at most {MAX_PIXELS / 1e6:.0f} million pixels, got more; scale it"
            " down"
        )
    flags = cv2.IMREAD_COLOR | (cv2.IMREAD_IGNORE_ORIENTATION if as_stored else 0)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error:  # too few bytes for any image
        image = None
    return None if image is None else np.ascontiguousarray(image[..., ::-1])


def read_image(path: Path, *, as_stored: bool = False) -> Pixels | None:
    """The image in a file, as `decode_image` gives it.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file or the image is too large; they are not read.
    """
    require_size(path, MAX_FILE_BYTES, "an image")
    try:
        return decode_image(path.read_bytes(), as_stored=as_stored)
    except InputError as error:
        raise InputError(f"{short_name(path)}: {error}") from None


def _pixels_in_header(data: bytes) -> float:
    """Number of pixels as an image's header states it; 0 where Pillow cannot read the header."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's own, about the size
            with Image.open(io.BytesIO(data)) as header:
                return header.width * header.height
    except Image.DecompressionBombError:  # more than Pillow's own limit
        return math.inf
    except (OSError, ValueError, SyntaxError):
        return 0


def to_grey(image: Pixels) -> Pixels:
    """(H, W) luma of an RGB image; a grey one unchanged."""
    import cv2

    return np.asarray(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
