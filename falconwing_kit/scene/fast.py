"""Fast renderer: GaussianScene + camera pose -> image, alpha and depth on a CPU, compiled by numba.

It equals `reference` to a hundredth of a grey level and trades readability for speed; it has no
gradients. Steps:

    project    each Gaussian becomes a splat: an ellipse in the image with a colour, if in view;
               several at once
    sort       the splats, nearest first
    intersect  the tiles of the image that each ellipse overlaps, exactly
    scatter    one list per tile, nearest first
    rasterize  each tile by itself, front to back, a row of pixels at a time

A kernel does one of WORK_PARTS parts of its step, so that threads share the parts; the image does
not depend on which thread does which. The threads are Python's: numba's own take longer to compile,
and some of its threading layers do not allow two callers. Conventions and constants are those of
gsplat 1.5, "classic".
"""

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numba import config, njit
from numpy.typing import ArrayLike, NDArray

from falconwing_kit.core.checks import require_range, require_shape
from falconwing_kit.scene import sh as harmonics
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene, Images

NEAR, FAR = 0.01, 3.4e38  # least depth that is drawn, and the largest of a float32 [m]
BLUR = 0.3  # added to the variances of every splat, so that none falls between pixels [px^2]
FRUSTUM_MARGIN = 0.3  # in half fields of view: the projection is linearised only up to there
ALPHA_MAX, ALPHA_MIN = 0.999, 1.0 / 255.0
ZERO, HALF, ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
LN_255 = math.log(255.0)
REACH2 = 1.001 * 2.0 * LN_255  # squared half width of the widest ellipse, in standard deviations
TRANSMITTANCE_MIN = 1e-4  # a pixel that transmits less is saturated

WORK_PARTS = 16  # parts of every step, shared by the threads
TILE_WIDTH, TILE_HEIGHT = 16, 16  # [px], at most 16; the width is two AVX2 registers
TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT
DIGITS, LAST_DIGIT = 1 << 14, np.uint64((1 << 14) - 1)  # of a pass of the sort by depth
NEAR_BITS = np.float32(NEAR).view(np.uint32)
BATCH = 32  # splats fetched together, so that their waits for memory overlap
MAX_INTERSECTIONS = 1 << 24  # splats times tiles, 8 bytes each; with more the image is cut in bands

# A splat: centre u, v [px]; half width and height of its ellipse; correlation r of u and v and its
# complement sqrt(1 - r^2); the conic with its square completed,
# sigma = conic_v dv^2 + conic_u (du - conic_slope dv)^2; -ln(opacity); colour; depth [m].
_FIELDS = "extent_u extent_v correlation complement conic_slope conic_u conic_v neg_log_opacity"
_FIELDS += " red green blue depth"
SPLAT = np.dtype(
    [("u", np.float64), ("v", np.float64), *((name, np.float32) for name in _FIELDS.split())]
)


def compile_kernel(function: Callable[..., Any]) -> Any:
    """The function as machine code without the interpreter lock, cached on disk where possible."""
    options: dict[str, Any] = {
        "nogil": True,
        "error_model": "numpy",
        "fastmath": {"contract", "nsz"},
    }
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # numba found no folder for its cache
        return njit(**options)(function)


