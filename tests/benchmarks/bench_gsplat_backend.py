"""The gsplat backend on a GPU: the same image as the reference, and what the wrapper costs beside
gsplat itself.

    python -m pytest -m benchmark tests/benchmarks/bench_gsplat_backend.py

Requires an NVIDIA GPU with gsplat; elsewhere it says so and is skipped. Times are wall-clock
milliseconds, with the GPU waited for: it works beside the processor, so CPU time would miss it. The
trained scene is shown where it lies beside the checkout. The tables are Markdown.
"""

from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.scene import (
    GaussianScene,
    PinholeCamera,
    leader_at,
    load_scene,
    nose_camera_pose,
    render,
)
from falconwing_kit.scene.gsplat_backend import probe_gsplat
from tests.benchmarks import gsplat_cost

pytestmark = [
    pytest.mark.benchmark,
    pytest.mark.timeout(1200),
]  # gsplat compiles for minutes at first use
TRAINED = Path(__file__).resolve().parents[3] / "shared/data/splat/playbot_lod2_125k"
BLACK = np.zeros(3)
View = tuple[GaussianScene, Array]


@pytest.fixture(scope="module", autouse=True)
def working_gsplat() -> None:
    """Skip, with the backend's own sentence, where gsplat cannot run."""
    try:
        probe_gsplat()
    except InputError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def views() -> dict[str, View]:
    """Scenes and poses: down the arena, in the middle of a crowd, and before a trained figure."""
    found = {
        "arena": (
            leader_at(load_scene("arena"), None),
            nose_camera_pose((-15.0, 0.5, 1.6), 0.2, -0.05, 0.1),
        ),
        "crowd 150k, degree 3": (
            gsplat_cost.crowd(),
            nose_camera_pose((0.0, 0.0, 2.0), 0.3, 0.1, 0.7),
        ),
    }
    if TRAINED.is_dir():
        trained, pose = (
            GaussianScene.load(TRAINED),
            np.eye(4),
        )  # its y axis points down, as the camera's
        pose[:3, 3] = np.median(trained.means, axis=0) - (0.0, 0.0, 1.8)
        found["trained 125k, degree 2"] = (trained, pose)
    return found


def test_gsplat_draws_what_the_reference_draws(
    views: dict[str, View], capsys: pytest.CaptureFixture[str]
) -> None:
    """Prints the differences; the bars are the project's for two renderers: 60 dB, 0.1 % of pixels
    over 2/255.
    """
    lines = [
        "| scene | mode | largest difference | PSNR, dB | pixels over 2/255, % | depth, relative |"
    ]
    lines += ["|---|---|---|---|---|---|"]
    camera, worst, most = PinholeCamera.from_fov_deg(320, 240, 90.0), np.inf, 0.0
    for name, (scene, pose) in views.items():
        for antialiased in (False, True):
            theirs, ours = (
                render(scene, camera, pose, b, BLACK, antialiased) for b in ("gsplat", "reference")
            )
            difference, solid = np.abs(theirs.rgb - ours.rgb), ours.alpha > 0.5
            psnr = -10.0 * np.log10(max(float(np.mean(difference**2)), 1e-20))
            over = 100.0 * float((difference.max(axis=2) > 2 / 255).mean())
            depth = float(np.abs(theirs.depth[solid] / ours.depth[solid] - 1.0).max())
            mode = "antialiased" if antialiased else "classic"
            lines.append(
                f"| {name} | {mode} | {difference.max():.1e} | {psnr:.0f} "
                f"| {over:.3f} | {depth:.1e} |"
            )
            worst, most = min(worst, psnr), max(most, over)
    with capsys.disabled():
        print("\n\n" + "\n".join(lines))
    assert worst >= 60.0 and most <= 0.1


def test_cost_of_the_wrapper(views: dict[str, View], capsys: pytest.CaptureFixture[str]) -> None:
    """Prints the tables of gsplat_cost.py, which also runs by itself; every way drew the same."""
    with capsys.disabled():
        print()
        gsplat_cost.main()
