"""bridge: ROS, simulated boards, the firmware's build, and flights through the trainer port."""

from falconwing_kit.tools.bridge.python_board import PythonBoard

__all__ = [
    "PythonBoard",
]