def render_fast(
    scene: GaussianScene | Sequence[GaussianScene],
    camera: PinholeCamera,
    T_world_camera: ArrayLike,
    background: ArrayLike = (0.0, 0.0, 0.0),
    antialiased: bool = False,
    threads: int | None = None,
) -> Images:
    """Image, alpha and depth of a scene, as from `reference`.

    Args:
        scene: the Gaussians; or several scenes in the same coordinates, drawn as if joined; this
            renderer alone does not join them first, which would cost a copy of the hall for every
            image.
        background: (3,) red, green, blue 0..1 behind everything.
        antialiased: lower the opacity of splats smaller than a pixel by what BLUR adds to their
            area.
        threads: None for the cores of this process, or the environment variable NUMBA_NUM_THREADS;
            it changes no bit of the image.

    Returns:
        rgb (H, W, 3), alpha (H, W) and depth (H, W) [m], 0 where alpha is 0; all float32. The depth
        is the mean of the splats' depths weighted by their shares in the pixel.
    """
    pose = require_shape("T_world_camera", T_world_camera, (4, 4))
    behind = require_shape("background", background, (3,)).astype(np.float32)
    scenes = (scene,) if isinstance(scene, GaussianScene) else tuple(scene)
    cores = threads
    if cores is None:
        cores = config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
    workers = min(int(require_range("threads", cores, low=1, high=1024)), WORK_PARTS)
    with ThreadPoolExecutor(workers) as pool:

        def run(kernel: Any, *arguments: Any) -> None:
            """Run all parts of a kernel's step, and wait for the last."""
            parts = iter(range(WORK_PARTS))  # every thread takes the next

            def work() -> None:
                for part in parts:
                    kernel(part, *arguments)

            helpers = [pool.submit(work) for _ in range(workers - 1)]
            work()
            for helper in helpers:
                helper.result()

        splats, order, tiles_per_splat = _splats_in_view(run, scenes, camera, pose, antialiased)
        rgb = np.empty((camera.height, camera.width, 3), np.float32)
        alpha, depth = np.empty(rgb.shape[:2], np.float32), np.empty(rgb.shape[:2], np.float32)
        for band, begins in _bands(tiles_per_splat, camera.width, camera.height):
            offsets, lists = _lists_of_tiles(run, splats, order, begins, band, camera.height)
            run(rasterize_tiles, splats, offsets, lists, band[0], behind, rgb, alpha, depth)
    return rgb, alpha, depth


def _splats_in_view(
    run: Any, scenes: Sequence[GaussianScene], camera: PinholeCamera, pose: Any, antialiased: bool
) -> Any:
    """Splats (N,); indices (M,) of those in view, nearest first; tiles (M,) in the box of each."""
    R_world_camera, p_world = np.ascontiguousarray(pose[:3, :3]), np.ascontiguousarray(pose[:3, 3])
    places = sum(len(scene) for scene in scenes)
    splats, tiles_per_splat = np.empty(places, SPLAT), np.empty(places, np.int32)
    depths, counts = np.empty(places, np.float32), np.empty(WORK_PARTS, np.int64)
    focal, centre = (float(camera.fx), float(camera.fy)), (float(camera.cx), float(camera.cy))
    lens = (*focal, *centre, camera.width, camera.height)
    first, in_view = 0, []
    for scene in scenes:
        arrays = (scene.means, scene.quaternions, scene.scales, scene.opacities, scene.sh)
        rows = slice(first, first + len(scene))
        results = splats[rows], tiles_per_splat[rows], depths[rows], counts
        run(project_kernel, *arrays, R_world_camera, p_world, lens, bool(antialiased), *results)
        begins = first + len(scene) * np.arange(WORK_PARTS) // WORK_PARTS
        in_view += [
            np.arange(k, k + n, dtype=np.uint32) for k, n in zip(begins, counts, strict=True)
        ]
        first = rows.stop
    order = sort_by_depth(np.concatenate(in_view), depths.view(np.uint32))
    return splats, order, tiles_per_splat[order]


