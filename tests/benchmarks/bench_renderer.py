"""The fast renderer: time a frame, its steps, pixel-Gaussian pairs against their floor, the
reference, and memory.

    python -m pytest -m benchmark -s tests/benchmarks/bench_renderer.py

Wall-clock time is the median of many frames and counts only on a quiet machine; CPU time is that of
the process over all its threads, the best of them, and can be compared anywhere. The trained scene
(PLAYBOT by Stephane Agullo, sa3d.fr, CC-BY-4.0) is shown where it lies beside the checkout. The
tables are Markdown.
"""

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import njit

from falconwing_kit.core.checks import Array
from falconwing_kit.scene import (
    GaussianScene,
    PinholeCamera,
    fast,
    leader_at,
    load_scene,
    nose_camera_pose,
)
from tests.benchmarks.bench_rollouts import machine

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(1200)]
ROOT = Path(__file__).resolve().parents[2]
TRAINED = ROOT.parent / "shared/data/splat/playbot_lod2_125k"
SIZES = ((640, 480), (320, 240))
FRAMES, THREADS = 40, min(2, os.cpu_count() or 1)
BLACK = np.zeros(3, np.float32)
FLOOR_NS = 0.6  # a pair that counts: 35 operations on one AVX2 core at 3.5 GHz, 16 a cycle
LANE_NS = 0.5  # a pixel that was computed, measured for the same loop in C
View = tuple[GaussianScene, Array]


@pytest.fixture(scope="module")
def views() -> dict[str, list[View]]:
    """Scenes with the poses that they are seen from."""
    arena = leader_at(load_scene("arena"), None)
    approach = [nose_camera_pose((x, 0.3, 1.5), 0.1, -0.05, 0.02) for x in (-19.0, -10.0, -4.0)]
    found = {f"arena {len(arena) // 1000}k, degree 0": [(arena, pose) for pose in approach]}
    if TRAINED.is_dir():
        trained = GaussianScene.load(TRAINED)
        found["trained 125k, degree 2"] = [
            (trained, around(trained, angle)) for angle in (0.3, 1.5, 3.0, 4.5)
        ]
    return found


def around(scene: GaussianScene, angle: float) -> Array:
    """A camera 1.7 m from a trained figure, whose y axis points down as the camera's, that looks at
    it.
    """
    centre = np.median(scene.means, axis=0) + np.array([0.0, -0.4, 0.0])
    forward = -np.array([np.sin(angle), -0.25, np.cos(angle)]) / np.hypot(1.0, 0.25)
    right = np.cross((0.0, 1.0, 0.0), forward) / np.hypot(forward[0], forward[2])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = (
        np.stack([right, np.cross(forward, right), forward], axis=1),
        centre - 1.7 * forward,
    )
    return pose


def test_milliseconds_a_frame(
    views: dict[str, list[View]], capsys: pytest.CaptureFixture[str]
) -> None:
    """Prints the table of times; asserts only that what was timed was a picture."""
    from falconwing_kit.scene.reference import render_reference

    lines = [
        "| scene | size | wall, ms | CPU, ms | reference, CPU ms | times |",
        "|---|---|---|---|---|---|",
    ]
    for name, seen in views.items():
        for width, height in SIZES:
            camera = PinholeCamera.from_fov_deg(width, height, 70.0)
            frames = [
                partial(fast.render_fast, scene, camera, T, BLACK, threads=THREADS)
                for scene, T in seen
            ]
            wall, cpu = timed(frames)
            _, slow = timed(
                [partial(render_reference, seen[0][0], camera, seen[0][1], BLACK)], count=1
            )
            lines.append(
                f"| {name} | {width}x{height} | {wall:.1f} | {cpu:.1f} "
                f"| {slow:.0f} | {slow / cpu:.0f} |"
            )
            assert all(frame()[0].std() > 0.02 for frame in frames)
    with capsys.disabled():
        print(f"\n\n{machine()}; {THREADS} threads, load {load()}.\n\n" + "\n".join(lines))


def test_steps_and_pairs(views: dict[str, list[View]], capsys: pytest.CaptureFixture[str]) -> None:
    """Prints the CPU time of every step on one thread, and what a pixel-Gaussian pair costs."""
    kernels = ("project_kernel", "sort", "intersect_tiles", "scatter_to_tiles", "rasterize_tiles")
    lines = [
        "| scene | size | "
        + " | ".join(kernels)
        + " | M pixels | M pairs | ns a pixel | ns a pair | floor |"
    ]
    lines += ["|---" * (len(kernels) + 7) + "|"]
    for name, seen in views.items():
        for width, height in SIZES:
            camera = PinholeCamera.from_fov_deg(width, height, 70.0)
            steps, pixels, pairs = dissect(*seen[0], camera)
            ms = " | ".join(f"{1e3 * steps[kernel]:.1f}" for kernel in kernels)
            tiles_ns = 1e9 * steps["rasterize_tiles"]
            each = f"{tiles_ns / pixels:.2f} | {tiles_ns / pairs:.2f} | {FLOOR_NS}"
            lines.append(
                f"| {name} | {width}x{height} | {ms} | {pixels / 1e6:.1f} "
                f"| {pairs / 1e6:.1f} | {each} |"
            )
            assert 0 < pairs < pixels
    with capsys.disabled():
        print(
            "\n\nCPU ms of the steps, one thread. A pixel: computed for a splat; "
            "a pair: it changed by one."
        )
        print(f"The same loop in C takes {LANE_NS} ns a pixel.\n\n" + "\n".join(lines))


