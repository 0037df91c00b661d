"""Fast renderer: GaussianScene + camera pose -> image, opacity and depth, on a CPU, by code that
numba compiles.

It equals `reference` to a hundredth of a grey level and trades readability for speed; it has no
gradients. Steps:

    project   every Gaussian becomes a splat, an ellipse in the image with a colour; those out of view drop out
    sort      the splats, nearest first
    intersect which tiles of the image each ellipse touches, exactly
    scatter   a list for every tile, nearest first
    rasterize every tile on its own, front to back, a row of pixels at a time

A kernel does one part of PARTS of its step, so that several threads share the parts; which thread
does which changes no bit of the image. They are Python's threads, which a kernel leaves free to
run: numba's own take longer to compile, and not all kinds of them allow two callers at once. The
conventions and the constants are those of gsplat 1.5, "classic".
"""

import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from falconwing_kit.core.checks import require_range, require_shape
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene

Image32 = NDArray[np.float32]

NEAR = 0.01  # m; what lies nearer along the camera's axis is not drawn
BLUR = 0.3  # px^2 added to every ellipse, so that none falls between the pixels
# of half the field of view: how far outside of it the projection is still linearised where it is
FRUSTUM_MARGIN = 0.3
ALPHA_MAX, ALPHA_MIN = 0.999, 1.0 / 255.0
ZERO, HALF, ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
LN_255 = math.log(255.0)
TRANSMITTANCE_MIN = 1e-4  # share of light that still passes a pixel when it counts as full

WORK_PARTS = 16  # pieces of every step, shared by the threads
TILE_WIDTH, TILE_HEIGHT = (
    16,
    16,
)  # a tile's width and height [px], at most 16; its width is two AVX2 registers
TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT
BATCH = 32  # splats that are fetched together, so that one waits for memory while others come
MAX_INTERSECTIONS = (
    1 << 24
)  # splats times tiles at once, 8 bytes each; beyond this the image is made in bands

# A splat: its centre u, v [px] and the half width and height of its ellipse; the correlation r of u
# and v and its complement sqrt(1 - r^2); the conic with its square completed, sigma = conic_v dv^2
# + conic_u (du - conic_slope dv)^2;
# -ln(opacity); colour; the depth of its centre [m].
_FIELDS = "extent_u extent_v correlation complement conic_slope conic_u conic_v neg_log_opacity red green blue depth"
SPLAT = np.dtype(
    [("u", np.float64), ("v", np.float64), *((name, np.float32) for name in _FIELDS.split())]
)


def compile_kernel(function: Callable[..., Any]) -> Any:
    """The function as machine code that lets other threads run; kept on disk where some folder can
    be written.
    """
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
) -> tuple[Image32, Image32, Image32]:
    """Image, opacity and depth of a scene, as `reference` gives them.

    Args:
        scene: the Gaussians; or several scenes in the same coordinates, drawn as if joined: a hall
            that rests and an aircraft that moves, without the cost of a new joined scene for every
            image.
        camera: pinhole.
        T_world_camera: (4, 4), "world from camera".
        background: (3,) red, green, blue 0..1 behind everything.
        antialiased: lower the opacity of splats smaller than a pixel by what BLUR adds to their
            area.
        threads: how many share the work; None: as many as the machine has cores. The image is the
            same to the last bit.

    Returns:
        rgb (H, W, 3); alpha (H, W), 0 where only background is seen; depth (H, W) [m], the mean of
        the splats' depths along the camera's axis with their shares in the pixel as weights, 0
        where alpha is 0. All float32.

    Raises:
        InputError: a shape is wrong, or the number of threads is none.
    """
    pose = require_shape("T_world_camera", T_world_camera, (4, 4))
    behind = require_shape("background", background, (3,)).astype(np.float32)
    scenes = (scene,) if isinstance(scene, GaussianScene) else tuple(scene)
    workers = int(
        require_range(
            "threads", (os.cpu_count() or 1) if threads is None else threads, low=1, high=1024
        )
    )
    with ThreadPoolExecutor(min(workers, WORK_PARTS)) as pool:

        def run(kernel: Any, *arguments: Any) -> None:
            share = map if workers == 1 else pool.map
            list(share(lambda part: kernel(part, *arguments), range(WORK_PARTS)))

        splats, order, tiles_per_gaussian = _splats_in_view(run, scenes, camera, pose, antialiased)
        rgb = np.empty((camera.height, camera.width, 3), np.float32)
        alpha, depth = np.empty(rgb.shape[:2], np.float32), np.empty(rgb.shape[:2], np.float32)
        for band, begins in _bands(tiles_per_gaussian, camera.width, camera.height):
            tile_offsets, tile_intersections = _lists_of_tiles(
                run, splats, order, begins, band, camera.height
            )
            run(
                rasterize_tiles,
                splats,
                tile_offsets,
                tile_intersections,
                band[0],
                behind,
                rgb,
                alpha,
                depth,
            )
    return rgb, alpha, depth


