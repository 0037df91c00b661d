"""scene: Gaussian scenes, their files, the camera that looks at them, and its image."""

from falconwing_kit.scene.camera import PinholeCamera, nose_camera_pose
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.render import BACKENDS, Frame, render, require_pose

__all__ = ["BACKENDS", "Frame", "GaussianScene", "PinholeCamera", "nose_camera_pose", "render", "require_pose"]
