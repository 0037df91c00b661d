"""Parts that need Linux: what to do about them -> a sentence with the way out on any system."""

import platform
import sys

from falconwing_kit.core.checks import InputError


def linux_advice(advice: str) -> str:
    """The advice on Linux; elsewhere how to get a Linux first.

    Args:
        advice: what to do on Linux, such as "apt install bubblewrap".
    """
    if sys.platform == "linux":
        return advice
    if sys.platform == "win32":
        return (
            "needs Linux: type wsl --install in a terminal, restart, install the kit in WSL 2 as "
            f"on Linux, and there {advice}"
        )
    return f"needs Linux: install the kit on a Linux machine, a virtual one too, and there {advice}"


def require_linux(name: str, advice: str) -> None:
    """Raise InputError on other systems.

    Args:
        name: the part that needs it.
        advice: what to do on Linux.
    """
    if sys.platform != "linux":
        raise InputError(f"{name}: expected Linux, got {platform.system()}; {linux_advice(advice)}")