def _splats_in_view(
    run: Any, scenes: Sequence[GaussianScene], camera: PinholeCamera, pose: Any, antialiased: bool
) -> Any:
    """Splats (N,); indices of the M in view, nearest first; in this order, how many tiles the box
    of each spans.
    """
    R_world_camera, p_world = np.ascontiguousarray(pose[:3, :3]), np.ascontiguousarray(pose[:3, 3])
    count = sum(len(scene) for scene in scenes)
    splats, tiles_per_gaussian, depths = (
        np.empty(count, SPLAT),
        np.empty(count, np.int32),
        np.full(count, np.inf, np.float32),
    )
    lens = (
        float(camera.fx),
        float(camera.fy),
        float(camera.cx),
        float(camera.cy),
        camera.width,
        camera.height,
    )
    first = 0
    for scene in scenes:
        arrays = (scene.means, scene.quaternions, scene.scales, scene.opacities, scene.sh)
        own = slice(first, first + len(scene))
        run(
            project_kernel,
            *arrays,
            R_world_camera,
            p_world,
            lens,
            bool(antialiased),
            splats[own],
            tiles_per_gaussian[own],
            depths[own],
        )
        first = own.stop
    in_view = np.flatnonzero(depths < np.inf).astype(np.uint32)
    order = sort_by_depth(in_view, depths.view(np.uint32))
    return splats, order, tiles_per_gaussian[order]


