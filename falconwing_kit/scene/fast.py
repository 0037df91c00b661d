"""Fast renderer: GaussianScene + camera pose -> image, opacity and depth, on a CPU, by code that numba compiles.

It equals `reference` to a hundredth of a grey level and trades readability for speed; it has no gradients. Steps:

    project   every Gaussian becomes a splat, an ellipse in the image with a colour; those out of view drop out
    sort      the splats, nearest first
    touch     which tiles of the image each ellipse touches, exactly
    fill      a list for every tile, nearest first
    blend     every tile on its own, front to back, a row of pixels at a time

A kernel does one part of PARTS of its step, so that several threads share the parts; which thread does which changes no
bit of the image. They are Python's threads, which a kernel leaves free to run: numba's own take longer to compile, and
not all kinds of them allow two callers at once. The conventions and the constants are those of gsplat 1.5, "classic".
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
EDGE = 0.3  # of half the field of view: how far outside of it the projection is still linearised where it is
ALPHA_MAX, ALPHA_MIN = 0.999, 1.0 / 255.0
ZERO, HALF, ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
LN_255 = math.log(255.0)
T_MIN = 1e-4  # share of light that still passes a pixel when it counts as full

PARTS = 16  # pieces of every step, shared by the threads
LANES, ROWS = 16, 16  # a tile's width and height [px], at most 16; its width is two AVX2 registers
PIXELS = LANES * ROWS
BATCH = 32  # splats that are fetched together, so that one waits for memory while others come
MOST_TOUCHES = 1 << 24  # splats times tiles at once, 8 bytes each; beyond this the image is made in bands

# A splat: its centre u, v [px] and the half width and height of its ellipse; the correlation r of u and v (skew) and
# sqrt(1 - r^2) (slim); sigma = drop dv^2 + sharp (du - lean dv)^2; fade = -ln(opacity); colour; its centre's depth [m].
_FIELDS = "reach_u reach_v skew slim lean sharp drop fade red green blue depth"
SPLAT = np.dtype([("u", np.float64), ("v", np.float64), *((name, np.float32) for name in _FIELDS.split())])


def compiled(function: Callable[..., Any]) -> Any:
    """The function as machine code that lets other threads run; kept on disk where some folder can be written."""
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}
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
        scene: the Gaussians; or several scenes in the same coordinates, drawn as if joined: a hall that rests and an
            aircraft that moves, without the cost of a new joined scene for every image.
        camera: pinhole.
        T_world_camera: (4, 4), "world from camera".
        background: (3,) red, green, blue 0..1 behind everything.
        antialiased: lower the opacity of splats smaller than a pixel by what BLUR adds to their area.
        threads: how many share the work; None: as many as the machine has cores. The image is the same to the last bit.

    Returns:
        rgb (H, W, 3); alpha (H, W), 0 where only background is seen; depth (H, W) [m], the mean of the splats' depths
        along the camera's axis with their shares in the pixel as weights, 0 where alpha is 0. All float32.

    Raises:
        InputError: a shape is wrong, or the number of threads is none.
    """
    pose = require_shape("T_world_camera", T_world_camera, (4, 4))
    behind = require_shape("background", background, (3,)).astype(np.float32)
    scenes = (scene,) if isinstance(scene, GaussianScene) else tuple(scene)
    workers = int(require_range("threads", (os.cpu_count() or 1) if threads is None else threads, low=1, high=1024))
    with ThreadPoolExecutor(min(workers, PARTS)) as pool:

        def run(kernel: Any, *arguments: Any) -> None:
            share = map if workers == 1 else pool.map
            list(share(lambda part: kernel(part, *arguments), range(PARTS)))

        splats, order, boxes = _splats_in_view(run, scenes, camera, pose, antialiased)
        rgb = np.empty((camera.height, camera.width, 3), np.float32)
        alpha, depth = np.empty(rgb.shape[:2], np.float32), np.empty(rgb.shape[:2], np.float32)
        for band, begins in _bands(boxes, camera.width, camera.height):
            starts, hits = _lists_of_tiles(run, splats, order, begins, band, camera.height)
            run(blend, splats, starts, hits, band[0], behind, rgb, alpha, depth)
    return rgb, alpha, depth


