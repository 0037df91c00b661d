"""Marker detection: photos -> the marker's four corners with subpixel accuracy."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.tools.capture.photo_files import Reconstruction, read_photo
from falconwing_kit.tools.capture.survey.points import MARKER_CORNERS, PointObservations

DICTIONARY, MARKER_ID, MARKER_SIZE = "DICT_4X4_50", 7, 0.80  # side of the black square [m]
_OTHER_DICTIONARIES = (
    "DICT_4X4_50",
    "DICT_5X5_50",
    "DICT_6X6_50",
    "DICT_7X7_50",
    "DICT_ARUCO_ORIGINAL",
)


def marker_corners(image: NDArray[np.uint8], dictionary: str = DICTIONARY) -> dict[int, Array]:
    """Corners of every marker of a dictionary in an image.

    Args:
        image: (H, W, 3) red, green, blue.
        dictionary: its name in OpenCV.

    Returns:
        By the marker's number: (4, 2) corners of the black square [px], as seen from its front top
        left, top right, bottom right, bottom left; the first pixel's centre is at (0.5, 0.5).

    Raises:
        InputError: OpenCV has no such dictionary.
    """
    from cv2 import aruco

    number = getattr(aruco, dictionary, None)
    if number is None:
        raise InputError(
            f"dictionary: expected a name such as {DICTIONARY}, got {dictionary[:40]!r}"
        )
    parameters = aruco.DetectorParameters()
    parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
    detector = aruco.ArucoDetector(aruco.getPredefinedDictionary(number), parameters)
    corners, ids, _ = detector.detectMarkers(np.ascontiguousarray(image[..., ::-1]))
    found = [] if ids is None else [int(key) for key in ids.ravel()]
    return {
        key: quad.reshape(4, 2).astype(np.float64) + 0.5
        for key, quad in zip(found, corners, strict=True)
    }


def observe_marker(
    reconstruction: Reconstruction,
    marker_id: int = MARKER_ID,
    dictionary: str = DICTIONARY,
    progress: Callable[[], None] = lambda: None,
) -> PointObservations:
    """Detect the marker in every photo.

    Args:
        dictionary: of the marker, its name in OpenCV.
        progress: called after each photo.

    Returns:
        Observations of MARKER_CORNERS, four for each photo that shows it.

    Raises:
        FileNotFoundError: a photo is missing.
        InputError: fewer than two photos show the marker, or a photo cannot be read.
    """
    rows: list[tuple[str, int, list[float]]] = []
    others: set[int] = set()
    for number in range(len(reconstruction)):
        found = marker_corners(read_photo(reconstruction.path(number)), dictionary)
        others |= found.keys() - {marker_id}
        for name, pixel in zip(MARKER_CORNERS, found.get(marker_id, ()), strict=False):
            rows.append((name, number, pixel.tolist()))
        progress()
    if len(rows) < 8:
        seen = (
            f"marker {', '.join(map(str, sorted(others)))} of it"
            if others
            else _other_dictionary(reconstruction)
        )
        raise InputError(
            f"photos: expected marker {marker_id} of {dictionary} in two or more of "
            f"{len(reconstruction)} photos, "
            f"got it in {len(rows) // 4}; seen instead: {seen}. "
            "Take photos of the marker from 2 to 8 m"
        )
    return PointObservations.join(rows)


def _other_dictionary(reconstruction: Reconstruction, photos: int = 20) -> str:
    """Markers of other dictionaries in a sample of the photos, as text."""
    numbers = np.unique(np.linspace(0, len(reconstruction) - 1, photos).astype(int))
    images = [read_photo(reconstruction.path(int(number))) for number in numbers]
    for dictionary in _OTHER_DICTIONARIES:
        seen = sorted({key for image in images for key in marker_corners(image, dictionary)})
        if seen:
            return f"marker {', '.join(map(str, seen))} of {dictionary}"
    return "no marker at all"
