"""Grabber: in virtual time, with a fake camera whose pictures carry their number. Every number here
is by hand.
"""

import threading

import numpy as np
import pytest

from falconwing_kit.core.messages import Command, Observation
from falconwing_kit.flight.loop import Loop
from falconwing_kit.tools.devices import grabber
from falconwing_kit.tools.devices.cameras import CameraFault, FakeCamera
from falconwing_kit.tools.devices.grabber import Grabber
from falconwing_kit.vision import FrameMonitor
from tests.tools.devices.frame_number import read_frame_number
from tests.vision.virtual_time import PATIENCE, VirtualTime


@pytest.fixture
def time():
    """Virtual time that lets every thread end after the test."""
    virtual = VirtualTime()
    yield virtual
    virtual.release()


@pytest.fixture
def running(time):
    """Starts a grabber over a scripted camera; stops it after the test."""
    started = []

    def start(*faults: CameraFault) -> Grabber:
        camera = FakeCamera(faults, now=time.now, sleep=time.sleep)
        started.append(Grabber(camera, stale_s=0.5, now=time.now, pause=time.sleep).start())
        return started[-1]

    yield start
    time.release()
    for each in started:
        assert each.stop()


def number(image) -> int | None:
    return None if image is None else read_frame_number(image.pixels)


def test_a_slow_consumer_gets_the_newest_and_counts_the_rest(running, time):
    """20 Hz, looked at every 0.15 s from 0.01 s on: frames 0, 3, 6, 9; two of three are replaced
    unseen.
    """
    camera = running()
    seen = []
    for k in range(4):
        time.advance(0.01 + 0.15 * k)
        image = camera.next_image(7.0 + time.now())  # the loop's clock reads 7 s more
        seen.append((number(image), image.sequence, round(image.t - 7.0, 6)))
    assert seen == [(0, 0, 0.0), (3, 3, 0.15), (6, 6, 0.3), (9, 9, 0.45)]
    assert (camera.health.received, camera.health.dropped) == (10, 6)
    assert camera.health.age == pytest.approx(0.01)


def test_the_same_image_comes_again_until_there_is_a_newer_one(running, time):
    """No copy, no new time: the very same record."""
    camera = running()
    time.advance(0.01)
    first = camera.next_image(0.01)
    time.advance(0.04)
    assert camera.next_image(0.04) is first
    time.advance(0.06)
    assert number(camera.next_image(0.06)) == 1
    assert camera.health.dropped == 0


def test_an_unplugged_camera_gives_none_and_comes_back(running, time):
    """Gone at 0.5 s, the newest is of 0.45 s: stale after 0.95 s. Opened at 0.6, 0.8, 1.2, 2.0 s;
    there at 2.0 s.
    """
    camera = running(CameraFault("unplug", 0.5, 1.9))
    time.advance(0.94)
    assert number(camera.next_image(0.94)) == 9
    time.advance(0.96)
    assert camera.next_image(0.96) is None
    assert not camera.health.alive
    assert "unplugged" in camera.health.trouble
    time.advance(1.99)
    assert camera.health.reconnects == 0
    time.advance(2.01)
    assert number(camera.next_image(2.01)) == 40
    assert camera.health.alive
    assert camera.health.reconnects == 1


def test_a_camera_that_hangs_in_a_read_does_not_keep_the_loop_waiting(running, time):
    """It hangs from 0.3 to 1.4 s; the newest is of 0.25 s. Health goes by its age."""
    camera = running(CameraFault("hang", 0.3, 1.4))
    time.advance(0.74)
    assert number(camera.next_image(0.74)) == 5
    time.advance(1.0)
    assert camera.next_image(1.0) is None
    assert camera.health.age == pytest.approx(0.75)
    time.advance(1.41)
    assert number(camera.next_image(1.41)) == 28
    assert camera.health.reconnects == 0


def test_late_frames_show_their_numbers(running, time):
    """Each is 0.12 s late from 0.2 s on: the newest is frame 3 at 0.31 s and frame 4 at 0.33 s."""
    camera = running(CameraFault("delay", 0.2, 0.25, 0.12))
    time.advance(0.31)
    assert number(camera.next_image(0.31)) == 3
    time.advance(0.33)
    assert (
        number(camera.next_image(0.33)) == 6
    )  # 4 came at 0.32, and the newest that had waited right after


