"""World alignment: reconstruction and surveyed points seen in photos -> similarity into the world.

    p_world = scale R p_reconstruction + t

Structure from motion recovers neither scale nor the direction of gravity. `align` triangulates the
surveyed corners from all photos that show them, computes Umeyama's similarity between them and the
survey, and refines its seven degrees of freedom on the corners' pixels, with the tape's error in
the model. The baseline `align_by_marker_poses` uses the marker's pose from each single photo; it
fails, since a small flat square has two poses with nearly the same image (pose ambiguity), which
puts distant cameras metres away.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from falconwing_kit.core.checks import Array, InputError, require_shape
from falconwing_kit.tools.capture.photo_files import Reconstruction
from falconwing_kit.tools.capture.survey.points import (
    MARKER_CORNERS,
    Numbers,
    PointObservations,
    Survey,
)

TAPE_SIGMA = 0.01  # [m] standard deviation of a tape measurement
MIN_PIXEL_SIGMA = 0.2  # [px] lower limit of the corners' estimated standard deviation
OUTLIER_PIXELS = 8.0  # [px] observations with a larger reprojection error are rejected
ROBUST = 3.0  # standard deviations beyond which the soft l1 loss is linear
_DOF = 7  # of a similarity: log scale, rotation, translation


@dataclass(frozen=True, eq=False)
class Alignment:
    """A similarity from a reconstruction into the kit's world, with its covariance."""

    scale: float  # metres per unit of the reconstruction
    R: Array  # (3, 3) R_world_reconstruction
    t: Array  # (3,) the reconstruction's origin in the world [m]
    method: str  # description of the method
    # (7, 7) of log scale, rotation about world axes [rad], translation [m]; NaN: unknown
    covariance: Array
    residuals: Mapping[str, Any] = field(default_factory=dict)  # by point name

    def points(self, p_reconstruction: Array) -> Array:
        """(N, 3) world points [m] from points (N, 3) of the reconstruction."""
        return self.scale * np.asarray(p_reconstruction) @ self.R.T + self.t

    def inverse(self, p_world: Array) -> Array:
        """(N, 3) points of the reconstruction from world points (N, 3) [m]."""
        return (np.asarray(p_world) - self.t) @ self.R / self.scale

    def sigma(self, p_world: Array) -> Array:
        """Standard deviation of the position of points, from the similarity's covariance.

        dp = d(log scale) (p - t) + d(rotation) x (p - t) + dt;  sigma^2 = trace(J C J^T)

        Includes the errors of pixels and tape, not deformations of the reconstruction itself.

        Args:
            p_world: (N, 3) [m].

        Returns:
            (N,) [m].
        """
        from_t = require_shape("p_world", p_world, (None, 3)) - self.t
        # (N, 3, 7): derivatives of each point with respect to log scale, rotation, translation
        jacobian = np.concatenate(
            [from_t[:, :, None], -_cross(from_t), np.broadcast_to(np.eye(3), (len(from_t), 3, 3))],
            2,
        )
        return np.sqrt(np.einsum("nij,jk,nik->n", jacobian, self.covariance, jacobian))


def transform_reconstruction(
    alignment: Alignment, reconstruction: Reconstruction
) -> Reconstruction:
    """The reconstruction in the kit's world: positions transformed, cameras rotated.

    Args:
        alignment: of this reconstruction.
        reconstruction: not aligned.

    Raises:
        InputError: the reconstruction is aligned already.
    """
    if reconstruction.aligned:
        raise InputError(
            "reconstruction: expected one that is not aligned yet, got one in world metres; "
            "take the raw one"
        )
    poses = reconstruction.T_world_camera.copy()
    poses[:, :3, :3] = alignment.R @ poses[:, :3, :3]
    poses[:, :3, 3] = alignment.points(poses[:, :3, 3])
    report = {
        **reconstruction.report,
        "alignment": alignment.method,
        "metres_per_unit": alignment.scale,
    }
    return replace(
        reconstruction,
        T_world_camera=poses,
        points=alignment.points(reconstruction.points),
        aligned=True,
        report=report,
    )