def test_first_frame_and_memory_of_half_a_million(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Prints what a fresh process needs; the bound is the project's, here with all libraries."""
    if not Path("/proc/self/status").is_file():
        pytest.skip("this system does not tell in /proc how much memory a process held")
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    for when in ("compiled for the first time", "kept from an earlier run"):
        command = [sys.executable, "-c", HALF_A_MILLION]
        done = subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, text=True, check=True
        )
        seconds, libraries, scene, most = (float(word) for word in done.stdout.split())
        with capsys.disabled():
            print(
                f"\n\nThe first frame of a process takes {seconds:.1f} s of CPU time "
                f"with the code {when}."
            )
            print(
                f"500k Gaussians of degree 2 at 640x480: {libraries:.0f} MB with the libraries,\n"
                f"{scene - libraries:.0f} MB more with the scene made, {most - scene:.0f} MB more "
                "at the peak of its frames."
            )
        assert most < 500.0


HALF_A_MILLION = """
import time, numpy as np
from falconwing_kit.scene import GaussianScene, PinholeCamera, nose_camera_pose
from falconwing_kit.scene import fast
def held():
    lines = open("/proc/self/status")
    return next(int(line.split()[1]) / 1e3 for line in lines if line.startswith("VmHWM"))
camera = PinholeCamera.from_fov_deg(640, 480, 80.0)
pose = nose_camera_pose((-10.0, 0.0, 1.5), 0.0, 0.0, 0.1)
few = GaussianScene(
    np.ones((1, 3)), np.ones((1, 4)), np.ones((1, 3)), np.ones(1), np.ones((1, 9, 3))
)
begin = time.process_time()
fast.render_fast(few, camera, pose)
seconds, libraries = time.process_time() - begin, held()
rng, count = np.random.default_rng(0), 500_000
draw = lambda *size: rng.random(size, dtype=np.float32)
means = (draw(count, 3) - [0.5, 0.5, 0.0]) * [40.0, 20.0, 5.0]
scales = 0.01 + 0.1 * draw(count, 3)
scene = GaussianScene(means, draw(count, 4) - 0.5, scales, draw(count), 0.1 * draw(count, 9, 3))
loaded = held()
for _ in range(3):
    fast.render_fast(scene, camera, pose)
print(seconds, libraries, loaded, held())
"""


def dissect(
    scene: GaussianScene, pose: Array, camera: PinholeCamera
) -> tuple[dict[str, float], int, int]:
    """CPU seconds of each step, the best of several; pixels that were computed, and pairs that
    counted.
    """
    seconds: dict[str, float] = {}
    took: dict[str, float] = {}

    def run(kernel: Any, *arguments: Any) -> None:
        begin = time.process_time()
        for part in range(fast.WORK_PARTS):
            kernel(part, *arguments)
        took[kernel.__name__] = time.process_time() - begin

    rgb = np.empty((camera.height, camera.width, 3), np.float32)
    alpha, depth = np.empty(rgb.shape[:2], np.float32), np.empty(rgb.shape[:2], np.float32)
    for _ in range(10):
        begin = time.process_time()
        splats, order, boxes = fast._splats_in_view(run, (scene,), camera, pose, False)
        took["sort"] = time.process_time() - begin - took["project_kernel"]
        for band, begins in fast._bands(
            boxes, camera.width, camera.height
        ):  # one band: these scenes are ordinary
            starts, hits = fast._lists_of_tiles(run, splats, order, begins, band, camera.height)
            run(fast.rasterize_tiles, splats, starts, hits, band[0], BLACK, rgb, alpha, depth)
        seconds = {name: min(value, seconds.get(name, value)) for name, value in took.items()}
    return seconds, *count_pairs(splats, starts, hits, (camera.height - 1) // fast.TILE_HEIGHT + 1)


@njit
def count_pairs(splats, starts, hits, down):  # type: ignore[no-untyped-def]
    """Pixels that blending computes and pixels whose passing light a splat changes, by blending
    once more.
    """
    pixels, pairs, tile_state = 0, 0, np.empty(5 * fast.TILE_PIXELS, np.float32)
    for tile in range(len(starts) - 1):
        tile_state[: fast.TILE_PIXELS] = 1.0
        for k in range(starts[tile], starts[tile + 1]):
            if (k - starts[tile]) % fast.BATCH == 0 and fast.is_tile_saturated(tile_state):
                break
            first, last = hits[k] >> 4 & 15, hits[k] & 15
            before = tile_state[: fast.TILE_PIXELS].copy()
            x0, y0 = tile // down * fast.TILE_WIDTH, tile % down * fast.TILE_HEIGHT
            fast.blend_splat(splats[hits[k] >> 32], first, last, x0, y0, tile_state)
            pixels += (last - first + 1) * fast.TILE_WIDTH
            pairs += (np.abs(tile_state[: fast.TILE_PIXELS]) != np.abs(before)).sum()
    return pixels, pairs


def timed(works: list[Callable[[], Any]], count: int = FRAMES) -> tuple[float, float]:
    """Milliseconds of one work, all taken in turn: median wall-clock time, and the mean of each
    one's best CPU time.
    """
    wall: list[float] = []
    cpu = []
    for work in works:
        begins = []
        if count > 1:
            work()  # numba compiles at the first call
        for _ in range(-(-count // len(works))):
            begin, begin_cpu = time.perf_counter(), time.process_time()
            work()
            wall.append(1e3 * (time.perf_counter() - begin))
            begins.append(1e3 * (time.process_time() - begin_cpu))
        cpu.append(min(begins))
    return statistics.median(wall), statistics.mean(cpu)


def load() -> str:
    """How many processes wanted a core in the last minute."""
    return f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
