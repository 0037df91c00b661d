"""From an image on a ROS topic to pulses on the pin, in real time: what a flight of the board
through ROS would see.

Image -> ROS -> a controller in a process of its own -> ROS -> relay -> pyserial -> pseudo-terminal
-> the real firmware in a simulated ATmega2560 -> PPM. The board is simulated, the clock is the
wall's.
"""

import math
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.core.messages import Image
from falconwing_kit.tools.bridge.bus import IMAGE, STATUS, relay
from falconwing_kit.tools.bridge.open_port import open_port
from falconwing_kit.tools.bridge.ros import RosBus
from falconwing_kit.trainer_port.ppm import load_calibration
from tests.firmware.chip import require_tools

ROOT = Path(__file__).resolve().parents[2]
IMAGES, PERIOD = 300, 0.05
CODES = 200  # images are distinguished by positions of one control, 1 us apart
LIMIT_MS, ATTEMPTS = 40.0, 3
# The most trivial pilot: the rudder says which image it answers; image 0 hands the sticks back, all
# others engage.
CONTROLLER = f"""
import time
from falconwing_kit.core.messages import Command
from falconwing_kit.tools.bridge.bus import COMMAND, IMAGE, StampedCommand
from falconwing_kit.tools.bridge.ros import RosBus
bus = RosBus("controller")
while bus.listeners(COMMAND) == 0: time.sleep(0.01)
images = bus.subscribe(IMAGE)
while True:
    image = images.take(1.0)
    if image is not None:
        command = Command(0.0, 0.0, 0.0, (image.sequence % {CODES}) / 500, image.sequence)
        message = StampedCommand(time.time(), command, engage=image.sequence > 0)
        bus.publish(COMMAND, message)
"""


@pytest.fixture(scope="module")
def bridge(ros_master):
    """A simulated board with a port on its pseudo-terminal, a relay, a ROS bus, and the
    controller's process.
    """
    require_tools()
    bus, port, ended = RosBus("camera"), open_port("sim"), threading.Event()
    port.wait_ready()
    relaying = threading.Thread(target=relay, args=(port, bus, ended.is_set))
    relaying.start()
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [sys.executable, "-c", CONTROLLER], cwd=ROOT, env=environment
    ) as controller:
        yield bus, port
        controller.kill()
    ended.set()
    relaying.join()
    port.close()
    port.simulation.close()
    bus.close()


def test_image_to_pulses_takes_40_ms_at_most(bridge):
    """95 of 100 images are answered on the pin within 40 ms, first edge to last slot included; 40
    is the requirement.

    By the frame: 1.4 ms of serial line, 0 to 22 ms until the next frame begins, 5 to 8 ms until its
    last slot is complete, so about 27 ms at the 95th percentile; the rest is ROS. A lost image
    counts as infinite. Other programs on the machine can only increase the measured times: one of
    three attempts must keep the limit. All are printed.
    """
    bus, port = bridge
    for attempt in range(ATTEMPTS):
        await_engaged(bus, port)
        to_edge, to_last_slot, lag = measure(bus, port.simulation)
        print(
            f"\nattempt {attempt + 1}: load {os.getloadavg()[0]:.1f}, "
            f"chip up to {lag:.0f} ms behind the clock"
        )
        for what, ms in (
            ("first edge of its frame", to_edge),
            ("last slot complete", to_last_slot),
        ):
            median, p95, worst = np.percentile(ms, (50, 95, 100), method="higher")
            print(f"image -> {what}: median {median:.1f}, p95 {p95:.1f}, max {worst:.1f} ms")
        if p95 <= LIMIT_MS:
            break
    assert p95 <= LIMIT_MS
    assert port.engagement == "engaged"


def test_when_images_stop_the_board_goes_safe_and_says_so_on_ros(bridge):
    """Nothing on the way repeats a command: the board is LOST, idle with the others in the middle,
    and reports it.
    """
    bus, port = bridge
    await_engaged(bus, port)
    reports = bus.subscribe(STATUS)
    end = time.monotonic() + 30.0
    while (report := reports.take(1.0)) is None or report.status.state != "LOST":
        assert time.monotonic() < end, (report, port.status)
    assert (
        report.status.channels_us == (1000, 1500, 1500, 1500) and abs(report.t - time.time()) < 30.0
    )
    assert port.engagement == "dropped"


def await_engaged(bus, port):
    """Publish images until the board follows the controller."""
    end, sequence = time.monotonic() + 30.0, 0
    while port.engagement != "engaged":
        assert time.monotonic() < end, (port.state, port.engagement, port.status)
        sequence = 0 if port.engagement == "dropped" else sequence + 1
        publish(bus, sequence)
        time.sleep(PERIOD)


def publish(bus, sequence):
    """An image of 30 kB with the present time; the time."""
    t = time.time()
    bus.publish(IMAGE, Image(sequence, t, np.frombuffer(b"\xff\xd8" + bytes(30_000), np.uint8)))
    return t


def measure(bus, board):
    """Publish images at 20 Hz; (N,) ms from each to the first edge and to the last slot of its
    first frame, and the simulator's worst lag [ms].
    """
    wall = time.time() - time.perf_counter()
    board.ppm_frames()
    board.worst_lag, begin, stamps = 0.0, time.perf_counter(), []
    for k in range(IMAGES + 10):  # the last ones only keep the board awake while the answers come
        time.sleep(max(begin + k * PERIOD - time.perf_counter(), 0.0))
        stamps.append(publish(bus, k + 1))
    frames = board.ppm_frames()
    rudder = load_calibration().rudder
    positions = [rudder.to_position(frame.slots_us[rudder.channel - 1]) for frame in frames]
    codes = np.round(500 * np.array(positions)).astype(int)
    edges = np.array([board.to_host_time(frame.t_start) for frame in frames]) + wall
    lasts = np.array([board.to_host_time(frame.t_slots[-1]) for frame in frames]) + wall
    first = [first_frame(codes, edges, k % CODES, t) for k, t in enumerate(stamps[:IMAGES], 1)]
    to_edge, to_last_slot = (
        1e3
        * np.array(
            [math.inf if n is None else at[n] - t for n, t in zip(first, stamps, strict=False)]
        )
        for at in (edges, lasts)
    )
    return to_edge, to_last_slot, 1e3 * board.worst_lag


def first_frame(codes, edges, code, t):
    """Index of the first frame after an image with its code, within what the codes can tell apart;
    None if none.
    """
    found = np.flatnonzero((codes == code) & (edges >= t) & (edges < t + 0.5 * CODES * PERIOD))
    return int(found[0]) if len(found) else None
