"""Cameras: the fake one does what its script says, counted by the numbers in its pictures; a file
keeps its rate.
"""

import cv2
import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Image
from falconwing_kit.scene.analog import AnalogVideo
from falconwing_kit.tools.devices.cameras import (
    CameraFault,
    FakeCamera,
    SimulatedCamera,
    VideoCamera,
    VideoFile,
    open_camera,
)
from tests.tools.devices.frame_number import read_frame_number


class Time:
    """A clock that only sleeping moves."""

    def __init__(self) -> None:
        self.t = 100.0

    def now(self) -> float:
        return self.t

    def sleep(self, seconds: float) -> None:
        assert seconds > 0.0
        self.t += seconds


@pytest.fixture
def clock() -> Time:
    return Time()


def fake(clock: Time, *faults: CameraFault) -> FakeCamera:
    camera = FakeCamera(faults, now=clock.now, sleep=clock.sleep)
    camera.open()
    return camera


@pytest.mark.parametrize("number", [0, 1, 2, 0x5555, 0xAAAA, 65535])
@pytest.mark.parametrize("size", [(64, 48), (320, 240), (500, 300)])
def test_number_is_read_back(number, size):
    """What goes into the bar code comes out, also through a JPEG and through an analog link of 14
    dB.
    """
    picture = FakeCamera(size=size).picture(number)
    assert read_frame_number(picture) == number
    assert (
        read_frame_number(cv2.imdecode(cv2.imencode(".jpg", picture)[1], cv2.IMREAD_COLOR))
        == number
    )
    if size[0] >= 320:
        assert read_frame_number(AnalogVideo(14.0, dropouts=0.0).apply(picture, 0)) == number


def test_scene_moves_by_three_pixels_a_frame():
    """Frame k + 1, moved back by three, is frame k, away from the bar code."""
    camera = FakeCamera()
    first, second = camera.picture(10)[60:], camera.picture(11)[60:]
    assert (second[:, :-3] == first[:, 3:]).all()
    assert first.std() > 20.0


def test_frames_come_when_they_are_due(clock):
    """20 Hz: at 100.00, 100.05, ... by this clock."""
    camera, times, numbers = fake(clock), [], []
    for _ in range(5):
        numbers.append(read_frame_number(camera.read()))
        times.append(clock.t)
    assert numbers == [0, 1, 2, 3, 4]
    assert times == pytest.approx([100.0, 100.05, 100.10, 100.15, 100.20])


def test_a_slow_reader_misses_frames(clock):
    """A camera holds one frame: who comes 0.12 s later gets the newest, number 2 of 0, 1, 2."""
    camera = fake(clock)
    assert read_frame_number(camera.read()) == 0
    clock.t += 0.12
    assert read_frame_number(camera.read()) == 2


def test_every_fault_does_what_it_says(clock):
    """By hand from the script, at 20 Hz."""
    camera = fake(
        clock, CameraFault("freeze", 0.1, 0.2), CameraFault("drop", 0.3, 0.4),
        CameraFault("delay", 0.5, 0.55, 0.07),
        CameraFault("hang", 0.7, 1.0), CameraFault("unplug", 1.1, 1.3),
    )  # fmt: skip
    seen = []
    while (picture := camera.read()) is not None:
        seen.append((round(clock.t - 100.0, 3), read_frame_number(picture)))
    assert seen == [
        (0.0, 0), (0.05, 1), (0.1, 1), (0.15, 1), (0.2, 4), (0.25, 5),  # frozen at 1
        (0.4, 8), (0.45, 9),  # 6 and 7 dropped
        (0.57, 10), (0.57, 11), (0.6, 12), (0.65, 13),  # 10 is late by 0.07
        (1.0, 20), (1.05, 21),  # 14 hung
    ]  # fmt: skip
    with pytest.raises(OSError, match="unplugged"):
        camera.open()
    clock.t = 101.31
    camera.open()
    assert read_frame_number(camera.read()) == 26


def test_noise_has_its_snr(clock):
    """Against the same picture without, below the bar code, where luma would be cut: 255 /
    10^(20/20) = 25.5.
    """
    camera = fake(clock, CameraFault("noise", 0.0, 1.0, 20.0))
    off = camera.read().astype(float) - camera.picture(0)
    rows = off[60:] @ (0.299, 0.587, 0.114)
    assert 1.4826 * np.median(np.abs(rows)) == pytest.approx(25.5, rel=0.1)


def test_a_video_file_comes_at_its_own_rate(tmp_path, clock):
    """Twelve frames at 25 Hz, written by OpenCV: 0.00, 0.04, ... then the end."""
    writer = cv2.VideoWriter(
        str(tmp_path / "flight.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (320, 240)
    )
    for number in range(12):
        writer.write(FakeCamera().picture(number)[..., ::-1])
    writer.release()
    video = VideoFile(tmp_path / "flight.avi", now=clock.now, sleep=clock.sleep)
    video.open()
    seen = [(read_frame_number(video.read()), round(clock.t - 100.0, 6)) for _ in range(12)]
    assert seen == [(k, round(0.04 * k, 6)) for k in range(12)]
    with pytest.raises(EOFError, match="over"):
        video.read()
    video.close()


def test_colours_of_a_video_are_red_green_blue(tmp_path, clock):
    """A red picture: OpenCV reads the other order. MJPEG keeps a flat colour to a few levels."""
    writer = cv2.VideoWriter(
        str(tmp_path / "red.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (64, 48)
    )
    writer.write(np.full((48, 64, 3), (30, 60, 220), np.uint8))
    writer.release()
    video = VideoFile(tmp_path / "red.avi", now=clock.now, sleep=clock.sleep)
    video.open()
    assert video.read()[24, 32] == pytest.approx([220, 60, 30], abs=6)


def test_a_simulator_is_asked_at_the_cameras_rate(clock):
    """10 Hz: 0.0, 0.1, 0.2; pixels pass unchanged; a source without an image gives none."""

    class Source:
        def __init__(self) -> None:
            self.asked: list[float] = []

        def next_image(self, t: float) -> Image | None:
            self.asked.append(t)
            return Image(len(self.asked), t, np.full((8, 8, 3), 7, np.uint8)) if t < 0.15 else None

    source = Source()
    camera = SimulatedCamera(source, 10.0, clock.now, clock.sleep)
    camera.open()
    assert [camera.read() is None for _ in range(3)] == [False, False, True]
    assert source.asked == pytest.approx([0.0, 0.1, 0.2])
    assert clock.t == pytest.approx(100.2)


def test_what_is_not_there_is_refused(tmp_path):
    """A device that no machine has, no file, a file that is no video, a script that ends before it
    begins.
    """
    with pytest.raises(OSError, match="plugged in"):
        VideoCamera(987).open()
    with pytest.raises(FileNotFoundError):
        open_camera(str(tmp_path / "none.avi"))
    (tmp_path / "text.avi").write_text("no video", encoding="utf-8")
    with pytest.raises(InputError, match="expected a video"):
        open_camera(str(tmp_path / "text.avi"))
    with pytest.raises(InputError, match="end"):
        CameraFault("drop", 2.0, 1.0)
    assert open_camera("3").device == 3