class Angry:
    """A camera whose driver throws whatever it likes; the third time it works."""

    def __init__(self) -> None:
        self.opened = self.closed = 0

    def open(self) -> None:
        self.opened += 1
        if self.opened == 1:
            raise KeyError("driver")

    def read(self) -> np.ndarray:
        if self.opened == 2:
            raise ZeroDivisionError
        return np.zeros((48, 64, 3), np.uint8)

    def close(self) -> None:
        self.closed += 1


def test_whatever_a_driver_throws_it_is_opened_again():
    """Two failures, then frames; every opening was closed."""
    camera = Angry()
    with Grabber(camera, pause=lambda seconds: None) as grabbed:
        assert grabbed.wait(3, PATIENCE)
        assert "ZeroDivisionError" in grabbed.health.trouble
        assert grabbed.health.reconnects >= 1
        assert grabbed.next_image(0.0).pixels.shape == (48, 64, 3)
    assert camera.opened == camera.closed == 3


def test_a_driver_that_throws_when_it_is_closed_is_opened_again():
    """Its device is gone, so letting go of it fails as well; twice, and then there are frames."""

    class Gone(Angry):
        def close(self) -> None:
            raise OSError("no such device")

    with Grabber(Gone(), pause=lambda seconds: None) as grabbed:
        assert grabbed.wait(3, PATIENCE)


class Short(Angry):
    """Three frames, then the end."""

    def open(self) -> None:
        self.opened += 1
        self.left = 3

    def read(self) -> np.ndarray:
        self.left -= 1
        if self.left < 0:
            raise EOFError
        return np.zeros((48, 64, 3), np.uint8)


def test_a_video_that_is_over_is_not_begun_again():
    """Three frames, opened once; the thread ends by itself."""
    camera = Short()
    grabbed = Grabber(camera).start()
    assert grabbed.wait(3, PATIENCE)
    assert not grabbed.wait(4, 0.05)
    assert grabbed.stop()
    assert camera.opened == 1


def test_stop_does_not_wait_for_ever(monkeypatch):
    """A read that never returns: stop says no, and the thread ends with the read."""
    monkeypatch.setattr(grabber, "STOP_WAIT", 0.05)
    released = threading.Event()

    class Stuck(Angry):
        def open(self) -> None:
            self.opened += 1

        def read(self) -> None:
            released.wait()

    grabbed = Grabber(Stuck()).start()
    assert not grabbed.stop()
    released.set()
    monkeypatch.setattr(grabber, "STOP_WAIT", PATIENCE)
    assert grabbed.stop()


def test_stop_before_start_and_none_before_the_first_frame():
    """Nothing has been read: no image, infinitely old, nothing to end."""
    grabbed = Grabber(FakeCamera())
    assert grabbed.next_image(0.0) is None
    assert grabbed.health.age == float("inf")
    assert not grabbed.health.alive
    assert grabbed.stop()


class Watcher:
    """A pilot that asks the monitor in every step."""

    def __init__(self) -> None:
        self.monitor, self.alerts = FrameMonitor(), []

    def act(self, observation: Observation) -> Command:
        verdict = self.monitor.update(observation.image, observation.t)
        if verdict.alert:
            self.alerts.append((round(observation.t, 3), verdict.reason.split(":")[0]))
        return Command(0.5, 0.0, 0.0, 0.0)


class Sink:
    def send(self, t: float, command: Command) -> None:
        pass


@pytest.mark.parametrize(
    ("fault", "reason"),
    [(CameraFault("freeze", 1.0, 9.0), "old or frozen"),
     (CameraFault("unplug", 1.0, 9.0), "old or frozen"),
     (CameraFault("hang", 1.0, 9.0), "old or frozen"),
     (CameraFault("noise", 1.0, 9.0, 14.0), "noise")],
)  # fmt: skip
def test_the_loop_flies_on_and_the_monitor_alerts_within_300_ms(running, time, fault, reason):
    """From the fault at 1.0 s to the first alert, in virtual time; 40 steps are flown without a
    failure.
    """
    pilot = Watcher()
    flight = Loop(pilot, Sink(), images=running(fault), clock=time).run(2.0)
    assert (flight.reason, flight.faults, len(flight.t)) == ("duration", 0, 40)
    first, why = pilot.alerts[0]
    assert why == reason
    assert 1.0 < first <= 1.3
