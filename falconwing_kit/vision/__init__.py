"""vision: where live pictures come from, whether they can be flown by, and where they were taken.

from falconwing_kit.vision import FrameMonitor
verdict = FrameMonitor().update(image, t)      # .ssim, .alert, .reason
"""

from falconwing_kit.vision.cameras import FakeCamera, Fault, SimulatedCamera, VideoCamera, VideoFile, open_camera
from falconwing_kit.vision.grabber import Camera, Grabber, Health
from falconwing_kit.vision.monitor import FrameMonitor, MonitorSettings, Verdict, load_monitor_settings
from falconwing_kit.vision.pose_net import PoseEstimate, PoseNet
from falconwing_kit.vision.ssim import ssim, ssim_map

__all__ = [
    "Camera",
    "FakeCamera",
    "Fault",
    "FrameMonitor",
    "Grabber",
    "Health",
    "MonitorSettings",
    "PoseEstimate",
    "PoseNet",
    "SimulatedCamera",
    "Verdict",
    "VideoCamera",
    "VideoFile",
    "load_monitor_settings",
    "open_camera",
    "ssim",
    "ssim_map",
]
