"""Fast renderer: GaussianScene + camera pose -> image, opacity and depth, on a CPU, by code that numba compiles.

It equals `reference` to a hundredth of a grey level and trades readability for speed; it has no gradients. Steps:

    project   every Gaussian becomes a splat, an ellipse in the image with a colour; those out of view drop out
    sort      nearest first
    bin       which tiles of the image each ellipse touches, exactly: a list for every tile, nearest first
    blend     every tile on its own, front to back, eight pixels at a time

A kernel does one part of PARTS of its step, so that several threads share the parts; which thread does which changes no
bit of the image. The conventions are those of gsplat 1.5 in its "classic" mode; its defaults are the constants here.
"""

import math
import os
from collections.abc import Callable
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
T_MIN = 1e-4  # light that still passes a pixel when it counts as full

PARTS = 16
LANES, ROWS = 8, 32  # a tile's width and height [px]; eight floats are one AVX2 register
PIXELS = LANES * ROWS
CHECK_EVERY = 16  # splats of a tile between two looks whether all of its pixels are full

SPLAT = np.dtype(
    [
        *((name, np.float32) for name in ("u", "v")),  # centre [px]
        *((name, np.float32) for name in ("reach_u", "reach_v")),  # half width and half height of the ellipse [px]
        *((name, np.float32) for name in ("tilt", "half")),  # its middle in a column: dv = tilt du, +- half at du = 0
        *((name, np.float32) for name in ("lean", "sharp", "drop")),  # sigma = drop dv^2 + sharp (du - lean dv)^2
        *((name, np.float32) for name in ("cut", "opacity")),  # opacity exp(-cut) = 1/255: the ellipse's edge
        *((name, np.float32) for name in ("red", "green", "blue", "depth")),
    ],
    align=True,
)


def compiled(function: Callable[..., Any]) -> Any:
    """The function as machine code that lets other threads run; kept on disk where some folder can be written."""
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # numba found no folder for its cache
        return njit(**options)(function)


def render_fast(
    scene: GaussianScene,
    camera: PinholeCamera,
    T_world_camera: ArrayLike,
    background: ArrayLike = (0.0, 0.0, 0.0),
    antialiased: bool = False,
    threads: int | None = None,
) -> tuple[Image32, Image32, Image32]:
    """Image, opacity and depth of a scene, as `reference` gives them.

    Args:
        scene: the Gaussians.
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
    behind = require_shape("background", background, (3,))
    workers = int(require_range("threads", threads or os.cpu_count() or 1, low=1, high=1024))
    with ThreadPoolExecutor(min(workers, PARTS)) as pool:

        def run(kernel: Any, *arguments: Any) -> None:
            share = map if workers == 1 else pool.map
            list(share(lambda part: kernel(part, *arguments), range(PARTS)))

        splats, depths = np.empty(len(scene), SPLAT), np.empty(len(scene), np.float32)
        arrays = (scene.means, scene.quaternions, scene.scales, scene.opacities, scene.sh)
        run(project, *arrays, pose, *_intrinsics(camera), antialiased, splats, depths)
        order = nearest_first(depths)
        starts, hits = _bin(run, splats, order, camera.width, camera.height)
        rgb = np.empty((camera.height, camera.width, 3), np.float32)
        alpha, depth = np.empty(rgb.shape[:2], np.float32), np.empty(rgb.shape[:2], np.float32)
        run(blend, splats, starts, hits, behind.astype(np.float32), rgb, alpha, depth)
    return rgb, alpha, depth


def nearest_first(depths: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Indices of the splats in view in the order of their depth; equal depths keep the order of the scene.

    Args:
        depths: (N,) [m], inf for what is not in view. The bits of positive floats sort like the floats.
    """
    seen = np.flatnonzero(depths < np.inf).astype(np.uint64)
    keys = depths[seen].view(np.uint32).astype(np.uint64) << np.uint64(32) | seen
    keys.sort()
    return (keys & np.uint64(0xFFFFFFFF)).astype(np.uint32)


def _intrinsics(camera: PinholeCamera) -> tuple[float, float, float, float, int, int]:
    return camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height


