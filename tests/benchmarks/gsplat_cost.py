"""What the gsplat backend costs beside gsplat itself: scenes and sizes -> a table of milliseconds.

    PYTHONPATH=. python tests/benchmarks/gsplat_cost.py

Requires an NVIDIA GPU, torch and gsplat, and of the rest only NumPy: neither pytest nor an
installed kit. Both ways begin with poses in the processor's memory and end with colour, alpha and
depth in it; the direct one does nothing else, as somebody would write it who has only gsplat. They
are timed in turn, and the figures are medians of wall-clock time, an image each.
"""

import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from falconwing_kit.core.checks import Array
from falconwing_kit.scene import (
    Frame,
    GaussianScene,
    PinholeCamera,
    load_scene,
    nose_camera_pose,
    render,
    render_batch,
)
from falconwing_kit.scene.gsplat_backend import DEVICE, download, probe_gsplat, rasterize

SIZES = ((320, 240), (640, 480), (960, 720))
ROUNDS = {1: 100, 12: 20, 64: 6}  # poses a call: how often each way is timed
BLACK = np.zeros(3)


def main() -> None:
    """Print the cost of the first call, the table, and where a single image's time goes."""
    import torch

    begin = time.perf_counter()
    probe_gsplat()
    print(f"{torch.cuda.get_device_name()}, torch {torch.__version__}")
    print(f"first image, with what gsplat compiles: {time.perf_counter() - begin:.0f} s\n")
    scenes = {"hall 196k, degree 1": load_scene("hall"), "crowd 150k, degree 3": crowd()}
    print(table(scenes))
    print("\nsingle images of the hall, ms:\n")
    print(parts_of_a_call(scenes["hall 196k, degree 1"]))


def crowd(count: int = 150_000) -> GaussianScene:
    """Gaussians all over the room, of all sizes."""
    rng = np.random.default_rng(0)
    return GaussianScene(
        rng.uniform((-20, -10, 0), (20, 10, 5), (count, 3)),
        rng.normal(size=(count, 4)),
        np.exp(rng.uniform(np.log(0.01), np.log(0.1), (count, 3))),
        rng.uniform(0.05, 1.0, count),
        rng.normal(size=(count, 16, 3)) * 0.1,
    )


def approach(count: int) -> Array:
    """Poses (count, 4, 4) along a landing."""
    return np.stack(
        [
            nose_camera_pose((x, 0.3, 1.6 - 0.05 * (x + 15.0)), 0.1, -0.05, 0.05)
            for x in np.linspace(-15.0, -4.0, count)
        ]
    )


def table(scenes: dict[str, GaussianScene]) -> str:
    """Markdown: kit and direct for every scene, size and number of poses; checks that both drew the
    same.
    """
    lines = ["| scene | size | poses | gsplat, ms an image | kit, ms an image | ratio |"]
    lines += ["|---|---|---|---|---|---|"]
    for name, scene in scenes.items():
        for width, height in SIZES:
            camera = PinholeCamera.from_fov_deg(width, height, 90.0)
            arguments = direct_arguments(scene, camera)
            for count, rounds in ROUNDS.items():
                poses = approach(count)
                kit = partial(draw, scene, camera, poses)
                alone = partial(direct, arguments, poses)
                require_same(kit(), *alone())
                direct_ms, kit_ms = (ms / count for ms in in_turn([alone, kit], rounds))
                lines.append(
                    f"| {name} | {width}x{height} | {count} | {direct_ms:.3f} | {kit_ms:.3f} "
                    f"| {kit_ms / direct_ms:.2f} |"
                )
    return "\n".join(lines)


def draw(scene: GaussianScene, camera: PinholeCamera, poses: Array) -> list[Frame]:
    """The kit's frames: one by `render`, more by `render_batch`."""
    if len(poses) == 1:
        return [render(scene, camera, poses[0], "gsplat")]
    return render_batch(scene, camera, poses, "gsplat")


