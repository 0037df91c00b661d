"""scene: Gaussian scenes, their files, the arena, the camera that looks at them, and its image.

Nothing here loads torch or numba before `render` is called; what learns through images imports
`falconwing_kit.scene.reference` itself.
"""

from falconwing_kit.scene.analog import AnalogVideo, scene_link
from falconwing_kit.scene.arena import build_arena, leader_at, load_scene
from falconwing_kit.scene.camera import PinholeCamera, nose_camera_pose
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.masks import MASK_THRESHOLD, Ellipsoid, ellipse_mask, visible_alpha_image
from falconwing_kit.scene.native import write_quantised
from falconwing_kit.scene.render import BACKENDS, Frame, render, render_batch, require_pose

__all__ = [
    "BACKENDS",
    "MASK_THRESHOLD",
    "AnalogVideo",
    "Ellipsoid",
    "Frame",
    "GaussianScene",
    "PinholeCamera",
    "build_arena",
    "ellipse_mask",
    "leader_at",
    "load_scene",
    "nose_camera_pose",
    "render",
    "render_batch",
    "require_pose",
    "scene_link",
    "visible_alpha_image",
    "write_quantised",
]
