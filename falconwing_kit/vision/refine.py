"""Pose refinement: an image, a trained scene and a rough pose -> the pose at which both agree, with
its covariance; a whole video tracked from frame to frame, with rough poses where the track is lost.

Render the scene at the rough pose, follow textured points from the render into the image (optical
flow), take their positions in the world from the render's depth, and solve for the pose that
projects these positions to where the image shows them (perspective-n-point). Repeat from there.
Each round is robust to outliers (RANSAC) and to brightness, and converges from about a metre and
ten degrees; iNeRF (Yen-Chen et al., IROS 2021) descends on colours instead, from nearer.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from falconwing_kit.core.checks import Array
from falconwing_kit.core.frames import pose_matrix
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.render import render, require_pose
from falconwing_kit.vision.images import Pixels, require_image
from falconwing_kit.vision.marker import pixel_jacobian
from falconwing_kit.vision.pose_net import PoseEstimate

TOLERANCES_PX = (6.0, 3.0, 2.0)  # reprojection error of an inlier, one value a round
SPACING_PX = 6  # between tracked points
BORDER_PX = 4
MIN_TEXTURE = 25.0  # mean gradient around a point [grey levels]; on plain walls flow is undefined
MAX_ROUND_TRIP_PX = 1.0  # forward-backward error of the flow
MIN_ALPHA, MIN_DEPTH = 0.9, 0.3  # of the render: covered, and not in front of the lens [m]
MIN_POINTS, MIN_INLIER_SHARE = 80, 0.65  # below, most poses are false
COVARIANCE_FACTOR = 16.0  # errors of neighbouring points are correlated: so many count as one
MIN_SIGMA_PX = 0.3  # flow is not more accurate, however well the points agree
SCENE_SIGMA = (0.03, 0.004)  # of the scene itself [m, rad]: alignment and training
MAX_TRACK_GAP_S = 0.3  # older poses are no starting point


@dataclass(frozen=True, eq=False)
class RefinedPose(PoseEstimate):
    """A pose at which scene and image agree."""

    inliers: int  # points
    inlier_share: float  # of the tracked points


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
        scene: trained on photos of the room.
        camera: intrinsics at the image's size.
        T_world_camera: (4, 4), within about a metre and ten degrees.
        backend: the renderer.

    Returns:
        The pose; None where too little of the scene agrees with the image.

    Raises:
        InputError: the image is not of the camera's size, or the pose is not rigid.
    """
    T = require_pose("T_world_camera", T_world_camera)
    seen, refined = _equalise(require_image(image, camera, rgb=True)), None
    for tolerance_px in TOLERANCES_PX:
        points = _match_points(scene, camera, T, seen, backend)
        refined = None if points is None else _solve_pose(*points, camera, tolerance_px)
        if refined is None:
            return None
        T = refined.T_world_camera
    return refined if refined is not None and refined.inlier_share >= MIN_INLIER_SHARE else None


def track_scene(
    image: Callable[[int], Pixels | None],
    t: Array,
    scene: GaussianScene,
    camera: PinholeCamera,
    known: Mapping[int, Array],
    guesses: Mapping[int, Array],
    progress: Callable[[], None] = lambda: None,
) -> dict[int, RefinedPose]:
    """Refine each frame from its predecessor, forward through the flight and then backward.

    Args:
        image: frame 0..N-1 -> (H, W, 3) RGB; None where it was lost.
        t: (N,) [s].
        scene: trained on photos of the room.
        camera: intrinsics at the images' size.
        known: poses (4, 4) by frame that need no refinement, from the marker.
        guesses: rough poses (4, 4) by frame where the track is lost, from the network.
        progress: called after each frame of the forward pass.

    Returns:
        Refined poses by frame; frames without agreement are left out.
    """
    found: dict[int, RefinedPose] = {}
    for order in (range(len(t)), range(len(t) - 1, -1, -1)):
        forward = order.step > 0
        track: list[tuple[int, Array]] = []
        for frame in order:
            if frame not in known and frame not in found:
                starts = _predict_poses(track, frame, t)
                if forward and frame in guesses:
                    starts.append(guesses[frame])
                pixels = image(frame) if starts else None
                for start in starts:
                    refined = None
                    if pixels is not None:
                        refined = refine_pose(pixels, scene, camera, start)
                    if refined is not None:
                        found[frame] = refined
                        break
            if frame in known:
                track.append((frame, known[frame]))
            elif frame in found:
                track.append((frame, found[frame].T_world_camera))
            if forward:
                progress()
    return found


def _predict_poses(track: list[tuple[int, Array]], frame: int, t: Array) -> list[Array]:
    """Predictions of the camera pose: with constant velocity, and unchanged."""
    if not track or abs(t[frame] - t[track[-1][0]]) > MAX_TRACK_GAP_S:
        return []
    last, T = track[-1]
    if len(track) < 2 or not np.isclose(t[frame] - t[last], t[last] - t[track[-2][0]], rtol=0.5):
        return [T]
    ahead = T @ np.linalg.inv(track[-2][1]) @ T
    U, _, Vt = np.linalg.svd(ahead[:3, :3])  # nearest rotation: rounding errors accumulate
    return [pose_matrix(U @ Vt, ahead[:3, 3]), T]