def align(
    reconstruction: Reconstruction, survey: Survey, observations: PointObservations
) -> Alignment:
    """Align by surveyed points seen in photos: triangulate, fit a similarity, refine on the pixels.

    Minimises over the similarity and the true places P_j, with rho the soft l1 loss:
        sum rho(|pixel - project(P_j)|^2 / sigma_px^2) + sum rho(|P_j - survey_j|^2 / TAPE_SIGMA^2)

    sigma_px is estimated from the residuals. The covariance is clustered by photo, since an error
    of a photo's pose moves all its corners in the same direction [sandwich estimator, White 1980].

    Args:
        reconstruction: not aligned.
        survey: its points of use "align" are used.
        observations: points seen in fewer than two photos are ignored.

    Returns:
        The alignment; residuals by point: number of photos and rms in pixels.

    Raises:
        InputError: fewer than three points that span a triangle can be used, or the reconstruction
            is aligned already.
    """
    if reconstruction.aligned:
        raise InputError(
            "reconstruction: expected one that is not aligned yet, got one in world metres; "
            "take the raw one"
        )
    observations = _alignment_observations(observations, survey)
    triangulated = triangulate(reconstruction, observations)
    names = [name for name in survey.names if name in triangulated]
    if (
        len(names) < 3
        or np.linalg.matrix_rank(survey.places(names) - survey.places(names[:1]), tol=0.05) < 2
    ):
        raise InputError(
            "observations: expected three surveyed points, not in a line, "
            f"each in two or more photos, got {len(names)}; "
            "click more points or take more photos of them"
        )
    start = umeyama(np.array([triangulated[name] for name in names]), survey.places(names))
    return _refine(
        reconstruction,
        survey,
        _inliers(reconstruction, observations, names, triangulated),
        names,
        start,
    )


def align_by_marker_poses(
    reconstruction: Reconstruction, survey: Survey, observations: PointObservations
) -> Alignment:
    """Baseline, which fails: marker pose of each single photo, then Umeyama on camera centres.

    This is the paper's recipe read literally, for comparison with `align`.

    Args:
        reconstruction: not aligned.
        survey: with the marker's four corners.
        observations: of the marker's corners.

    Returns:
        The alignment, without covariance.

    Raises:
        InputError: the survey lacks a marker's corner, or fewer than three photos show all four.
    """
    import cv2

    p_corners = _marker_places(survey)
    T_world_marker, size = _marker_frame(p_corners)
    square = 0.5 * size * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], np.float64)
    corners = [observations.of(name) for name in MARKER_CORNERS]
    shared = set.intersection(*(set(photos.tolist()) for photos, _ in corners))
    if len(shared) < 3:
        raise InputError(
            f"photos: expected the marker whole in three or more photos, got it in {len(shared)}; "
            "take more"
        )
    from_reconstruction, from_marker = [], []
    for number in sorted(shared):
        pixels = np.array([found[list(photos).index(number)] for photos, found in corners])
        straight = np.ascontiguousarray(reconstruction.pixel_directions(pixels)[:, :2])
        _, turns, places, _ = cv2.solvePnPGeneric(
            square, straight, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        R_camera_marker = cv2.Rodrigues(turns[0])[0]  # the first is the better of the two solutions
        p_marker_camera = -R_camera_marker.T @ places[0].ravel()
        from_marker.append(T_world_marker[:3, :3] @ p_marker_camera + T_world_marker[:3, 3])
        from_reconstruction.append(reconstruction.T_world_camera[number, :3, 3])
    scale, R, t = umeyama(np.array(from_reconstruction), np.array(from_marker))
    misses = np.linalg.norm(scale * np.array(from_reconstruction) @ R.T + t - from_marker, axis=1)
    residuals = {"photos": len(shared), "camera_miss_median_m": float(np.median(misses))}
    return Alignment(
        scale,
        R,
        t,
        "marker pose of each photo (baseline)",
        np.full((_DOF, _DOF), np.nan),
        residuals,
    )


def umeyama(p_from: Array, p_to: Array) -> tuple[float, Array, Array]:
    """The least-squares similarity between two sets of points.

    With centred points A, B:  U S V^T = svd(B^T A),  D = diag(1, 1, det(U V^T)),  R = U D V^T,
    scale = trace(S D) / |A|^2,  t = mean(to) - scale R mean(from)      [Umeyama 1991, eq. 40-43]

    Args:
        p_from: (N, 3), N >= 3.
        p_to: (N, 3).

    Returns:
        scale, R (3, 3), t (3,) with p_to = scale R p_from + t.

    Raises:
        InputError: the points lie in a line, or are fewer than three.
    """
    p_from, p_to = (
        require_shape("p_from", p_from, (None, 3)),
        require_shape("p_to", p_to, (len(p_from), 3)),
    )
    mean_from, mean_to = p_from.mean(axis=0), p_to.mean(axis=0)
    A, B = p_from - mean_from, p_to - mean_to
    U, S, Vt = np.linalg.svd(B.T @ A)
    if len(p_from) < 3 or not S[1] > 1e-9 * S[0] > 0.0:
        raise InputError(
            f"points: expected three or more that are not in a line, got {len(p_from)}; "
            "add points beside it"
        )
    D = np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)])
    R = U @ D @ Vt
    scale = float(np.trace(np.diag(S) @ D) / (A**2).sum())
    return scale, R, mean_to - scale * R @ mean_from


