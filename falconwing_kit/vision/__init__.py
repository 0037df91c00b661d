"""vision: whether live pictures can be flown by, and where they come from.

from falconwing_kit.vision import FrameMonitor
verdict = FrameMonitor().update(image, t)      # .ssim, .alert, .reason
"""

from falconwing_kit.vision.monitor import FrameMonitor, MonitorSettings, Verdict, load_monitor_settings
from falconwing_kit.vision.ssim import ssim, ssim_map

__all__ = ["FrameMonitor", "MonitorSettings", "Verdict", "load_monitor_settings", "ssim", "ssim_map"]