def _equalise(rgb: Pixels) -> Any:
    """Grey image of equalised local contrast, whatever the exposure [CLAHE; Zuiderveld 1994]."""
    import cv2

    return cv2.createCLAHE(3.0, (4, 4)).apply(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))


def _match_points(
    scene: GaussianScene, camera: PinholeCamera, T_world_camera: Array, seen: Any, backend: str
) -> tuple[Array, Array] | None:
    """Points of the scene (K, 3) [m] and their pixels in the image (K, 2); None if too few."""
    import cv2

    frame = render(scene, camera, T_world_camera, backend)
    drawn = _equalise((255.0 * frame.rgb).astype(np.uint8))
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    no_flow = np.zeros((*drawn.shape, 2), np.float32)
    forward = np.asarray(flow.calc(drawn, seen, no_flow.copy()))
    backward = np.asarray(flow.calc(seen, drawn, no_flow.copy()))
    # a regular grid of points (u, v) in the render, and where the flow takes them in the image
    rows, columns = np.mgrid[
        BORDER_PX : camera.height : SPACING_PX, BORDER_PX : camera.width : SPACING_PX
    ]
    v, u = rows.ravel(), columns.ravel()
    end = np.stack([u, v], axis=1) + forward[v, u]
    end_pixel = np.rint(end).astype(int)
    inside = ((end_pixel >= 0) & (end_pixel < (camera.width, camera.height))).all(axis=1)
    u, v, end, end_pixel = u[inside], v[inside], end[inside], end_pixel[inside]
    # keep points that flow back to their start, with texture around them and a solid surface
    returned = end + backward[end_pixel[:, 1], end_pixel[:, 0]]
    round_trip_px = np.linalg.norm(returned - np.stack([u, v], axis=1), axis=1)
    gradient = np.hypot(cv2.Sobel(drawn, cv2.CV_32F, 1, 0), cv2.Sobel(drawn, cv2.CV_32F, 0, 1))
    textured = cv2.boxFilter(gradient, -1, (7, 7))[v, u] > MIN_TEXTURE
    solid = (frame.alpha[v, u] > MIN_ALPHA) & (frame.depth[v, u] > MIN_DEPTH)
    good = (round_trip_px < MAX_ROUND_TRIP_PX) & textured & solid
    if good.sum() < MIN_POINTS:
        return None
    # back-projection by the render's depth
    u, v = u[good], v[good]
    p_camera = camera.pixel_rays()[v, u] * frame.depth[v, u][:, None]
    return p_camera @ T_world_camera[:3, :3].T + T_world_camera[:3, 3], end[good] + 0.5


def _solve_pose(
    p_world: Array, pixels: Array, camera: PinholeCamera, tolerance_px: float
) -> RefinedPose | None:
    """The pose with most inliers (RANSAC), fitted to them, and its covariance."""
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
    p_world_inliers, pixels_inliers = p_world[inliers.ravel()], pixels[inliers.ravel()]
    turn, place = cv2.solvePnPRefineLM(p_world_inliers, pixels_inliers, camera.K, None, turn, place)
    # OpenCV gives the inverse: rotation and translation from world to camera
    R = cv2.Rodrigues(turn)[0].T
    T_world_camera = pose_matrix(R, -R @ place.ravel())
    projected, depth = camera.project(p_world_inliers, T_world_camera)
    if not (depth > 0.0).all():
        return None
    covariance = _pose_covariance(
        p_world_inliers, projected - pixels_inliers, camera, T_world_camera
    )
    count = len(p_world_inliers)
    return RefinedPose(T_world_camera, covariance, count, count / len(p_world))


def _pose_covariance(
    p_world_inliers: Array, reprojection_px: Array, camera: PinholeCamera, T_world_camera: Array
) -> Array:
    """Covariance of a pose fitted to points: the matching's share and the scene's own error.

    COVARIANCE_FACTOR sigma^2 (J^T J)^-1 + diag(SCENE_SIGMA^2), with sigma the reprojection errors'
    root mean square and J the derivative of the pixels by the pose.

    Args:
        p_world_inliers: (K, 3) the points [m].
        reprojection_px: (K, 2) their reprojection errors.
        camera: intrinsics.
        T_world_camera: (4, 4) the fitted pose.

    Returns:
        (6, 6) of position [m] and rotation vector [rad] in world axes.
    """
    sigma_px = max(MIN_SIGMA_PX, float(np.sqrt(np.mean(reprojection_px**2))))
    J_inliers = pixel_jacobian(p_world_inliers, camera, T_world_camera)
    correlated = COVARIANCE_FACTOR * sigma_px**2 * np.linalg.pinv(J_inliers.T @ J_inliers)
    scene_variance = np.repeat(np.square(SCENE_SIGMA), 3)
    return np.asarray(correlated + np.diag(scene_variance), np.float64)
