"""A ROS master for tests: on a free port, with its own folder, ended with the tests."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

PACKAGES = "python3-roslaunch rosout python3-rospy python3-sensor-msgs python3-diagnostic-msgs"
NAMES = ("ROS_MASTER_URI", "ROS_HOME", "ROS_IP")
START_S = 60.0


@contextmanager
def running_master(folder: Path) -> Iterator[str]:
    """Start `roscore` and let this process and its children find it; where there is none the test
    is skipped.

    With CI set it fails instead, for there nothing may be skipped.

    Yields:
        Its address.
    """
    if shutil.which("roscore") is None:
        (pytest.fail if os.environ.get("CI") else pytest.skip)(
            f"expected a real roscore: `apt install {PACKAGES}`"
        )
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    uri, saved, path = (
        f"http://127.0.0.1:{port}",
        {name: os.environ.get(name) for name in NAMES},
        list(sys.path),
    )
    os.environ.update({"ROS_MASTER_URI": uri, "ROS_HOME": str(folder), "ROS_IP": "127.0.0.1"})
    # The system's own tools first, for a virtual environment may hold a rosversion that knows
    # nothing of them; and what roscore says is to reach the file at once.
    system = {**os.environ, "PATH": f"/usr/bin:{os.environ['PATH']}", "PYTHONUNBUFFERED": "1"}
    with (folder / "roscore.txt").open("wb") as output:
        core = subprocess.Popen(
            ["roscore", "-p", str(port)],
            stdout=output,
            stderr=output,
            start_new_session=True,
            env=system,
        )
        try:
            await_rosout(core, folder / "roscore.txt")
            yield uri
        finally:
            core.send_signal(signal.SIGINT)  # it ends its own children then
            core.wait(START_S)
            sys.path[:] = path
            for name, value in saved.items():
                os.environ.pop(name) if value is None else os.environ.__setitem__(name, value)


def await_rosout(core: subprocess.Popen, output: Path) -> None:
    """Wait until the last part of roscore has started."""
    end = time.monotonic() + START_S
    while "started core service [/rosout]" not in output.read_text():
        assert core.poll() is None and time.monotonic() < end, output.read_text()
        time.sleep(0.05)