def _bands(
    tiles_per_gaussian: Any, width: int, height: int
) -> Iterator[tuple[tuple[int, int], NDArray[np.int64]]]:
    """First and last column of tiles to make at once; where each part's touches begin, and where
    the last ends.
    """
    across, down = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
    step = across
    while (
        step > 1
        and np.minimum(tiles_per_gaussian, step * down).sum(dtype=np.int64) > MAX_INTERSECTIONS
    ):
        step = -(-step // 2)
    room = np.concatenate(
        [[0], np.cumsum(np.minimum(tiles_per_gaussian, step * down), dtype=np.int64)]
    )
    for first in range(0, across, step):
        yield (
            (first, min(first + step, across) - 1),
            room[len(tiles_per_gaussian) * np.arange(WORK_PARTS + 1) // WORK_PARTS],
        )


def _lists_of_tiles(
    run: Any, splats: Any, order: Any, begins: Any, band: tuple[int, int], height: int
) -> Any:
    """Where each tile's list starts (tiles + 1,), and all lists one after the other."""
    tiles = (band[1] - band[0] + 1) * -(-height // TILE_HEIGHT)
    intersections, counts = np.empty(begins[-1], np.int64), np.zeros((WORK_PARTS, tiles), np.int64)
    run(intersect_tiles, splats, order, begins, band, height, intersections, counts)
    ends = (
        np.cumsum(counts.T).reshape(tiles, WORK_PARTS).T
    )  # one tile after the other, in each one part after the other
    tile_intersections = np.empty(ends[-1, -1], np.int64)
    run(
        scatter_to_tiles,
        intersections,
        begins,
        begins[:-1] + counts.sum(axis=1),
        np.ascontiguousarray(ends - counts),
        tile_intersections,
    )
    return np.concatenate([[0], ends[-1]]), tile_intersections


@compile_kernel
def project_kernel(
    part,
    means,
    quaternions,
    scales,
    opacities,
    sh,
    R_world_camera,
    p_world,
    lens,
    antialiased,
    splats,
    tiles_per_gaussian,
    depths,
):
    """Gaussians -> splats, the tiles that their boxes span, and the depths of those in view.

    cov = J A (J A)^T + BLUR I,  A = R_camera_world R_world_cloud diag(scales)   [Zwicker et al. 2001, EWA splatting]
    J = [[fx/z, 0, -fx x/z^2], [0, fy/z, -fy y/z^2]], x and y held within the field of view and EDGE
    of it The ellipse ends where opacity exp(-sigma) = ALPHA_MIN, sigma = 1/2 d^T cov^-1 d.
    """
    fx, fy, cx, cy, width, height = lens
    x_min, x_max = (
        (0.0 - cx - FRUSTUM_MARGIN * 0.5 * width) / fx,
        (width - cx + FRUSTUM_MARGIN * 0.5 * width) / fx,
    )
    y_min, y_max = (
        (0.0 - cy - FRUSTUM_MARGIN * 0.5 * height) / fy,
        (height - cy + FRUSTUM_MARGIN * 0.5 * height) / fy,
    )
    Y, A = np.empty(16, np.float32), np.empty((3, 3))
    for i in range(len(means) * part // WORK_PARTS, len(means) * (part + 1) // WORK_PARTS):
        toward = means[i, 0] - p_world[0], means[i, 1] - p_world[1], means[i, 2] - p_world[2]
        x, y, z = rotate_to_camera(toward, R_world_camera)
        if not z >= NEAR:
            continue
        per_z = 1.0 / z
        x, y = x * per_z, y * per_z
        principal_axes(i, quaternions, scales, R_world_camera, A)
        x_clamped, y_clamped = clamp(x, x_min, x_max), clamp(y, y_min, y_max)
        for k in range(3):  # from here on A's first two rows are those of J A
            A[0, k] = fx * per_z * (A[0, k] - x_clamped * A[2, k])
            A[1, k] = fy * per_z * (A[1, k] - y_clamped * A[2, k])
        uu, uv, vv, area = gram_and_determinant(A)
        det = area + BLUR * (uu + vv) + BLUR * BLUR
        uu, vv = uu + BLUR, vv + BLUR
        opacity = opacities[i] * (math.sqrt(area / det) if antialiased else 1.0)
        if not opacity >= ALPHA_MIN:
            continue
        s, neg_log_opacity, sd_u, sd_v = (
            splats[i],
            -math.log(np.float32(opacity)),
            math.sqrt(uu),
            math.sqrt(vv),
        )
        extent = math.sqrt(2.0 * max(LN_255 - neg_log_opacity, 0.0))
        s.u, s.v, s.extent_u, s.extent_v = fx * x + cx, fy * y + cy, extent * sd_u, extent * sd_v
        if not (s.u + s.extent_u >= 0.0 and s.u - s.extent_u <= width):
            continue
        if not (s.v + s.extent_v >= 0.0 and s.v - s.extent_v <= height):
            continue
        left, right = tile_range(s.u, s.extent_u, TILE_WIDTH, 0, (width - 1) // TILE_WIDTH)
        top, bottom = tile_range(s.v, s.extent_v, TILE_HEIGHT, 0, (height - 1) // TILE_HEIGHT)
        tiles_per_gaussian[i], depths[i] = (right - left + 1) * (bottom - top + 1), z
        per_vv, per_sds = 1.0 / vv, 1.0 / (sd_u * sd_v)
        s.correlation, s.complement = uv * per_sds, math.sqrt(det) * per_sds
        s.conic_slope, s.conic_u, s.conic_v = uv * per_vv, 0.5 * vv / det, 0.5 * per_vv
        s.neg_log_opacity, s.depth = neg_log_opacity, z
        s.red, s.green, s.blue = evaluate_colour(i, sh, toward, Y)


@compile_kernel
def rotate_to_camera(v_world, R):
    """A vector of the world in the camera's axes, R = R_world_camera, whose transpose is its
    inverse.
    """
    x, y, z = v_world
    return (
        R[0, 0] * x + R[1, 0] * y + R[2, 0] * z,
        R[0, 1] * x + R[1, 1] * y + R[2, 1] * z,
        R[0, 2] * x + R[1, 2] * y + R[2, 2] * z,
    )


@compile_kernel
def principal_axes(i, quaternions, scales, R_world_camera, A):
    """A (3, 3): the cloud's axes as columns, in the camera's axes, each as long as its standard
    deviation [m].
    """
    w, x, y, z = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
    axes = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        (2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    for k in range(3):
        a, b, c = rotate_to_camera(axes[k], R_world_camera)
        A[0, k], A[1, k], A[2, k] = scales[i, k] * a, scales[i, k] * b, scales[i, k] * c


@compile_kernel
def gram_and_determinant(M):
    """Of the first two rows u, v of a matrix: u.u, u.v, v.v and |u x v|^2 = det(M M^T), which
    rounding leaves >= 0.
    """
    a, b, c, d, e, f = M[0, 0], M[0, 1], M[0, 2], M[1, 0], M[1, 1], M[1, 2]
    x, y, z = b * f - c * e, c * d - a * f, a * e - b * d
    return (
        a * a + b * b + c * c,
        a * d + b * e + c * f,
        d * d + e * e + f * f,
        x * x + y * y + z * z,
    )


@compile_kernel
def evaluate_colour(i, sh, toward, Y):
    """Red, green, blue >= 0 of a Gaussian that lies toward a vector: 1/2 + sum_k sh_k
    Y_k(direction).
    """
    x, y, z = toward
    per_distance = 1.0 / math.sqrt(x * x + y * y + z * z)
    x, y, z = (
        np.float32(x * per_distance),
        np.float32(y * per_distance),
        np.float32(z * per_distance),
    )
    fill_spherical_harmonics(sh.shape[1], x, y, z, Y)
    red, green, blue = HALF, HALF, HALF
    for k in range(sh.shape[1]):
        red += sh[i, k, 0] * Y[k]
        green += sh[i, k, 1] * Y[k]
        blue += sh[i, k, 2] * Y[k]
    return max(red, ZERO), max(green, ZERO), max(blue, ZERO)


# The constants of the harmonics from degree 0 on, as they come in the formulas.
C = tuple(
    np.float32(math.sqrt(c / math.pi))
    for c in (1 / 4, 3 / 4, 15 / 4, 5 / 16, 15 / 16, 35 / 32, 105 / 4, 21 / 32, 7 / 16, 105 / 16)
)


@compile_kernel
def fill_spherical_harmonics(count, x, y, z, Y):
    """The first `count` real spherical harmonics in a direction of length 1 [Kerbl et al. 2023,
    their signs].
    """
    xx, yy, zz = x * x, y * y, z * z
    Y[0] = C[0]
    if count > 1:
        Y[1], Y[2], Y[3] = -C[1] * y, C[1] * z, -C[1] * x
    if count > 4:
        Y[4], Y[5], Y[7] = C[2] * x * y, -C[2] * y * z, -C[2] * x * z
        Y[6], Y[8] = C[3] * (zz + zz - xx - yy), C[4] * (xx - yy)
    if count > 9:
        Y[9], Y[15] = -C[5] * y * (xx + xx + xx - yy), -C[5] * x * (xx - yy - yy - yy)
        Y[10], Y[14] = C[6] * x * y * z, C[9] * z * (xx - yy)
        five = zz + zz + zz + zz - xx - yy
        Y[11], Y[13] = -C[7] * y * five, -C[7] * x * five
        Y[12] = C[8] * z * (five - (zz + zz) - (xx + xx) - (yy + yy))


@compile_kernel
def clamp(value, low, high):
    """The value within bounds; what is not a number becomes the lower one."""
    value = value if value > low else low
    return value if value < high else high


@compile_kernel
def tile_range(center, extent, side, first, last):
    """First and last tile along an axis of the image that center +- reach touches, of those from
    first to last.
    """
    low, high = (
        (center - extent) * np.float32(1.0 / side),
        (center + extent) * np.float32(1.0 / side),
    )
    return int(clamp(low, first, last)), int(clamp(high, first, last))


@compile_kernel
def sort_by_depth(indices, keys):
    """The indices in the order of their keys (N,), the bits of positive floats, which sort as the
    floats do.

    A radix sort: three times a counting sort by 11 bits. Each is stable, so that equal keys keep
        their order. The array
    of indices is used as room to work in.
    """
    spare = np.empty_like(indices)
    for shift in (0, 11, 22):
        places = np.zeros(2049, np.int64)
        for i in indices:
            places[(keys[i] >> shift & 0x7FF) + 1] += 1
        for digit in range(2048):
            places[digit + 1] += places[digit]
        ordered = spare
        for i in indices:
            digit = keys[i] >> shift & 0x7FF
            ordered[places[digit]] = i
            places[digit] += 1
        indices, spare = ordered, indices
    return indices


@compile_kernel
def intersect_tiles(part, splats, order, begins, band, height, intersections, counts):
    """The tiles that each ellipse touches and with which of their rows, packed, and how many
    ellipses touch a tile.
    """
    down, end, stop = (
        (height - 1) // TILE_HEIGHT + 1,
        begins[part],
        len(order) * (part + 1) // WORK_PARTS,
    )
    batch = np.empty(BATCH, SPLAT)
    for start in range(len(order) * part // WORK_PARTS, stop, BATCH):
        count = min(BATCH, stop - start)
        for j in range(count):
            batch[j] = splats[order[start + j]]
        for j in range(count):
            s = batch[j]
            left, right = tile_range(s.u, s.extent_u, TILE_WIDTH, band[0], band[1])
            top_row, bottom_row = tile_range(
                s.v, s.extent_v, TILE_HEIGHT, 0, down - 1
            )  # begins were counted from this box
            for column in range(left, right + 1):
                first, last = row_range_in_column(s, column, height)
                for row in range(
                    max(first // TILE_HEIGHT, top_row), min(last // TILE_HEIGHT, bottom_row) + 1
                ):
                    top, bottom = (
                        max(first - row * TILE_HEIGHT, 0),
                        min(last - row * TILE_HEIGHT, TILE_HEIGHT - 1),
                    )
                    if top <= bottom:
                        tile = (column - band[0]) * down + row
                        intersections[end] = (
                            np.int64(order[start + j]) << 32 | tile << 8 | top << 4 | bottom
                        )
                        end += 1
                        counts[part, tile] += 1


@compile_kernel
def row_range_in_column(s, column, height):
    """First and last row of pixels whose centres the ellipse covers somewhere in a column of tiles.

    In units of its reach its edge is n_v = r n_u +- sqrt((1 - r^2) (1 - n_u^2)): over a range of
    n_u the upper end is at n_u = r or as near to it as the range allows, the lower end at n_u = -r.
    """
    start, v, bottom = (
        np.float32(column * TILE_WIDTH + 0.5 - s.u),
        np.float32(s.v - 0.5),
        np.float32(height - 1),
    )
    if not (start <= s.extent_u and start + np.float32(TILE_WIDTH - 1) >= -s.extent_u):
        return 0, -1
    low, high = (
        clamp(start / s.extent_u, -ONE, ONE),
        clamp((start + np.float32(TILE_WIDTH - 1)) / s.extent_u, -ONE, ONE),
    )
    n = clamp(-s.correlation, low, high)
    first = v + s.extent_v * (s.correlation * n - s.complement * math.sqrt(ONE - n * n))
    n = clamp(s.correlation, low, high)
    last = v + s.extent_v * (s.correlation * n + s.complement * math.sqrt(ONE - n * n))
    return int(np.ceil(clamp(first, ZERO, bottom + ONE))), int(np.floor(clamp(last, -ONE, bottom)))


@compile_kernel
def scatter_to_tiles(part, intersections, begins, ends, places, tile_intersections):
    """Counting sort: what was found into the lists of the tiles; places (PARTS, tiles) say where
    each part begins.
    """
    for k in range(begins[part], ends[part]):
        tile = intersections[k] >> 8 & 0xFFFFFF
        tile_intersections[places[part, tile]] = intersections[k]
        places[part, tile] += 1


@compile_kernel
def rasterize_tiles(
    part, splats, tile_offsets, tile_intersections, first_column, background, rgb, alpha, depth
):
    """Composite every PARTS-th tile, front to back [Kerbl et al. 2023, eq. 3].

    C = sum_i c_i a_i T_i,  a_i = min(0.999, o_i exp(-sigma_i)),  T_i = prod_(j < i) (1 - a_j)

    The buffer holds T, red, green, blue and depth of the tile's pixels; T < 0 marks a full one.
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
                blend_splat(
                    batch[j],
                    tile_intersections[k + j] >> 4 & 15,
                    tile_intersections[k + j] & 15,
                    x0,
                    y0,
                    tile_state,
                )
            if is_tile_saturated(tile_state):
                break
        for row in range(min(TILE_HEIGHT, height - y0)):
            for lane in range(min(TILE_WIDTH, width - x0)):
                i, y, x = row * TILE_WIDTH + lane, y0 + row, x0 + lane
                transmittance = abs(tile_state[i])
                for channel in range(3):
                    rgb[y, x, channel] = (
                        tile_state[(1 + channel) * TILE_PIXELS + i]
                        + transmittance * background[channel]
                    )
                alpha[y, x] = opacity_sum = np.float32(1.0) - transmittance
                depth[y, x] = (
                    tile_state[4 * TILE_PIXELS + i] / opacity_sum if opacity_sum > 0.0 else 0.0
                )


@compile_kernel
def is_tile_saturated(tile_state):
    """Whether no pixel of the tile takes further splats."""
    open_pixels = 0
    for i in range(TILE_PIXELS):
        open_pixels += tile_state[i] > 0.0
    return open_pixels == 0


# exp(-s) = p(s)^8, p of degree 5 through exp(-s/8) at six Chebyshev points of 0 <= s <= ln 255.
_P = np.polynomial.Chebyshev.interpolate(lambda s: np.exp(-s / 8.0), 5, [0.0, LN_255])
P0, P1, P2, P3, P4, P5 = (np.float32(c) for c in _P.convert(kind=np.polynomial.Polynomial).coef)
SIGMA_MAX32, ALPHA_MAX32, T_MIN32 = (
    np.float32(LN_255),
    np.float32(ALPHA_MAX),
    np.float32(TRANSMITTANCE_MIN),
)


@compile_kernel
def blend_splat(splat, first, last, x0, y0, tile_state):
    """Blend one splat into the rows first..last of a tile."""
    conic_slope, conic_u, conic_v, neg_log_opacity = (
        splat.conic_slope,
        splat.conic_u,
        splat.conic_v,
        splat.neg_log_opacity,
    )
    red, green, blue, depth = splat.red, splat.green, splat.blue, splat.depth
    u, dv = np.float32(splat.u - x0 - 0.5), np.float32(y0 + first + 0.5 - splat.v)
    for row in range(first, last + 1):
        middle, least = u + conic_slope * dv, neg_log_opacity + conic_v * dv * dv
        dv += ONE
        start = np.uint64(row * TILE_WIDTH)
        for lane in range(TILE_WIDTH):
            i = start + np.uint64(lane)  # unsigned: no look whether it counts from the end
            du = np.float32(lane) - middle
            s = least + conic_u * du * du
            p = P0 + s * (P1 + s * (P2 + s * (P3 + s * (P4 + s * P5))))
            p = p * p
            p = p * p
            a = p * p
            a = a if a < ALPHA_MAX32 else ALPHA_MAX32
            a = a if s < SIGMA_MAX32 else ZERO
            before = tile_state[i]
            share = a * before
            after = before - share
            room = after > T_MIN32
            share = share if room else ZERO
            tile_state[i] = after if room else -abs(before)
            tile_state[i + np.uint64(TILE_PIXELS)] += share * red
            tile_state[i + np.uint64(2 * TILE_PIXELS)] += share * green
            tile_state[i + np.uint64(3 * TILE_PIXELS)] += share * blue
            tile_state[i + np.uint64(4 * TILE_PIXELS)] += share * depth