def _splats_in_view(
    run: Any, scenes: Sequence[GaussianScene], camera: PinholeCamera, pose: Any, antialiased: bool
) -> Any:
    """Splats (N,); indices of the M in view, nearest first; in this order, how many tiles the box of each spans."""
    R_world_camera, p_world = np.ascontiguousarray(pose[:3, :3]), np.ascontiguousarray(pose[:3, 3])
    count = sum(len(scene) for scene in scenes)
    splats, boxes, depths = np.empty(count, SPLAT), np.empty(count, np.int32), np.full(count, np.inf, np.float32)
    lens = float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy), camera.width, camera.height
    first = 0
    for scene in scenes:
        arrays = (scene.means, scene.quaternions, scene.scales, scene.opacities, scene.sh)
        own = slice(first, first + len(scene))
        run(project, *arrays, R_world_camera, p_world, lens, bool(antialiased), splats[own], boxes[own], depths[own])
        first = own.stop
    in_view = np.flatnonzero(depths < np.inf).astype(np.uint32)
    order = nearest_first(in_view, depths.view(np.uint32))
    return splats, order, boxes[order]


def _bands(boxes: Any, width: int, height: int) -> Iterator[tuple[tuple[int, int], NDArray[np.int64]]]:
    """First and last column of tiles to make at once; where each part's touches begin, and where the last ends."""
    across, down = -(-width // LANES), -(-height // ROWS)
    step = across
    while step > 1 and np.minimum(boxes, step * down).sum(dtype=np.int64) > MOST_TOUCHES:
        step = -(-step // 2)
    room = np.concatenate([[0], np.cumsum(np.minimum(boxes, step * down), dtype=np.int64)])
    for first in range(0, across, step):
        yield (first, min(first + step, across) - 1), room[len(boxes) * np.arange(PARTS + 1) // PARTS]


def _lists_of_tiles(run: Any, splats: Any, order: Any, begins: Any, band: tuple[int, int], height: int) -> Any:
    """Where each tile's list starts (tiles + 1,), and all lists one after the other."""
    tiles = (band[1] - band[0] + 1) * -(-height // ROWS)
    found, counts = np.empty(begins[-1], np.int64), np.zeros((PARTS, tiles), np.int64)
    run(touch, splats, order, begins, band, height, found, counts)
    ends = np.cumsum(counts.T).reshape(tiles, PARTS).T  # one tile after the other, in each one part after the other
    hits = np.empty(ends[-1, -1], np.int64)
    run(fill, found, begins, begins[:-1] + counts.sum(axis=1), np.ascontiguousarray(ends - counts), hits)
    return np.concatenate([[0], ends[-1]]), hits


@compiled
def project(  # type: ignore[no-untyped-def]
    part, means, quaternions, scales, opacities, sh, R_world_camera, p_world, lens, antialiased, splats, boxes, depths
):
    """Gaussians -> splats, the tiles that their boxes span, and the depths of those in view.

    cov = J A (J A)^T + BLUR I,  A = R_camera_world R_world_cloud diag(scales)   [Zwicker et al. 2001, EWA splatting]
    J = [[fx/z, 0, -fx x/z^2], [0, fy/z, -fy y/z^2]], x and y held within the field of view and EDGE of it
    The ellipse ends where opacity exp(-sigma) = ALPHA_MIN, sigma = 1/2 d^T cov^-1 d.
    """
    fx, fy, cx, cy, width, height = lens
    x_min, x_max = (0.0 - cx - EDGE * 0.5 * width) / fx, (width - cx + EDGE * 0.5 * width) / fx
    y_min, y_max = (0.0 - cy - EDGE * 0.5 * height) / fy, (height - cy + EDGE * 0.5 * height) / fy
    Y, A = np.empty(16, np.float32), np.empty((3, 3))
    for i in range(len(means) * part // PARTS, len(means) * (part + 1) // PARTS):
        toward = means[i, 0] - p_world[0], means[i, 1] - p_world[1], means[i, 2] - p_world[2]
        x, y, z = turned(toward, R_world_camera)
        if not z >= NEAR:
            continue
        per_z = 1.0 / z
        x, y = x * per_z, y * per_z
        cloud_axes(i, quaternions, scales, R_world_camera, A)
        x_held, y_held = held(x, x_min, x_max), held(y, y_min, y_max)
        for k in range(3):  # from here on A's first two rows are those of J A
            A[0, k] = fx * per_z * (A[0, k] - x_held * A[2, k])
            A[1, k] = fy * per_z * (A[1, k] - y_held * A[2, k])
        uu, uv, vv, area = products(A)
        det = area + BLUR * (uu + vv) + BLUR * BLUR
        uu, vv = uu + BLUR, vv + BLUR
        opacity = opacities[i] * (math.sqrt(area / det) if antialiased else 1.0)
        if not opacity >= ALPHA_MIN:
            continue
        s, fade, sd_u, sd_v = splats[i], -math.log(np.float32(opacity)), math.sqrt(uu), math.sqrt(vv)
        reach = math.sqrt(2.0 * max(LN_255 - fade, 0.0))
        s.u, s.v, s.reach_u, s.reach_v = fx * x + cx, fy * y + cy, reach * sd_u, reach * sd_v
        if not (s.u + s.reach_u >= 0.0 and s.u - s.reach_u <= width):
            continue
        if not (s.v + s.reach_v >= 0.0 and s.v - s.reach_v <= height):
            continue
        left, right = span(s.u, s.reach_u, LANES, 0, (width - 1) // LANES)
        top, bottom = span(s.v, s.reach_v, ROWS, 0, (height - 1) // ROWS)
        boxes[i], depths[i] = (right - left + 1) * (bottom - top + 1), z
        per_vv, per_sds = 1.0 / vv, 1.0 / (sd_u * sd_v)
        s.skew, s.slim = uv * per_sds, math.sqrt(det) * per_sds
        s.lean, s.sharp, s.drop = uv * per_vv, 0.5 * vv / det, 0.5 * per_vv
        s.fade, s.depth = fade, z
        s.red, s.green, s.blue = colour(i, sh, toward, Y)


@compiled
def turned(v_world, R):  # type: ignore[no-untyped-def]
    """A vector of the world in the camera's axes, R = R_world_camera, whose transpose is its inverse."""
    x, y, z = v_world
    return (
        R[0, 0] * x + R[1, 0] * y + R[2, 0] * z,
        R[0, 1] * x + R[1, 1] * y + R[2, 1] * z,
        R[0, 2] * x + R[1, 2] * y + R[2, 2] * z,
    )


@compiled
def cloud_axes(i, quaternions, scales, R_world_camera, A):  # type: ignore[no-untyped-def]
    """A (3, 3): the cloud's axes as columns, in the camera's axes, each as long as its standard deviation [m]."""
    w, x, y, z = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
    axes = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        (2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    for k in range(3):
        a, b, c = turned(axes[k], R_world_camera)
        A[0, k], A[1, k], A[2, k] = scales[i, k] * a, scales[i, k] * b, scales[i, k] * c


@compiled
def products(M):  # type: ignore[no-untyped-def]
    """Of the first two rows u, v of a matrix: u.u, u.v, v.v and |u x v|^2 = det(M M^T), which rounding leaves >= 0."""
    a, b, c, d, e, f = M[0, 0], M[0, 1], M[0, 2], M[1, 0], M[1, 1], M[1, 2]
    x, y, z = b * f - c * e, c * d - a * f, a * e - b * d
    return a * a + b * b + c * c, a * d + b * e + c * f, d * d + e * e + f * f, x * x + y * y + z * z


@compiled
def colour(i, sh, toward, Y):  # type: ignore[no-untyped-def]
    """Red, green, blue >= 0 of a Gaussian that lies toward a vector: 1/2 + sum_k sh_k Y_k(direction)."""
    x, y, z = toward
    per_distance = 1.0 / math.sqrt(x * x + y * y + z * z)
    x, y, z = np.float32(x * per_distance), np.float32(y * per_distance), np.float32(z * per_distance)
    harmonics(sh.shape[1], x, y, z, Y)
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


@compiled
def harmonics(count, x, y, z, Y):  # type: ignore[no-untyped-def]
    """The first `count` real spherical harmonics in a direction of length 1 [Kerbl et al. 2023, their signs]."""
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


@compiled
def held(value, low, high):  # type: ignore[no-untyped-def]
    """The value within bounds; what is not a number becomes the lower one."""
    value = value if value > low else low
    return value if value < high else high


@compiled
def span(center, reach, side, first, last):  # type: ignore[no-untyped-def]
    """First and last tile along an axis of the image that center +- reach touches, of those from first to last."""
    low, high = (center - reach) * np.float32(1.0 / side), (center + reach) * np.float32(1.0 / side)
    return int(held(low, first, last)), int(held(high, first, last))


@compiled
def nearest_first(indices, keys):  # type: ignore[no-untyped-def]
    """The indices in the order of their keys (N,), the bits of positive floats, which sort as the floats do.

    A radix sort: three times a counting sort by 11 bits. Each is stable, so that equal keys keep their order. The array
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


@compiled
def touch(part, splats, order, begins, band, height, found, counts):  # type: ignore[no-untyped-def]
    """The tiles that each ellipse touches and with which of their rows, packed, and how many ellipses touch a tile."""
    down, end, stop = (height - 1) // ROWS + 1, begins[part], len(order) * (part + 1) // PARTS
    batch = np.empty(BATCH, SPLAT)
    for start in range(len(order) * part // PARTS, stop, BATCH):
        count = min(BATCH, stop - start)
        for j in range(count):
            batch[j] = splats[order[start + j]]
        for j in range(count):
            s = batch[j]
            left, right = span(s.u, s.reach_u, LANES, band[0], band[1])
            top_row, bottom_row = span(s.v, s.reach_v, ROWS, 0, down - 1)  # begins were counted from this box
            for column in range(left, right + 1):
                first, last = rows_in_column(s, column, height)
                for row in range(max(first // ROWS, top_row), min(last // ROWS, bottom_row) + 1):
                    top, bottom = max(first - row * ROWS, 0), min(last - row * ROWS, ROWS - 1)
                    if top <= bottom:
                        tile = (column - band[0]) * down + row
                        found[end] = np.int64(order[start + j]) << 32 | tile << 8 | top << 4 | bottom
                        end += 1
                        counts[part, tile] += 1


@compiled
def rows_in_column(s, column, height):  # type: ignore[no-untyped-def]
    """First and last row of pixels whose centres the ellipse covers somewhere in a column of tiles.

    In units of its reach its edge is n_v = r n_u +- sqrt((1 - r^2) (1 - n_u^2)): over a range of n_u the upper end is
    at n_u = r or as near to it as the range allows, the lower end at n_u = -r.
    """
    start, v, bottom = np.float32(column * LANES + 0.5 - s.u), np.float32(s.v - 0.5), np.float32(height - 1)
    if not (start <= s.reach_u and start + np.float32(LANES - 1) >= -s.reach_u):
        return 0, -1
    low, high = held(start / s.reach_u, -ONE, ONE), held((start + np.float32(LANES - 1)) / s.reach_u, -ONE, ONE)
    n = held(-s.skew, low, high)
    first = v + s.reach_v * (s.skew * n - s.slim * math.sqrt(ONE - n * n))
    n = held(s.skew, low, high)
    last = v + s.reach_v * (s.skew * n + s.slim * math.sqrt(ONE - n * n))
    return int(np.ceil(held(first, ZERO, bottom + ONE))), int(np.floor(held(last, -ONE, bottom)))


@compiled
def fill(part, found, begins, ends, places, hits):  # type: ignore[no-untyped-def]
    """Counting sort: what was found into the lists of the tiles; places (PARTS, tiles) say where each part begins."""
    for k in range(begins[part], ends[part]):
        tile = found[k] >> 8 & 0xFFFFFF
        hits[places[part, tile]] = found[k]
        places[part, tile] += 1


@compiled
def blend(part, splats, starts, hits, first_column, background, rgb, alpha, depth):  # type: ignore[no-untyped-def]
    """Composite every PARTS-th tile, front to back [Kerbl et al. 2023, eq. 3].

    C = sum_i c_i a_i T_i,  a_i = min(0.999, o_i exp(-sigma_i)),  T_i = prod_(j < i) (1 - a_j)

    The buffer holds T, red, green, blue and depth of the tile's pixels; T < 0 marks a full one.
    """
    height, width = alpha.shape
    down = (height - 1) // ROWS + 1
    tile_state, batch = np.empty(5 * PIXELS, np.float32), np.empty(BATCH, SPLAT)
    for tile in range(part, len(starts) - 1, PARTS):
        x0, y0 = (first_column + tile // down) * LANES, tile % down * ROWS
        tile_state[:PIXELS] = 1.0
        tile_state[PIXELS:] = 0.0
        for k in range(starts[tile], starts[tile + 1], BATCH):
            count = min(BATCH, starts[tile + 1] - k)
            for j in range(count):
                batch[j] = splats[hits[k + j] >> 32]
            for j in range(count):
                add_splat(batch[j], hits[k + j] >> 4 & 15, hits[k + j] & 15, x0, y0, tile_state)
            if all_full(tile_state):
                break
        for row in range(min(ROWS, height - y0)):
            for lane in range(min(LANES, width - x0)):
                i, y, x = row * LANES + lane, y0 + row, x0 + lane
                passing = abs(tile_state[i])
                for channel in range(3):
                    rgb[y, x, channel] = tile_state[(1 + channel) * PIXELS + i] + passing * background[channel]
                alpha[y, x] = covered = np.float32(1.0) - passing
                depth[y, x] = tile_state[4 * PIXELS + i] / covered if covered > 0.0 else 0.0


@compiled
def all_full(tile_state):  # type: ignore[no-untyped-def]
    """Whether no pixel of the tile takes further splats."""
    open_pixels = 0
    for i in range(PIXELS):
        open_pixels += tile_state[i] > 0.0
    return open_pixels == 0


# exp(-s) = p(s)^8, p of degree 5 through exp(-s/8) at six Chebyshev points of 0 <= s <= ln 255.
_P = np.polynomial.Chebyshev.interpolate(lambda s: np.exp(-s / 8.0), 5, [0.0, LN_255])
P0, P1, P2, P3, P4, P5 = (np.float32(c) for c in _P.convert(kind=np.polynomial.Polynomial).coef)
S_MAX, A_MAX, ROOM_MIN = np.float32(LN_255), np.float32(ALPHA_MAX), np.float32(T_MIN)


@compiled
def add_splat(splat, first, last, x0, y0, tile_state):  # type: ignore[no-untyped-def]
    """Blend one splat into the rows first..last of a tile."""
    lean, sharp, drop, fade = splat.lean, splat.sharp, splat.drop, splat.fade
    red, green, blue, depth = splat.red, splat.green, splat.blue, splat.depth
    u, dv = np.float32(splat.u - x0 - 0.5), np.float32(y0 + first + 0.5 - splat.v)
    for row in range(first, last + 1):
        middle, least = u + lean * dv, fade + drop * dv * dv
        dv += ONE
        start = np.uint64(row * LANES)
        for lane in range(LANES):
            i = start + np.uint64(lane)  # unsigned: no look whether it counts from the end
            du = np.float32(lane) - middle
            s = least + sharp * du * du
            p = P0 + s * (P1 + s * (P2 + s * (P3 + s * (P4 + s * P5))))
            p = p * p
            p = p * p
            a = p * p
            a = a if a < A_MAX else A_MAX
            a = a if s < S_MAX else ZERO
            before = tile_state[i]
            share = a * before
            after = before - share
            room = after > ROOM_MIN
            share = share if room else ZERO
            tile_state[i] = after if room else -abs(before)
            tile_state[i + np.uint64(PIXELS)] += share * red
            tile_state[i + np.uint64(2 * PIXELS)] += share * green
            tile_state[i + np.uint64(3 * PIXELS)] += share * blue
            tile_state[i + np.uint64(4 * PIXELS)] += share * depth
