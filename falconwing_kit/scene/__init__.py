"""scene: Gaussian scenes, their files, and the camera that looks at them."""

from falconwing_kit.scene.camera import PinholeCamera, nose_camera_pose
from falconwing_kit.scene.gaussians import GaussianScene

__all__ = ["GaussianScene", "PinholeCamera", "nose_camera_pose"]
