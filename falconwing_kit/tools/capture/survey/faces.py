"""Face detection: surveyed flat faces and a rough alignment -> corner pixels in the photos.

Each edge of a face is searched across its predicted place, within the alignment's uncertainty; a
line is fitted to the colour steps, and neighbouring lines intersect in a corner. Since lens
distortion bends lines, they are fitted to rays: a straight edge and the camera span a plane, and
two such planes intersect in the ray of the corner.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.core.checks import Array
from falconwing_kit.tools.capture.align import Alignment
from falconwing_kit.tools.capture.photo_files import Reconstruction, read_photo
from falconwing_kit.tools.capture.survey.points import PointObservations

Image = NDArray[np.float32]

MIN_SEARCH_PX, MAX_SEARCH_PX = 3.0, 16.0  # across an edge, to both sides
STEP_PX = 0.25
MIN_SAMPLES, MIN_SHARE, MIN_SPAN_PX = 10, 0.6, 25.0  # inliers of a line: number, share, length
MIN_CONTRAST = 8.0  # colour change across an edge within 2 px, of 255
LINE_TOLERANCE_PX = 0.7
BORDER_PX = 4.0
END_SHARE = 0.015  # of an edge is skipped at each end, near the neighbouring edges
INNER_SHARE = 0.4  # maximum search depth into the face, as a share of its width


def observe_faces(
    reconstruction: Reconstruction,
    alignment: Alignment,
    faces: Sequence[tuple[tuple[str, ...], Array]],
    plain: bool = True,
    progress: Callable[[], None] = lambda: None,
) -> PointObservations:
    """Find the corners of flat faces in all photos.

    Args:
        reconstruction: not aligned.
        alignment: predicts the edges; an edge with an uncertainty beyond MAX_SEARCH_PX is skipped.
        faces: for each the names of its corners in order around it, and their places (4, 3) in the
            world [m].
        plain: True: the face has one colour, and its edge is the first step on the way out. False:
            it has a pattern, and its edge is the strongest step.
        progress: called after each photo.

    Returns:
        Observations of the corners, except where an edge is hidden, short, faint or cut by the
        image border.

    Raises:
        FileNotFoundError: a photo is missing.
        InputError: a photo cannot be read.
    """
    rows: list[tuple[str, int, Sequence[float]]] = []
    placed = [
        (names, p, alignment.inverse(p), alignment.sigma(p) / alignment.scale) for names, p in faces
    ]
    for number in range(len(reconstruction)):
        depths = [_depths(reconstruction, number, corners) for _, _, corners, _ in placed]
        if any((depth > 0).any() for depth in depths):
            image = _smooth(read_photo(reconstruction.path(number)))
            for (names, _, corners, sigmas), depth in zip(placed, depths, strict=True):
                if (depth > 0).any():
                    found = _find_in_photo(reconstruction, number, image, corners, sigmas, plain)
                    rows += [(names[k], number, pixel) for k, pixel in found]
        progress()
    return PointObservations.join(rows)


def _find_in_photo(
    reconstruction: Reconstruction,
    number: int,
    image: Image,
    corners: Array,
    sigmas: Array,
    plain: bool,
) -> list[tuple[int, list[float]]]:
    """Corners of one face in one photo: corner number and pixel."""
    lines = [_find_edge(reconstruction, number, image, corners, sigmas, k, plain) for k in range(4)]
    expected = reconstruction.project(corners, number)
    found = []
    for k in range(4):
        before, after = lines[k - 1], lines[k]
        if before is None or after is None or not np.isfinite(expected[k]).all():
            continue
        (plane_before, seen_before, _), (plane_after, seen_after, search) = before, after
        # intersection of the two planes through the camera; undetermined for nearly parallel lines
        ray = np.cross(plane_before, plane_after)
        if abs(ray[2]) < np.sin(np.radians(10.0)):
            continue
        pixel = _to_pixels(reconstruction, ray[None] / ray[2])[0]
        size = (reconstruction.camera.width, reconstruction.camera.height)
        inside = ((pixel > BORDER_PX) & (pixel < np.array(size) - BORDER_PX)).all()
        gaps = [np.linalg.norm(seen - pixel, axis=1).min() for seen in (seen_before, seen_after)]
        if (
            inside
            and max(gaps) < MIN_SPAN_PX
            and np.linalg.norm(pixel - expected[k]) < 2.0 * search
        ):
            found.append((k, pixel.tolist()))
    return found


def _find_edge(
    reconstruction: Reconstruction,
    number: int,
    image: Image,
    corners: Array,
    sigmas: Array,
    k: int,
    plain: bool,
) -> tuple[Array, Array, float] | None:
    """The edge from corner k to the next: plane normal (camera axes), edge pixels, search width."""
    places, weights = _sample_edge(reconstruction, number, corners[k], corners[(k + 1) % 4])
    if len(places) < MIN_SAMPLES:
        return None
    focal = reconstruction.camera.fx
    depth = np.maximum(_depths(reconstruction, number, corners), 1e-6)
    near = weights @ (sigmas / depth)[[k, (k + 1) % 4]]
    search = MIN_SEARCH_PX + 2.0 * focal * float(near.max())
    if search > MAX_SEARCH_PX:
        return None
    # image direction out of the face, at each sample of the edge
    along = np.gradient(places, axis=0)
    across = np.stack([along[:, 1], -along[:, 0]], -1) / np.linalg.norm(
        along, axis=1, keepdims=True
    )
    inner = weights @ (
        corners[[k, (k + 1) % 4]]
        + INNER_SHARE * (corners[[k - 1, (k + 2) % 4]] - corners[[k, (k + 1) % 4]])
    )
    depth_inside = ((reconstruction.project(inner, number) - places) * across).sum(axis=1)
    outward = -np.sign(depth_inside)[:, None] * across
    # where the face is narrower than the search, other edges would be found; NaN is excluded too
    wide = np.abs(depth_inside) > search
    if wide.sum() < MIN_SAMPLES:
        return None
    places, outward = places[wide], outward[wide]
    seen = _steps(image, places, outward, search, plain)
    hit = np.isfinite(seen).all(axis=1)
    if hit.sum() < MIN_SAMPLES or hit.mean() < MIN_SHARE:
        return None
    return _fit_line(reconstruction, seen[hit], len(places), search)


def _sample_edge(
    reconstruction: Reconstruction, number: int, start: Array, end: Array
) -> tuple[Array, Array]:
    """Pixels (S, 2) every 2 px along the visible edge, and the weights (S, 2) of its two ends."""
    share = np.linspace(0.0, 1.0, 800)
    pixels = reconstruction.project(start + share[:, None] * (end - start), number)
    camera = reconstruction.camera
    with np.errstate(invalid="ignore"):
        inside = (
            (pixels > BORDER_PX) & (pixels < (camera.width - BORDER_PX, camera.height - BORDER_PX))
        ).all(axis=1)
    inside &= (share > END_SHARE) & (share < 1.0 - END_SHARE)
    pixels, share = pixels[inside], share[inside]
    if len(pixels) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pixels, axis=0), axis=1))])
    even = np.arange(0.0, length[-1], 2.0)
    share = np.interp(even, length, share)
    places = np.stack([np.interp(even, length, pixels[:, axis]) for axis in range(2)], -1)
    return (
        (places, np.stack([1.0 - share, share], -1))
        if length[-1] > MIN_SPAN_PX
        else (places[:0], places[:0])
    )


def _steps(image: Image, places: Array, outward: Array, search: float, plain: bool) -> Array:
    """(S, 2) pixels of the colour step across each place of an edge; NaN where there is none."""
    import cv2

    # colour profiles (S, offsets, 3) across the edge
    offsets = np.arange(-search, search + STEP_PX, STEP_PX)
    at = (places[:, None] + offsets[None, :, None] * outward[:, None]).astype(
        np.float32
    ) - np.float32(0.5)
    profile = cv2.remap(
        image, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    half = round(1.0 / STEP_PX)
    change = np.linalg.norm(profile[:, 2 * half :] - profile[:, : -2 * half], axis=2)  # over 2 px
    # local maxima of the change: the first strong one of a plain face, else the strongest
    middle = change[:, 1:-1]
    peak = (middle >= change[:, :-2]) & (middle > change[:, 2:]) & (middle > MIN_CONTRAST)
    strong = peak & (middle > 0.4 * change.max(axis=1, keepdims=True))
    best = np.argmax(strong if plain else np.where(peak, middle, 0.0), axis=1)
    row = np.arange(len(places))
    left, centre, right = change[row, best], change[row, best + 1], change[row, best + 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        # vertex of the parabola through three values
        shift = 0.5 * (left - right) / (left - 2.0 * centre + right)
    found = np.where(strong.any(axis=1), offsets[best + 1 + half] + STEP_PX * shift, np.nan)
    return np.asarray(places + found[:, None] * outward)


def _fit_line(
    reconstruction: Reconstruction, pixels: Array, looked_for: int, search: float
) -> tuple[Array, Array, float] | None:
    """The plane through the camera that fits most edge pixels, and its inliers; None if too few."""
    rays = reconstruction.pixel_directions(pixels)
    tolerance = LINE_TOLERANCE_PX / reconstruction.camera.fx
    # consensus line through pairs of samples at least a third of the edge apart (RANSAC on a grid)
    count, best = len(rays), np.zeros(len(rays), bool)
    for first in range(0, count, max(1, count // 12)):
        for second in range(first + count // 3, count, max(1, count // 12)):
            inliers = _off_line(np.cross(rays[first], rays[second]), rays) < tolerance
            best = inliers if inliers.sum() > best.sum() else best
    # total least squares on the inliers, repeated
    for _ in range(3):
        if best.sum() < max(MIN_SAMPLES, MIN_SHARE * looked_for):
            return None
        x, y = rays[best, :2].T - rays[best, :2].mean(axis=0)[:, None]
        angle = 0.5 * np.arctan2(2.0 * (x * y).sum(), (x * x - y * y).sum())  # principal axis
        normal = np.array([-np.sin(angle), np.cos(angle)])
        plane = np.array([*normal, -normal @ rays[best, :2].mean(axis=0)])
        best = _off_line(plane, rays) < tolerance
    seen = pixels[best]
    wide = len(seen) and np.linalg.norm(seen.max(axis=0) - seen.min(axis=0)) > MIN_SPAN_PX
    return (plane, seen, search) if wide else None


def _off_line(plane: Array, rays: Array) -> Array:
    """Distance of rays (z = 1) from a line in the plane z = 1."""
    return np.abs(rays @ plane) / max(float(np.hypot(plane[0], plane[1])), 1e-12)


def _to_pixels(reconstruction: Reconstruction, directions: Array) -> Array:
    """(K, 2) pixels of camera-frame directions with z = 1."""
    camera = reconstruction.camera
    bent = directions[:, :2] * (
        1.0 + reconstruction.k1 * (directions[:, :2] ** 2).sum(axis=1, keepdims=True)
    )
    return np.asarray(bent * (camera.fx, camera.fy) + (camera.cx, camera.cy))


def _depths(reconstruction: Reconstruction, number: int, points: Array) -> Array:
    """(K,) depth of points along a camera's axis."""
    T = reconstruction.T_world_camera[number]
    return np.asarray((points - T[:3, 3]) @ T[:3, 2])


def _smooth(photo: NDArray[np.uint8]) -> Image:
    """A photo as floats, smoothed against noise."""
    import cv2

    return np.asarray(cv2.GaussianBlur(photo.astype(np.float32), (0, 0), 0.8), np.float32)
