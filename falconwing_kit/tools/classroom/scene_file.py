"""Scene for a page: a GaussianScene -> the bytes that the page's renderer loads, an SPZ unpacked.

The server sends them with Content-Encoding: gzip; a page in one file may hold them packed by gzip,
which the renderer notices by itself.
"""

from falconwing_kit.core.checks import require_range
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.tools.capture.packed_write import spz_payload

FRACTION_BITS = 10  # of the positions: steps of 1 mm
SH_BITS = 5  # of each harmonic: less to send, and the eye sees no difference
DEGREE_COUNT = 4  # harmonics that the page draws: up to degree 1
LEADER = "leader"  # label of Gaussians in their body axes; the page draws the leader as boxes


def scene_bytes(scene: GaussianScene, max_gaussians: int | None = None) -> bytes:
    """The inside of an SPZ of version 3: the hall without its leader, colours up to degree 1.

    Args:
        max_gaussians: at most so many, for a weak phone, by `thinned`; None for all.

    Raises:
        InputError: max_gaussians is below 1, or a Gaussian lies too far from the origin.
    """
    if LEADER in scene.label_names and not scene.labelled(LEADER).all():
        scene = scene.selected(~scene.labelled(LEADER))
    if scene.sh.shape[1] > DEGREE_COUNT:
        scene = GaussianScene(
            scene.means, scene.quaternions, scene.scales, scene.opacities, scene.sh[:, :DEGREE_COUNT]
        )
    if max_gaussians is not None:
        require_range("max_gaussians", max_gaussians, low=1)
    return spz_payload(scene, FRACTION_BITS, SH_BITS)[0]