def _bin(run: Any, splats: Any, order: Any, width: int, height: int) -> tuple[NDArray[np.int64], NDArray[np.uint64]]:
    """Where each tile's list starts (tiles + 1,), and all lists one after the other: splat and rows, packed."""
    tiles = -(-width // LANES) * -(-height // ROWS)
    counts = np.zeros((PARTS, tiles), np.int64)
    run(count_hits, splats, order, width, height, counts)
    ends = np.cumsum(counts.T.ravel()).reshape(tiles, PARTS).T  # part after part within tile after tile
    hits = np.empty(ends[-1, -1], np.uint64)
    run(fill_hits, splats, order, width, height, np.ascontiguousarray(ends - counts), hits)
    return np.concatenate([[0], ends[-1]]), hits


@compiled
def project(  # type: ignore[no-untyped-def]
    part,
    means,
    quaternions,
    scales,
    opacities,
    sh,
    T_world_camera,
    fx,
    fy,
    cx,
    cy,
    width,
    height,
    smooth,
    splats,
    depths,
):
    """Gaussians -> splats, and the depth of those in view, else inf.

    cov = J A (J A)^T + BLUR I,  A = R_camera_world R_world_cloud diag(scales)   [Zwicker et al. 2001, EWA splatting]
    J = [[fx/z, 0, -fx x/z^2], [0, fy/z, -fy y/z^2]], x and y held within the field of view and EDGE of it
    """
    count = means.shape[0]
    basis = np.empty(16)
    A = np.empty((3, 3))
    tan_u, tan_v = EDGE * 0.5 * width / fx, EDGE * 0.5 * height / fy
    for i in range(count * part // PARTS, count * (part + 1) // PARTS):
        depths[i] = np.inf
        dx, dy, dz = (
            means[i, 0] - T_world_camera[0, 3],
            means[i, 1] - T_world_camera[1, 3],
            means[i, 2] - T_world_camera[2, 3],
        )
        z = T_world_camera[0, 2] * dx + T_world_camera[1, 2] * dy + T_world_camera[2, 2] * dz
        if not z >= NEAR or opacities[i] < ALPHA_MIN:
            continue
        x = (T_world_camera[0, 0] * dx + T_world_camera[1, 0] * dy + T_world_camera[2, 0] * dz) / z
        y = (T_world_camera[0, 1] * dx + T_world_camera[1, 1] * dy + T_world_camera[2, 1] * dz) / z
        cloud_axes(quaternions[i], scales[i], T_world_camera, A)
        x_held = min(max(x, -cx / fx - tan_u), (width - cx) / fx + tan_u)
        y_held = min(max(y, -cy / fy - tan_v), (height - cy) / fy + tan_v)
        uu, uv, vv = 0.0, 0.0, 0.0
        for k in range(3):
            du, dv = fx / z * (A[0, k] - x_held * A[2, k]), fy / z * (A[1, k] - y_held * A[2, k])
            uu, uv, vv = uu + du * du, uv + du * dv, vv + dv * dv
        area = uu * vv - uv * uv
        uu, vv = uu + BLUR, vv + BLUR
        det = uu * vv - uv * uv
        opacity = opacities[i] * (math.sqrt(max(0.0, area / det)) if smooth else 1.0)
        cut = math.log(opacity / ALPHA_MIN) if opacity >= ALPHA_MIN else -1.0
        u, v = fx * x + cx, fy * y + cy
        reach_u, reach_v = math.sqrt(2.0 * max(cut, 0.0) * uu), math.sqrt(2.0 * max(cut, 0.0) * vv)
        if cut < 0.0 or u + reach_u < 0.0 or u - reach_u > width or v + reach_v < 0.0 or v - reach_v > height:
            continue
        depths[i] = z
        s = splats[i]
        s.u, s.v, s.reach_u, s.reach_v = u, v, reach_u, reach_v
        s.tilt, s.half = uv / uu, math.sqrt(2.0 * cut * det / uu)
        s.lean, s.sharp, s.drop = uv / vv, vv / (2.0 * det), 1.0 / (2.0 * vv)
        s.cut, s.opacity, s.depth = cut, opacity, z
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        harmonics(sh.shape[1], dx / distance, dy / distance, dz / distance, basis)
        red, green, blue = 0.5, 0.5, 0.5
        for k in range(sh.shape[1]):
            red, green, blue = (
                red + basis[k] * sh[i, k, 0],
                green + basis[k] * sh[i, k, 1],
                blue + basis[k] * sh[i, k, 2],
            )
        s.red, s.green, s.blue = max(red, 0.0), max(green, 0.0), max(blue, 0.0)


@compiled
def cloud_axes(quaternion, scales, T_world_camera, A):  # type: ignore[no-untyped-def]
    """A (3, 3): the cloud's axes as columns, in the camera's axes, each as long as its standard deviation [m]."""
    w, x, y, z = float(quaternion[0]), float(quaternion[1]), float(quaternion[2]), float(quaternion[3])
    axes = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        (2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    for k in range(3):
        a, b, c = axes[k]
        for row in range(3):
            along = T_world_camera[0, row] * a + T_world_camera[1, row] * b + T_world_camera[2, row] * c
            A[row, k] = scales[k] * along


@compiled
def harmonics(count, x, y, z, Y):  # type: ignore[no-untyped-def]
    """The first `count` real spherical harmonics in a direction of length 1 [Kerbl et al. 2023, their signs]."""
    Y[0] = 0.28209479177387814
    if count > 1:
        Y[1], Y[2], Y[3] = -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x
    if count > 4:
        Y[4], Y[5] = 1.0925484305920792 * x * y, -1.0925484305920792 * y * z
        Y[6] = 0.31539156525252005 * (2.0 * z * z - x * x - y * y)
        Y[7], Y[8] = -1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y)
    if count > 9:
        Y[9] = -0.5900435899266435 * y * (3.0 * x * x - y * y)
        Y[10] = 2.890611442640554 * x * y * z
        Y[11] = -0.4570457994644658 * y * (4.0 * z * z - x * x - y * y)
        Y[12] = 0.3731763325901154 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y)
        Y[13] = -0.4570457994644658 * x * (4.0 * z * z - x * x - y * y)
        Y[14] = 1.445305721320277 * z * (x * x - y * y)
        Y[15] = -0.5900435899266435 * x * (x * x - 3.0 * y * y)


@compiled
def held(value, low, high):  # type: ignore[no-untyped-def]
    """The value within bounds; what is not a number becomes the lower one."""
    value = value if value > low else low
    return value if value < high else high


@compiled
def rows_in_column(s, first, last, height):  # type: ignore[no-untyped-def]
    """First and last row whose pixel centre the ellipse covers somewhere in the columns first..last.

    In one column the ellipse reaches from v + tilt du - h to v + tilt du + h, h = half sqrt(1 - (du / reach_u)^2); over
    a range of columns the end is where its own top lies, du = lean reach_v, or the column nearest to that.
    """
    left, right = max(first + 0.5 - s.u, -s.reach_u), min(last + 0.5 - s.u, s.reach_u)
    if not left <= right:
        return 0, -1
    du = held(s.lean * s.reach_v, left, right)
    high = s.v + s.tilt * du + s.half * math.sqrt(max(0.0, 1.0 - (du / s.reach_u) ** 2))
    du = held(-s.lean * s.reach_v, left, right)
    low = s.v + s.tilt * du - s.half * math.sqrt(max(0.0, 1.0 - (du / s.reach_u) ** 2))
    return int(held(math.ceil(low - 0.5), 0.0, height)), int(held(math.floor(high - 0.5), -1.0, height - 1.0))


@compiled
def columns(s, width):  # type: ignore[no-untyped-def]
    """First and last column of tiles that the ellipse's box touches."""
    last = (width - 1) // LANES
    return int(held((s.u - s.reach_u) // LANES, 0.0, last)), int(held((s.u + s.reach_u) // LANES, 0.0, last))


@compiled
def count_hits(part, splats, order, width, height, counts):  # type: ignore[no-untyped-def]
    """counts (PARTS, tiles): how many splats of this part of the order touch each tile."""
    down = -(-height // ROWS)
    for rank in range(len(order) * part // PARTS, len(order) * (part + 1) // PARTS):
        s = splats[order[rank]]
        left, right = columns(s, width)
        for column in range(left, right + 1):
            top, bottom = rows_in_column(s, column * LANES, min(column * LANES + LANES, width) - 1, height)
            if top <= bottom:
                for row in range(top // ROWS, bottom // ROWS + 1):
                    counts[part, column * down + row] += 1


@compiled
def fill_hits(part, splats, order, width, height, places, hits):  # type: ignore[no-untyped-def]
    """Write splat, first and last row within the tile into each touched tile's list, from places (PARTS, tiles) on."""
    down = -(-height // ROWS)
    for rank in range(len(order) * part // PARTS, len(order) * (part + 1) // PARTS):
        s = splats[order[rank]]
        left, right = columns(s, width)
        for column in range(left, right + 1):
            top, bottom = rows_in_column(s, column * LANES, min(column * LANES + LANES, width) - 1, height)
            if top <= bottom:
                for row in range(top // ROWS, bottom // ROWS + 1):
                    tile = column * down + row
                    first, last = max(top - row * ROWS, 0), min(bottom - row * ROWS, ROWS - 1)
                    hits[places[part, tile]] = np.uint64(order[rank]) << np.uint64(16) | np.uint64(first << 8 | last)
                    places[part, tile] += 1


@compiled
def blend(part, splats, starts, hits, background, rgb, alpha, depth):  # type: ignore[no-untyped-def]
    """Composite every PARTS-th tile, front to back [Kerbl et al. 2023, eq. 3].

    C = sum_i c_i a_i T_i,  a_i = min(0.999, o_i exp(-sigma_i)),  T_i = prod_(j < i) (1 - a_j)

    The buffer holds T, red, green, blue and depth of the tile; T < 0 marks a full pixel.
    """
    height, width = alpha.shape
    down = -(-height // ROWS)
    tile_state = np.empty(5 * PIXELS, np.float32)
    for tile in range(part, len(starts) - 1, PARTS):
        x0, y0 = tile // down * LANES, tile % down * ROWS
        tile_state[:PIXELS] = 1.0
        tile_state[PIXELS:] = 0.0
        for k in range(starts[tile], starts[tile + 1]):
            if (k - starts[tile]) % CHECK_EVERY == CHECK_EVERY - 1 and all_full(tile_state):
                break
            add_splat(splats[hits[k] >> np.uint64(16)], hits[k] & np.uint64(0xFFFF), x0, y0, tile_state)
        for row in range(min(ROWS, height - y0)):
            for lane in range(min(LANES, width - x0)):
                i = row * LANES + lane
                passing = abs(tile_state[i])
                covered = np.float32(1.0) - passing
                for channel in range(3):
                    rgb[y0 + row, x0 + lane, channel] = (
                        tile_state[(1 + channel) * PIXELS + i] + passing * background[channel]
                    )
                alpha[y0 + row, x0 + lane] = covered
                depth[y0 + row, x0 + lane] = tile_state[4 * PIXELS + i] / covered if covered > 0.0 else 0.0


@compiled
def all_full(tile_state):  # type: ignore[no-untyped-def]
    """Whether no pixel of the tile takes further splats."""
    open_pixels = 0
    for i in range(PIXELS):
        open_pixels += tile_state[i] > 0.0
    return open_pixels == 0


# exp(-s) = p(s)^8, p of degree 4 through exp(-s/8) at five Chebyshev points of 0 <= s <= ln 255.
_P = np.polynomial.chebyshev.Chebyshev.interpolate(lambda s: np.exp(-s / 8.0), 4, [0.0, math.log(255.0)])
P0, P1, P2, P3, P4 = (np.float32(c) for c in _P.convert(kind=np.polynomial.Polynomial).coef)
ONE_MAX, PASS_MIN = np.float32(ALPHA_MAX), np.float32(T_MIN)


@compiled
def add_splat(s, rows, x0, y0, tile_state):  # type: ignore[no-untyped-def]
    """Blend one splat into the rows of a tile."""
    u, v, lean, sharp, drop, cut, opacity = s.u, s.v, s.lean, s.sharp, s.drop, s.cut, s.opacity
    red, green, blue, depth = s.red, s.green, s.blue, s.depth
    zero = np.float32(0.0)
    for row in range(rows >> np.uint64(8), (rows & np.uint64(255)) + np.uint64(1)):
        dv = np.float32(y0 + row + 0.5) - v
        middle = u + lean * dv - np.float32(x0 + 0.5)
        least = drop * dv * dv
        for lane in range(LANES):
            i = np.uint64(row) * np.uint64(LANES) + np.uint64(lane)
            du = np.float32(lane) - middle
            sigma = least + sharp * du * du
            root = P0 + sigma * (P1 + sigma * (P2 + sigma * (P3 + sigma * P4)))
            root = root * root
            root = root * root
            a = opacity * (root * root)
            a = a if a < ONE_MAX else ONE_MAX
            before = tile_state[i]
            after = before - before * a
            inside = sigma <= cut
            room = after > PASS_MIN
            share = a * before if inside & room else zero
            tile_state[i] = (after if room else -abs(before)) if inside else before
            tile_state[i + np.uint64(PIXELS)] += share * red
            tile_state[i + np.uint64(2 * PIXELS)] += share * green
            tile_state[i + np.uint64(3 * PIXELS)] += share * blue
            tile_state[i + np.uint64(4 * PIXELS)] += share * depth