def parts_of_a_call(scene: GaussianScene) -> str:
    """Markdown: what remains of both when the copies to the processor are left out."""
    lines = ["| size | gsplat without copies | rasterize | + download | direct | render |"]
    lines += ["|---|---|---|---|---|---|"]
    for width, height in SIZES:
        camera = PinholeCamera.from_fov_deg(width, height, 90.0)
        poses, arguments = approach(1), direct_arguments(scene, camera)
        view = scene, camera, poses
        ways: list[Callable[[], Any]] = [
            partial(rasterize_direct, arguments, poses),
            partial(rasterize, *view, BLACK, False),
            partial(rasterize_and_download, *view),
            partial(direct, arguments, poses),
            partial(draw, *view),
        ]
        times = " | ".join(f"{ms:.3f}" for ms in in_turn(ways, ROUNDS[1]))
        lines.append(f"| {width}x{height} | {times} |")
    return "\n".join(lines)


def rasterize_and_download(scene: GaussianScene, camera: PinholeCamera, poses: Array) -> Any:
    """`render` without its checks."""
    return download(*rasterize(scene, camera, poses, BLACK, False))


def direct_arguments(scene: GaussianScene, camera: PinholeCamera) -> dict[str, Any]:
    """What somebody who uses gsplat by itself keeps on the GPU, but for the poses."""
    arrays = {
        "means": scene.means,
        "quats": scene.quaternions,
        "scales": scene.scales,
        "opacities": scene.opacities,
        "colors": scene.sh,
        "Ks": camera.K[None],
        "backgrounds": BLACK[None],
    }
    return {name: on_gpu(array) for name, array in arrays.items()} | {
        "width": camera.width,
        "height": camera.height,
        "sh_degree": int(scene.sh.shape[1] ** 0.5) - 1,
        "packed": False,
        "render_mode": "RGB+ED",
    }


def on_gpu(array: Any) -> Any:
    """A float32 tensor on the GPU."""
    import torch

    return torch.tensor(np.asarray(array), dtype=torch.float32, device=DEVICE)


def rasterize_direct(arguments: dict[str, Any], poses: Array) -> Any:
    """New poses in, colour with depth and alpha on the GPU."""
    from gsplat import rasterization

    count = len(poses)
    views = {
        "viewmats": on_gpu(np.linalg.inv(poses)),
        "Ks": arguments["Ks"].expand(count, 3, 3),
        "backgrounds": arguments["backgrounds"].expand(count, 3),
    }
    return rasterization(**arguments | views)[:2]


def direct(arguments: dict[str, Any], poses: Array) -> Any:
    """New poses in, colour with depth (C, H, W, 4) and alpha (C, H, W) out."""
    colours, alphas = rasterize_direct(arguments, poses)
    return colours.cpu().numpy(), alphas[..., 0].cpu().numpy()


def require_same(frames: Any, colours: Array, alphas: Array) -> None:
    """AssertionError unless the kit's frames are gsplat's, cut at 1."""
    assert len(frames) == len(colours)
    for frame, colour, alpha in zip(frames, colours, alphas, strict=True):
        assert np.array_equal(frame.rgb, np.clip(colour[..., :3], 0.0, 1.0))
        assert np.array_equal(frame.depth, colour[..., 3])
        assert np.array_equal(frame.alpha, alpha)
        assert frame.rgb.std() > 0.02  # a picture


def in_turn(ways: list[Callable[[], Any]], rounds: int) -> list[float]:
    """Median milliseconds of each way, timed in turn and waited for, after two unmeasured."""
    import torch

    seconds: list[list[float]] = [[] for _ in ways]
    for _ in range(rounds + 2):
        for way, times in zip(ways, seconds, strict=True):
            begin = time.perf_counter()
            way()
            torch.cuda.synchronize()
            times.append(time.perf_counter() - begin)
    return [1e3 * statistics.median(times[2:]) for times in seconds]


if __name__ == "__main__":
    main()
