"""Pose refinement: an image, a trained scene and a rough pose -> the pose at which the scene looks
like the image.

Render the scene at the rough pose, follow every textured spot from the render into the image
(optical flow), take its place in the world from the render's depth, and solve for the pose that
puts these places where the image shows them. Repeat from there. Each round is a Gauss-Newton step
on pixels with the outliers voted out; unlike iNeRF (Yen-Chen et al., IROS 2021), which descends on
colours, it comes back from a metre and ten degrees and does not mind brightness.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.frames import pose_matrix
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.render import render, require_pose
from falconwing_kit.vision.marker import Pixels, pixel_jacobian

TOLERANCES_PX = (6.0, 3.0, 2.0)  # of the vote, one a round: the scene must come nearer each time
SPACING_PX = 6  # between followed spots
BORDER_PX = 4
MIN_TEXTURE = (
    25.0  # mean change per pixel around a spot [grey levels]; on plain walls flow is a guess
)
MAX_ROUND_TRIP_PX = 1.0  # a spot followed into the image and back must come home
MIN_ALPHA, MIN_DEPTH = (
    0.9,
    0.3,
)  # of what the render knows: covered, and not in front of the lens [m]
MIN_POINTS, MIN_INLIER_SHARE = (
    80,
    0.65,
)  # that agree, and of those followed: most false poses gather fewer
COVARIANCE_FACTOR = 16.0  # spots next to each other are off together: so many count as one
SIGMA_PX = 0.3  # flow is not better than this, however well the spots agree
SCENE_SIGMA = (
    0.03,
    0.004,
)  # of the scene's own place [m] and turn [rad]: alignment and what training bends
MAX_TRACK_GAP_S = 0.3  # a pose so long ago is still a start
Image8 = Any


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """A pose that the scene agrees with."""

    T_world_camera: Array  # (4, 4)
    covariance: Array  # (6, 6) of place [m] and of a small turn [rad], both in world axes
    spots: int  # that agree
    share: float  # of those followed

    @property
    def sigma_position(self) -> float:
        """Root mean square over the three axes [m]."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3]) / 3.0))

    @property
    def sigma_attitude(self) -> float:
        """Root mean square about the three axes [rad]."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:]) / 3.0))


def refine_pose(
    image: Pixels,
    scene: GaussianScene,
    camera: PinholeCamera,
    T_world_camera: Array,
    backend: str = "fast",
) -> RefinedPose | None:
    """Refine a rough pose against a scene.

    Args:
        image: (H, W, 3) RGB uint8.
        scene: as trained on photos of the place.
        camera: intrinsics at the image's size.
        T_world_camera: (4, 4) where to begin, good to about a metre and ten degrees.
        backend: which renderer.

    Returns:
        The pose; None where too little of the scene agrees with the image.

    Raises:
        InputError: the image is not of the camera's size, or the pose is none.
    """
    T = require_pose("T_world_camera", T_world_camera)
    if (
        not isinstance(image, np.ndarray)
        or image.dtype != np.uint8
        or image.shape != (camera.height, camera.width, 3)
    ):
        got = f"{getattr(image, 'shape', '')} {getattr(image, 'dtype', type(image).__name__)}"
        raise InputError(
            f"image: expected ({camera.height}, {camera.width}, 3) uint8, got {got}; scale the camera"
        )
    seen, found = _equalise(image), None
    for tolerance_px in TOLERANCES_PX:
        spots = _match_points(scene, camera, T, seen, backend)
        found = None if spots is None else _solve_pose(*spots, camera, tolerance_px)
        if found is None:
            return None
        T = found.T_world_camera
    return found if found is not None and found.share >= MIN_INLIER_SHARE else None


def track_scene(
    image: Callable[[int], Pixels | None],
    t: Array,
    scene: GaussianScene,
    camera: PinholeCamera,
    known: Mapping[int, Array],
    guesses: Mapping[int, Array],
    progress: Callable[[], None] = lambda: None,
) -> dict[int, RefinedPose]:
    """Refine frame after frame, each from the one before it: forward through the flight, then back
    for what is left.

    Args:
        image: frame 0..N-1 -> (H, W, 3) RGB; None where it was lost.
        t: (N,) [s].
        scene: as trained on photos of the place.
        camera: intrinsics at the images' size.
        known: poses (4, 4) by frame that need no refinement: those of the marker.
        guesses: rough poses (4, 4) by frame, for where the track is lost: those of the network.
        progress: called after each frame of the way forward.

    Returns:
        Refined poses by frame; frames where nothing agrees are left out.
    """
    found: dict[int, RefinedPose] = {}
    for order in (range(len(t)), range(len(t) - 1, -1, -1)):
        track: list[tuple[int, Array]] = []
        for frame in order:
            if frame not in known and frame not in found:
                starts = _predict_poses(track, frame, t) + (
                    [guesses[frame]] if frame in guesses and order.step > 0 else []
                )
                picture = image(frame) if starts else None
                for start in starts:
                    refined = (
                        None if picture is None else refine_pose(picture, scene, camera, start)
                    )
                    if refined is not None:
                        found[frame] = refined
                        break
            if frame in known or frame in found:
                track.append(
                    (frame, known[frame] if frame in known else found[frame].T_world_camera)
                )
            if order.step > 0:
                progress()
    return found


def _predict_poses(track: list[tuple[int, Array]], frame: int, t: Array) -> list[Array]:
    """Where the camera may be now: gone on as it went, or where it was."""
    if not track or abs(t[frame] - t[track[-1][0]]) > MAX_TRACK_GAP_S:
        return []
    last, T = track[-1]
    if len(track) < 2 or not np.isclose(t[frame] - t[last], t[last] - t[track[-2][0]], rtol=0.5):
        return [T]
    ahead = T @ np.linalg.inv(track[-2][1]) @ T
    U, _, Vt = np.linalg.svd(ahead[:3, :3])  # products of rotations stray from being one
    return [pose_matrix(U @ Vt, ahead[:3, 3]), T]


def _equalise(rgb: Pixels) -> Image8:
    """Grey with its contrast evened out tile by tile, so that exposure does not matter [CLAHE;
    Zuiderveld 1994].
    """
    import cv2

    return cv2.createCLAHE(3.0, (4, 4)).apply(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))


def _match_points(
    scene: GaussianScene, camera: PinholeCamera, T_world_camera: Array, seen: Image8, backend: str
) -> tuple[Array, Array] | None:
    """Spots of the scene (K, 3) [m] and where the image shows them (K, 2) [px]; None where there
    are too few.
    """
    import cv2

    frame = render(scene, camera, T_world_camera, backend)
    drawn = _equalise((255.0 * frame.rgb).astype(np.uint8))
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    still = np.zeros((*drawn.shape, 2), np.float32)
    there, back = (
        np.asarray(flow.calc(a, b, still.copy())) for a, b in ((drawn, seen), (seen, drawn))
    )
    rows, columns = np.mgrid[
        BORDER_PX : camera.height : SPACING_PX, BORDER_PX : camera.width : SPACING_PX
    ]
    v, u = rows.ravel(), columns.ravel()
    end = np.stack([u, v], axis=1) + there[v, u]
    at = np.rint(end).astype(int)
    inside = ((at >= 0) & (at < (camera.width, camera.height))).all(axis=1)
    u, v, end, at = u[inside], v[inside], end[inside], at[inside]
    miss = np.linalg.norm(end + back[at[:, 1], at[:, 0]] - np.stack([u, v], axis=1), axis=1)
    change = np.hypot(cv2.Sobel(drawn, cv2.CV_32F, 1, 0), cv2.Sobel(drawn, cv2.CV_32F, 0, 1))
    textured = cv2.boxFilter(change, -1, (7, 7))[v, u] > MIN_TEXTURE
    solid = (frame.alpha[v, u] > MIN_ALPHA) & (frame.depth[v, u] > MIN_DEPTH)
    good = (miss < MAX_ROUND_TRIP_PX) & textured & solid
    if good.sum() < MIN_POINTS:
        return None
    u, v = u[good], v[good]
    p_camera = camera.pixel_rays()[v, u] * frame.depth[v, u][:, None]
    return p_camera @ T_world_camera[:3, :3].T + T_world_camera[:3, 3], end[good] + 0.5


def _solve_pose(
    p_world: Array, pixels: Array, camera: PinholeCamera, tolerance_px: float
) -> RefinedPose | None:
    """The pose that most spots vote for, fitted to them, and its covariance."""
    import cv2

    cv2.setRNGSeed(0)  # the same image gives the same pose
    ok, turn, place, inliers = cv2.solvePnPRansac(
        p_world,
        pixels,
        camera.K,
        None,
        iterationsCount=300,
        reprojectionError=tolerance_px,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not ok or inliers is None or len(inliers) < MIN_POINTS:
        return None
    chosen = inliers.ravel()
    turn, place = cv2.solvePnPRefineLM(p_world[chosen], pixels[chosen], camera.K, None, turn, place)
    R = cv2.Rodrigues(turn)[0].T
    T_world_camera = pose_matrix(R, -R @ place.ravel())
    expected, depth = camera.project(p_world[chosen], T_world_camera)
    if not (depth > 0.0).all():
        return None
    sigma_px = max(SIGMA_PX, float(np.sqrt(np.mean((expected - pixels[chosen]) ** 2))))
    J = pixel_jacobian(p_world[chosen], camera, T_world_camera)
    own = np.repeat(np.square(SCENE_SIGMA), 3)
    covariance = np.asarray(
        COVARIANCE_FACTOR * sigma_px**2 * np.linalg.pinv(J.T @ J) + np.diag(own), np.float64
    )
    return RefinedPose(T_world_camera, covariance, len(chosen), len(chosen) / len(p_world))