def triangulate(
    reconstruction: Reconstruction, observations: PointObservations
) -> dict[str, Array]:
    """Points from the rays of all photos that show them, with outlying observations rejected.

    The point nearest to all rays solves sum w (I - d d^T) (p - c) = 0 with the unit ray d and the
    camera centre c. Iteratively reweighted: w = 1 / distance^2, so that angles count, and w = 0
    where the reprojection error exceeds OUTLIER_PIXELS or three times its median.

    Returns:
        By name: (3,) in the reconstruction's frame, for every point with two or more consistent
            observations.
    """
    points = {}
    for name in dict.fromkeys(observations.names):
        photos, pixels = observations.of(name)
        rays = np.array([_ray(reconstruction, k, uv) for k, uv in zip(photos, pixels, strict=True)])
        centres = reconstruction.T_world_camera[photos, :3, 3]
        weights = np.ones(len(photos))
        for _ in range(10):
            across = weights[:, None, None] * (np.eye(3) - rays[:, :, None] * rays[:, None, :])
            if (weights > 0).sum() < 2 or np.linalg.cond(across.sum(axis=0)) > 1e6:
                break
            point = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centres))
            miss = _reprojection_errors(reconstruction, point, photos, pixels)
            limit = max(OUTLIER_PIXELS, 3.0 * float(np.median(miss)))
            weights = np.where(miss < limit, 1.0 / ((point - centres) ** 2).sum(axis=1), 0.0)
        else:
            if np.median(miss) < OUTLIER_PIXELS:
                points[name] = point
    return points


def _ray(reconstruction: Reconstruction, photo: int, pixel: Array) -> Array:
    """(3,) unit direction of a pixel's ray, in the reconstruction's axes."""
    direction = (
        reconstruction.T_world_camera[photo, :3, :3]
        @ reconstruction.pixel_directions(pixel[None])[0]
    )
    return np.asarray(direction / np.linalg.norm(direction))


def _reprojection_errors(
    reconstruction: Reconstruction, point: Array, photos: Numbers, pixels: Array
) -> Array:
    """(K,) distances of observations from a projected point [px]; infinite behind the camera."""
    seen = np.array(
        [reconstruction.project(point[None], int(photo))[0] for photo in photos]
    ).reshape(-1, 2)
    return np.nan_to_num(np.linalg.norm(seen - pixels, axis=1), nan=np.inf)


def _alignment_observations(observations: PointObservations, survey: Survey) -> PointObservations:
    """Observations of the points whose use is "align"."""
    names = survey.select("align").names
    keep = np.array([name in names for name in observations.names], bool)
    chosen = tuple(name for name, kept in zip(observations.names, keep, strict=True) if kept)
    return PointObservations(chosen, observations.photos[keep], observations.pixels[keep])


def _inliers(
    reconstruction: Reconstruction,
    observations: PointObservations,
    names: list[str],
    triangulated: Mapping[str, Array],
) -> PointObservations:
    """Observations near their triangulated point."""
    rows: list[Any] = []
    for name in names:
        photos, pixels = observations.of(name)
        near = (
            _reprojection_errors(reconstruction, triangulated[name], photos, pixels)
            < OUTLIER_PIXELS
        )
        rows += [
            (name, int(k), uv.tolist()) for k, uv in zip(photos[near], pixels[near], strict=True)
        ]
    return PointObservations.join(rows)


