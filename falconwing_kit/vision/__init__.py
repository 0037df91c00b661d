"""vision: images -> whether they are fit for flying, and poses of the camera and its flight.

    from falconwing_kit.vision import FrameMonitor
    verdict = FrameMonitor().update(image, t)

gives `verdict.ssim`, `verdict.alert` and `verdict.reason`.
"""

from falconwing_kit.vision.hybrid_state import HybridFlight, HybridSettings, Video, estimate_flight
from falconwing_kit.vision.marker import Marker, MarkerPose, find_marker
from falconwing_kit.vision.monitor import (
    FrameMonitor,
    FrameVerdict,
    MonitorSettings,
    load_monitor_settings,
)
from falconwing_kit.vision.pose_net import PoseEstimate, PoseNet
from falconwing_kit.vision.refine import RefinedPose, refine_pose, track_scene
from falconwing_kit.vision.smoother import Motion, SmoothedTrajectory, smooth
from falconwing_kit.vision.ssim import ssim, ssim_map

__all__ = [
    "FrameMonitor",
    "FrameVerdict",
    "HybridFlight",
    "HybridSettings",
    "Marker",
    "MarkerPose",
    "MonitorSettings",
    "Motion",
    "PoseEstimate",
    "PoseNet",
    "RefinedPose",
    "SmoothedTrajectory",
    "Video",
    "estimate_flight",
    "find_marker",
    "load_monitor_settings",
    "refine_pose",
    "smooth",
    "ssim",
    "ssim_map",
    "track_scene",
]