def _bands(
    tiles_per_splat: Any, width: int, height: int
) -> Iterator[tuple[tuple[int, int], NDArray[np.int64]]]:
    """Bands of tile columns (first, last), and the offset of each part's intersections in them."""
    across, down = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
    columns = across
    # A splat overlaps at most columns * down tiles of a band: halve until all of them fit.
    while columns > 1 and (
        np.minimum(tiles_per_splat, columns * down).sum(dtype=np.int64) > MAX_INTERSECTIONS
    ):
        columns = -(-columns // 2)
    capacity = np.cumsum(np.minimum(tiles_per_splat, columns * down), dtype=np.int64)
    offsets = np.concatenate([[0], capacity])
    part_ends = len(tiles_per_splat) * np.arange(WORK_PARTS + 1) // WORK_PARTS
    for first in range(0, across, columns):
        yield (first, min(first + columns, across) - 1), offsets[part_ends]


def _lists_of_tiles(
    run: Any, splats: Any, order: Any, begins: Any, band: tuple[int, int], height: int
) -> Any:
    """Offsets (tiles + 1,) of each tile's list, and all lists one after the other."""
    tiles = (band[1] - band[0] + 1) * -(-height // TILE_HEIGHT)
    intersections, counts = np.empty(begins[-1], np.int64), np.zeros((WORK_PARTS, tiles), np.int64)
    run(intersect_tiles, splats, order, begins, band, height, intersections, counts)
    # Within a tile's list the parts follow each other, so that the splats stay sorted by depth.
    ends = np.cumsum(counts.T).reshape(tiles, WORK_PARTS).T
    places = np.ascontiguousarray(ends - counts)
    part_ends = begins[:-1] + counts.sum(axis=1)
    tile_intersections = np.empty(ends[-1, -1], np.int64)
    run(scatter_to_tiles, intersections, begins, part_ends, places, tile_intersections)
    return np.concatenate([[0], ends[-1]]), tile_intersections


@compile_kernel
def project_kernel(
    part, means, quaternions, scales, opacities, sh, R_world_camera, p_world, lens, antialiased,
    splats, tiles_per_splat, depths, counts,
):  # fmt: skip
    """Gaussians -> splats in view, the numbers of tiles in their boxes, and their depths.

    They fill the part's places from its first, counts (parts,) of them, in the order of the scene.
    The ellipse ends where opacity exp(-sigma) = ALPHA_MIN, sigma = 1/2 d^T cov^-1 d.
    """
    fx, fy, cx, cy, width, height = lens
    block, indices = np.empty(BLOCK_COLUMNS * BLOCK), np.empty(BLOCK, np.int64)
    Y = np.empty(16, np.float32)
    begin, end = len(means) * part // WORK_PARTS, len(means) * (part + 1) // WORK_PARTS
    place = start = begin
    while start < end:
        start, count = gather_block(
            start, end, means, quaternions, scales, R_world_camera, p_world, lens, block, indices
        )
        project_block(count, R_world_camera, lens, block)
        for lane in range(count):
            i, j = indices[lane], np.uint64(lane)
            opacity = opacities[i] * (block[ANTIALIASING + j] if antialiased else 1.0)
            if not opacity >= ALPHA_MIN:
                continue
            # Bounding box of the ellipse, and whether it overlaps the image
            s, neg_log_opacity = splats[place], -math.log(np.float32(opacity))
            extent = math.sqrt(2.0 * max(LN_255 - neg_log_opacity, 0.0))
            s.u, s.v = fx * block[X_PER_Z + j] + cx, fy * block[Y_PER_Z + j] + cy
            s.extent_u, s.extent_v = extent * block[SD_U + j], extent * block[SD_V + j]
            if not (s.u + s.extent_u >= 0.0 and s.u - s.extent_u <= width):
                continue
            if not (s.v + s.extent_v >= 0.0 and s.v - s.extent_v <= height):
                continue
            left, right = tile_range(s.u, s.extent_u, TILE_WIDTH, 0, (width - 1) // TILE_WIDTH)
            top, bottom = tile_range(s.v, s.extent_v, TILE_HEIGHT, 0, (height - 1) // TILE_HEIGHT)
            tiles_per_splat[place] = (right - left + 1) * (bottom - top + 1)
            s.correlation, s.complement = block[CORRELATION + j], block[COMPLEMENT + j]
            s.conic_slope, s.conic_u = block[CONIC_SLOPE + j], block[CONIC_U + j]
            s.conic_v, s.neg_log_opacity = block[CONIC_V + j], neg_log_opacity
            depths[place] = s.depth = block[DEPTH + j]
            s.red, s.green, s.blue = evaluate_colour(i, sh, vector_to(i, means, p_world), Y)
            place += 1
    counts[part] = place - begin


# A block of Gaussians that are projected together: columns of BLOCK numbers, all in one array,
# where the compiler sees that they do not overlap and so takes several Gaussians at once.
BLOCK, BLOCK_COLUMNS = 64, 18
X_PER_Z, Y_PER_Z, DEPTH, QUATERNION_W, QUATERNION_X, QUATERNION_Y, QUATERNION_Z = (
    np.uint64(BLOCK * k) for k in range(7)
)
SCALE_0, SCALE_1, SCALE_2 = (np.uint64(BLOCK * k) for k in range(7, 10))
SD_U, SD_V, CORRELATION, COMPLEMENT, CONIC_SLOPE, CONIC_U, CONIC_V, ANTIALIASING = (
    np.uint64(BLOCK * k) for k in range(10, 18)
)


@compile_kernel
def gather_block(
    start, end, means, quaternions, scales, R_world_camera, p_world, lens, block, indices
):
    """Fill a block with the next Gaussians that may be in view; where to go on, and their number.

    Left out is what is nearer than NEAR or behind, and what is so far out that even a ball of the
    Gaussian's largest scale ends outside the image.
    """
    fx, fy, cx, cy, width, height = lens
    x_min, x_max, y_min, y_max = linear_range(lens)
    count = 0
    while start < end and count < BLOCK:
        i = start
        start += 1
        x, y, z = rotate_to_camera(vector_to(i, means, p_world), R_world_camera)
        if not NEAR <= z <= FAR:
            continue
        per_z = 1.0 / z
        x, y = x * per_z, y * per_z
        u, v = fx * x + cx, fy * y + cy
        ball = max(scales[i, 0], scales[i, 1], scales[i, 2]) * per_z
        reach_u, reach_v = fx * fx * ball * ball, fy * fy * ball * ball
        reach_u = REACH2 * (reach_u * (1.0 + clamp(x, x_min, x_max) ** 2) + BLUR)
        reach_v = REACH2 * (reach_v * (1.0 + clamp(y, y_min, y_max) ** 2) + BLUR)
        out_u, out_v = max(-u, u - width, 0.0), max(-v, v - height, 0.0)
        if out_u * out_u > reach_u or out_v * out_v > reach_v:
            continue
        j = np.uint64(count)
        indices[count], block[X_PER_Z + j], block[Y_PER_Z + j], block[DEPTH + j] = i, x, y, z
        block[QUATERNION_W + j], block[QUATERNION_X + j] = quaternions[i, 0], quaternions[i, 1]
        block[QUATERNION_Y + j], block[QUATERNION_Z + j] = quaternions[i, 2], quaternions[i, 3]
        block[SCALE_0 + j], block[SCALE_1 + j] = scales[i, 0], scales[i, 1]
        block[SCALE_2 + j] = scales[i, 2]
        count += 1
    return start, count


@compile_kernel
def linear_range(lens):
    """Least and largest x/z, and y/z, for which the projection is linearised."""
    fx, fy, cx, cy, width, height = lens
    margin_u, margin_v = FRUSTUM_MARGIN * 0.5 * width, FRUSTUM_MARGIN * 0.5 * height
    x_min, x_max = (0.0 - cx - margin_u) / fx, (width - cx + margin_u) / fx
    return x_min, x_max, (0.0 - cy - margin_v) / fy, (height - cy + margin_v) / fy


@compile_kernel
def project_block(count, R_world_camera, lens, block):
    """Centres, rotations and scales of a block -> its ellipses, several at once.

    cov = J A (J A)^T + BLUR I,  A = R_camera_world R diag(scales)     [Zwicker et al. 2001, EWA]
    J = [[fx/z, 0, -fx x/z^2], [0, fy/z, -fy y/z^2]], x/z and y/z clamped to FRUSTUM_MARGIN
    """
    fx, fy = lens[:2]
    x_min, x_max, y_min, y_max = linear_range(lens)
    R = (
        (R_world_camera[0, 0], R_world_camera[0, 1], R_world_camera[0, 2]),
        (R_world_camera[1, 0], R_world_camera[1, 1], R_world_camera[1, 2]),
        (R_world_camera[2, 0], R_world_camera[2, 1], R_world_camera[2, 2]),
    )
    for lane in range(count):
        j = np.uint64(lane)
        w, x = block[QUATERNION_W + j], block[QUATERNION_X + j]
        y, z = block[QUATERNION_Y + j], block[QUATERNION_Z + j]
        # Principal axes in camera axes, times their standard deviations: the columns of A
        axis_0 = (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y))
        axis_1 = (2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x))
        axis_2 = (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y))
        A_0 = scaled_axis(block[SCALE_0 + j], axis_0, R)
        A_1 = scaled_axis(block[SCALE_1 + j], axis_1, R)
        A_2 = scaled_axis(block[SCALE_2 + j], axis_2, R)
        # The rows (a, b, c) and (d, e, f) of J A, and the covariance from them
        per_z = 1.0 / block[DEPTH + j]
        x, y = clamp(block[X_PER_Z + j], x_min, x_max), clamp(block[Y_PER_Z + j], y_min, y_max)
        per_m_u, per_m_v = fx * per_z, fy * per_z  # pixels of a metre
        a, d = per_m_u * (A_0[0] - x * A_0[2]), per_m_v * (A_0[1] - y * A_0[2])
        b, e = per_m_u * (A_1[0] - x * A_1[2]), per_m_v * (A_1[1] - y * A_1[2])
        c, f = per_m_u * (A_2[0] - x * A_2[2]), per_m_v * (A_2[1] - y * A_2[2])
        uu, uv, vv = a * a + b * b + c * c, a * d + b * e + c * f, d * d + e * e + f * f
        # The square of the rows' cross product: the determinant before BLUR, >= 0 despite rounding
        x, y, z = b * f - c * e, c * d - a * f, a * e - b * d
        area = x * x + y * y + z * z
        det = area + BLUR * (uu + vv) + BLUR * BLUR
        uu, vv = uu + BLUR, vv + BLUR
        sd_u, sd_v = math.sqrt(uu), math.sqrt(vv)
        block[SD_U + j], block[SD_V + j], block[ANTIALIASING + j] = (
            sd_u,
            sd_v,
            math.sqrt(area / det),
        )
        # The conic, cov^-1, with its square completed in du
        per_vv, per_sds = 1.0 / vv, 1.0 / (sd_u * sd_v)
        block[CORRELATION + j], block[COMPLEMENT + j] = uv * per_sds, math.sqrt(det) * per_sds
        block[CONIC_SLOPE + j], block[CONIC_U + j] = uv * per_vv, 0.5 * vv / det
        block[CONIC_V + j] = 0.5 * per_vv


@compile_kernel
def vector_to(i, means, p_world):
    """From the camera to a Gaussian, in the world's axes [m]."""
    return means[i, 0] - p_world[0], means[i, 1] - p_world[1], means[i, 2] - p_world[2]


@compile_kernel
def rotate_to_camera(v_world, R):
    """R^T v, a vector of the world in the camera's axes, with R = R_world_camera."""
    x, y, z = v_world
    return (
        R[0, 0] * x + R[1, 0] * y + R[2, 0] * z,
        R[0, 1] * x + R[1, 1] * y + R[2, 1] * z,
        R[0, 2] * x + R[1, 2] * y + R[2, 2] * z,
    )


@compile_kernel
def scaled_axis(scale, axis, R):
    """A principal axis in the camera's axes, times its standard deviation; R as three rows."""
    (x, y, z), (Rx, Ry, Rz) = axis, R
    return (
        scale * (Rx[0] * x + Ry[0] * y + Rz[0] * z),
        scale * (Rx[1] * x + Ry[1] * y + Rz[1] * z),
        scale * (Rx[2] * x + Ry[2] * y + Rz[2] * z),
    )


@compile_kernel
def evaluate_colour(i, sh, toward, Y):
    """Red, green, blue >= 0 of a Gaussian seen along a vector: 1/2 + sum_k sh_k Y_k(direction)."""
    x, y, z = toward
    inv = 1.0 / math.sqrt(x * x + y * y + z * z)
    x, y, z = np.float32(x * inv), np.float32(y * inv), np.float32(z * inv)
    fill_spherical_harmonics(sh.shape[1], x, y, z, Y)
    red, green, blue = HALF, HALF, HALF
    for k in range(sh.shape[1]):
        red += sh[i, k, 0] * Y[k]
        green += sh[i, k, 1] * Y[k]
        blue += sh[i, k, 2] * Y[k]
    return max(red, ZERO), max(green, ZERO), max(blue, ZERO)


fill_spherical_harmonics = compile_kernel(harmonics.fill_spherical_harmonics)


@compile_kernel
def clamp(value, low, high):
    """The value within bounds; nan becomes the lower one."""
    value = value if value > low else low
    return value if value < high else high


@compile_kernel
def tile_range(center, extent, side, first, last):
    """First and last tile along an axis that center +- extent overlaps, within first..last."""
    per_side = np.float32(1.0 / side)
    low, high = (center - extent) * per_side, (center + extent) * per_side
    return int(clamp(low, first, last)), int(clamp(high, first, last))


@compile_kernel
def sort_by_depth(indices, keys):
    """The indices sorted by their keys (N,), the bits of depths from NEAR on, which sort as depths.

    A radix sort: stable counting sorts by 14 bits each, so that equal keys keep their order. Two of
    them suffice up to a depth of 40,000 km.
    """
    pairs, ordered = np.empty(len(indices), np.uint64), np.empty(len(indices), np.uint64)
    largest = np.uint64(0)
    for k in range(len(indices)):
        key = np.uint64(keys[indices[k]] - NEAR_BITS)
        pairs[k] = key << np.uint64(32) | np.uint64(indices[k])
        largest = max(largest, key)
    bits = np.uint64(0)
    while largest >> bits:
        places = np.zeros(DIGITS + 1, np.uint32)
        for pair in pairs:
            places[(pair >> (bits + np.uint64(32)) & LAST_DIGIT) + np.uint64(1)] += np.uint32(1)
        for digit in range(DIGITS):
            places[digit + 1] += places[digit]
        for pair in pairs:
            digit = pair >> (bits + np.uint64(32)) & LAST_DIGIT
            ordered[places[digit]] = pair
            places[digit] += np.uint32(1)
        pairs, ordered = ordered, pairs
        bits += np.uint64(14)
    return pairs.astype(np.uint32)  # the lower half of each pair


@compile_kernel
def intersect_tiles(part, splats, order, begins, band, height, intersections, counts):
    """Write each pair of splat and overlapped tile as splat << 32 | tile << 8 | top << 4 | bottom.

    top and bottom are the first and last pixel row of the tile that the ellipse covers; counts
    (parts, tiles) gets the number of splats on each tile.
    """
    down, end = (height - 1) // TILE_HEIGHT + 1, begins[part]
    stop = len(order) * (part + 1) // WORK_PARTS
    batch = np.empty(BATCH, SPLAT)
    for start in range(len(order) * part // WORK_PARTS, stop, BATCH):
        count = min(BATCH, stop - start)
        for j in range(count):
            batch[j] = splats[order[start + j]]
        for j in range(count):
            s = batch[j]
            left, right = tile_range(s.u, s.extent_u, TILE_WIDTH, band[0], band[1])
            # The box whose tiles `begins` counted; rounding must not lead out of it.
            top_row, bottom_row = tile_range(s.v, s.extent_v, TILE_HEIGHT, 0, down - 1)
            for column in range(left, right + 1):
                first, last = row_range_in_column(s, column, height)
                first_row = max(first // TILE_HEIGHT, top_row)
                last_row = min(last // TILE_HEIGHT, bottom_row)
                for row in range(first_row, last_row + 1):
                    top = max(first - row * TILE_HEIGHT, 0)
                    bottom = min(last - row * TILE_HEIGHT, TILE_HEIGHT - 1)
                    if top <= bottom:
                        tile = (column - band[0]) * down + row
                        rows = tile << 8 | top << 4 | bottom
                        intersections[end] = np.int64(order[start + j]) << 32 | rows
                        end += 1
                        counts[part, tile] += 1


@compile_kernel
def row_range_in_column(s, column, height):
    """First and last row of pixels whose centres the ellipse covers in a column of tiles.

    In units of its extents the edge is n_v = r n_u +- sqrt((1 - r^2) (1 - n_u^2)): over a range of
    n_u it is highest at n_u = r, or as near to it as the range allows, and lowest at n_u = -r.
    """
    start, end = np.float32(column * TILE_WIDTH + 0.5 - s.u), np.float32(TILE_WIDTH - 1)
    v, bottom = np.float32(s.v - 0.5), np.float32(height - 1)
    if not (start <= s.extent_u and start + end >= -s.extent_u):
        return 0, -1
    low = clamp(start / s.extent_u, -ONE, ONE)
    high = clamp((start + end) / s.extent_u, -ONE, ONE)
    n = clamp(-s.correlation, low, high)
    first = v + s.extent_v * (s.correlation * n - s.complement * math.sqrt(ONE - n * n))
    n = clamp(s.correlation, low, high)
    last = v + s.extent_v * (s.correlation * n + s.complement * math.sqrt(ONE - n * n))
    return int(np.ceil(clamp(first, ZERO, bottom + ONE))), int(np.floor(clamp(last, -ONE, bottom)))


@compile_kernel
def scatter_to_tiles(part, intersections, begins, ends, places, tile_intersections):
    """Counting sort of the intersections by tile; places (parts, tiles): where each part begins."""
    for k in range(begins[part], ends[part]):
        tile = intersections[k] >> 8 & 0xFFFFFF
        tile_intersections[places[part, tile]] = intersections[k]
        places[part, tile] += 1


@compile_kernel
def rasterize_tiles(
    part, splats, tile_offsets, tile_intersections, first_column, background, rgb, alpha, depth
):
    """Composite every WORK_PARTS-th tile, front to back [Kerbl et al. 2023, eq. 3].

    C = sum_i c_i a_i T_i,  a_i = min(0.999, o_i exp(-sigma_i)),  T_i = prod_(j < i) (1 - a_j)

    tile_state holds T, red, green, blue and depth of the tile's pixels; T < 0 marks saturation.
    """
    height, width = alpha.shape
    down = (height - 1) // TILE_HEIGHT + 1
    tile_state, batch = np.empty(5 * TILE_PIXELS, np.float32), np.empty(BATCH, SPLAT)
    for tile in range(part, len(tile_offsets) - 1, WORK_PARTS):
        x0, y0 = (first_column + tile // down) * TILE_WIDTH, tile % down * TILE_HEIGHT
        tile_state[:TILE_PIXELS] = 1.0
        tile_state[TILE_PIXELS:] = 0.0
        for k in range(tile_offsets[tile], tile_offsets[tile + 1], BATCH):
            count = min(BATCH, tile_offsets[tile + 1] - k)
            for j in range(count):
                batch[j] = splats[tile_intersections[k + j] >> 32]
            for j in range(count):
                top, bottom = tile_intersections[k + j] >> 4 & 15, tile_intersections[k + j] & 15
                blend_splat(batch[j], top, bottom, x0, y0, tile_state)
            if is_tile_saturated(tile_state):
                break
        for row in range(min(TILE_HEIGHT, height - y0)):
            for lane in range(min(TILE_WIDTH, width - x0)):
                i, y, x = row * TILE_WIDTH + lane, y0 + row, x0 + lane
                transmittance = abs(tile_state[i])
                for channel in range(3):
                    colour = tile_state[(1 + channel) * TILE_PIXELS + i]
                    rgb[y, x, channel] = colour + transmittance * background[channel]
                alpha[y, x] = weight = np.float32(1.0) - transmittance
                depth[y, x] = tile_state[4 * TILE_PIXELS + i] / weight if weight > 0.0 else 0.0


@compile_kernel
def is_tile_saturated(tile_state):
    """Whether every pixel of the tile is saturated."""
    open_pixels = 0
    for i in range(TILE_PIXELS):
        open_pixels += tile_state[i] > 0.0
    return open_pixels == 0


# exp(-s) = p(s)^8 with a polynomial p of degree 5, equal to exp(-s/8) at six Chebyshev points of
# 0 <= s <= ln 255.
_P = np.polynomial.Chebyshev.interpolate(lambda s: np.exp(-s / 8.0), 5, [0.0, LN_255])
P0, P1, P2, P3, P4, P5 = (np.float32(c) for c in _P.convert(kind=np.polynomial.Polynomial).coef)
SIGMA_MAX32, ALPHA_MAX32 = np.float32(LN_255), np.float32(ALPHA_MAX)
T_MIN32 = np.float32(TRANSMITTANCE_MIN)


@compile_kernel
def blend_splat(splat, first, last, x0, y0, tile_state):
    """Blend one splat into the rows first..last of a tile."""
    conic_slope, conic_u, conic_v = splat.conic_slope, splat.conic_u, splat.conic_v
    neg_log_opacity = splat.neg_log_opacity
    red, green, blue, depth = splat.red, splat.green, splat.blue, splat.depth
    u, dv = np.float32(splat.u - x0 - 0.5), np.float32(y0 + first + 0.5 - splat.v)
    for row in range(first, last + 1):
        # s = sigma - ln(opacity): over a row a parabola with its minimum s_min at du = 0
        middle, s_min = u + conic_slope * dv, neg_log_opacity + conic_v * dv * dv
        dv += ONE
        start = np.uint64(row * TILE_WIDTH)
        for lane in range(TILE_WIDTH):
            i = start + np.uint64(lane)  # unsigned: no test for negative indices
            du = np.float32(lane) - middle
            s = s_min + conic_u * du * du
            p = P0 + s * (P1 + s * (P2 + s * (P3 + s * (P4 + s * P5))))
            p = p * p
            p = p * p
            a = p * p  # alpha = exp(-s)
            a = a if a < ALPHA_MAX32 else ALPHA_MAX32
            a = a if s < SIGMA_MAX32 else ZERO
            before = tile_state[i]
            weight = a * before
            after = before - weight
            is_open = after > T_MIN32
            weight = weight if is_open else ZERO
            tile_state[i] = after if is_open else -abs(before)
            tile_state[i + np.uint64(TILE_PIXELS)] += weight * red
            tile_state[i + np.uint64(2 * TILE_PIXELS)] += weight * green
            tile_state[i + np.uint64(3 * TILE_PIXELS)] += weight * blue
            tile_state[i + np.uint64(4 * TILE_PIXELS)] += weight * depth