def _refine(
    reconstruction: Reconstruction,
    survey: Survey,
    observations: PointObservations,
    names: list[str],
    start: tuple[float, Array, Array],
) -> Alignment:
    """Joint least squares over the similarity (7) and the true point places, on pixels and tape."""
    from scipy.optimize import least_squares

    scale, R, t = start
    p_survey, place = (
        survey.places(names),
        np.array([names.index(name) for name in observations.names]),
    )
    pixel_sigma = 1.0

    # x: step of the similarity (7), and deviations of the true places in TAPE_SIGMA (3 each)
    def residuals(x: Array) -> Array:
        at = _perturb_similarity(scale, R, t, x[:_DOF])
        p_true = p_survey + TAPE_SIGMA * x[_DOF:].reshape(-1, 3)
        p_reconstruction = ((p_true - at[2]) @ at[1] / at[0])[place]
        seen = _project_each(reconstruction, p_reconstruction, observations.photos)
        return np.concatenate([(seen - observations.pixels).ravel() / pixel_sigma, x[_DOF:]])

    x = np.zeros(_DOF + 3 * len(names))
    for again in range(3):  # the second and third time with sigma_px from the residuals
        fit = least_squares(residuals, x, loss="soft_l1", f_scale=ROBUST, x_scale="jac")
        x, pixels = fit.x, pixel_sigma * fit.fun[: 2 * len(observations)]
        if again < 2:
            pixel_sigma = max(MIN_PIXEL_SIGMA, 1.4826 * float(np.median(np.abs(pixels))))
    scale, R, t = _perturb_similarity(scale, R, t, x[:_DOF])
    covariance = _covariance(fit.fun, fit.jac, observations)
    miss = np.linalg.norm(pixels.reshape(-1, 2), axis=1)
    by_name = {
        name: {
            "photos": int((place == j).sum()),
            "rms_px": float(np.sqrt((miss[place == j] ** 2).mean())),
        }
        for j, name in enumerate(names)
    }
    return Alignment(
        scale, R, t, f"{len(names)} surveyed points, refined on pixels", covariance, by_name
    )


def _perturb_similarity(
    scale: float, R: Array, t: Array, step: Array
) -> tuple[float, Array, Array]:
    """The similarity after a step in log scale, rotation about world axes, and translation."""
    from scipy.spatial.transform import Rotation

    return (
        scale * float(np.exp(step[0])),
        Rotation.from_rotvec(step[1:4]).as_matrix() @ R,
        t + step[4:7],
    )


def _project_each(reconstruction: Reconstruction, points: Array, photos: Numbers) -> Array:
    """(K, 2) pixels of points (K, 3), each in its own photo; far outside if behind the camera."""
    poses, camera = reconstruction.T_world_camera[photos], reconstruction.camera
    p_camera = np.einsum("nji,nj->ni", poses[:, :3, :3], points - poses[:, :3, 3])
    straight = p_camera[:, :2] / np.maximum(p_camera[:, 2:], 1e-6)
    bent = straight * (1.0 + reconstruction.k1 * (straight**2).sum(axis=1, keepdims=True))
    return bent * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def _covariance(values: Array, jacobian: Array, observations: PointObservations) -> Array:
    """(7, 7) covariance of the similarity, clustered by photo.

    C = H^-1 (sum over photos g g^T + tape) H^-1 with g the gradient of one photo. With few photos
    this is too small, so the larger of C and H^-1 by trace is returned.
    """
    count = 2 * len(observations)
    # scipy scales J by ()^-3/4; the gradient of the soft l1 loss has ()^-1/2
    values = values * (1.0 + (values / ROBUST) ** 2) ** 0.25
    bread = np.linalg.inv(jacobian.T @ jacobian)
    # gradient of each observation (K, 7 + 3 points), summed over the observations of a photo
    gradients = (jacobian * values[:, None])[:count].reshape(len(observations), 2, -1).sum(axis=1)
    by_photo = np.array(
        [gradients[observations.photos == k].sum(axis=0) for k in np.unique(observations.photos)]
    )
    share = len(by_photo) / max(1, len(by_photo) - 1)
    sandwich = (
        bread @ (share * by_photo.T @ by_photo + jacobian[count:].T @ jacobian[count:]) @ bread
    )
    best = max((sandwich, bread), key=lambda C: float(np.trace(C[:_DOF, :_DOF])))
    return np.asarray(best[:_DOF, :_DOF])


def _cross(vectors: Array) -> Array:
    """(N, 3, 3) matrices with cross(v) w = v x w."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack(
        [np.stack(row, -1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))], -2
    )


def _marker_places(survey: Survey) -> Array:
    """(4, 3) the marker's corners [m]."""
    missing = [name for name in MARKER_CORNERS if name not in survey.names]
    if missing:
        raise InputError(
            f"survey: expected the marker's four corners, {missing[0]} is missing; "
            "measure and add it"
        )
    return survey.places(MARKER_CORNERS)


def _marker_frame(p_corners: Array) -> tuple[Array, float]:
    """T_world_marker (x right, y up, z out of the marker), and the side of the square [m]."""
    top_left, top_right, _, bottom_left = p_corners
    right, up = top_right - top_left, top_left - bottom_left
    size = 0.5 * float(np.linalg.norm(right) + np.linalg.norm(up))
    x = right / np.linalg.norm(right)
    z = np.cross(x, up) / np.linalg.norm(np.cross(x, up))
    T_world_marker = np.eye(4)
    T_world_marker[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T_world_marker[:3, 3] = p_corners.mean(axis=0)
    return T_world_marker, size
