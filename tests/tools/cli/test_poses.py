"""falconwing poses: folders and logs of drawn video -> flight tables, and sentences for what cannot
be read.
"""

import csv
import json

import cv2
import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_log import FlightLogWriter
from falconwing_kit.core.flight_table import read_flight_table
from falconwing_kit.core.messages import Command, Image
from falconwing_kit.tools.cli.poses import Poses, read_video, scaled_camera
from tests.vision.drawn_marker import CAMERA, pose, view

COUNT = 24
COMMAND = (0.4, 0.1, -0.2, 0.05)


@pytest.fixture(scope="module")
def jpegs():
    """Straight at 8 m/s towards the marker from 13 m, 1 m left of it, drawn and compressed."""
    rng = np.random.default_rng(3)
    images = [view(pose(-13.0 + 0.4 * k, 1.0, 1.5, 0.0, 2.0, 4.0), rng) for k in range(COUNT)]
    return [
        cv2.imencode(".jpg", image[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, 95))[1].ravel()
        for image in images
    ]


@pytest.fixture
def folder(tmp_path, jpegs):
    """A flight as the hall's: commands.csv and frames."""
    place = tmp_path / "flight"
    place.mkdir()
    with (place / "commands.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(("t", "frame", "throttle", "aileron", "elevator", "rudder"))
        for k, data in enumerate(jpegs):
            (place / f"{k:03d}.jpg").write_bytes(data.tobytes())
            table.writerow((0.05 * k, f"{k:03d}.jpg", *COMMAND))
    return place


def test_a_folder_becomes_a_flight_table(folder, tmp_path, capsys):
    """The drawing's own places: the body is 0.20 m behind the camera; 8 m/s along x. 24 frames are
    less than the 3 s that an identification wants, so the answer is no.
    """
    out = tmp_path / "flight.csv"
    assert Poses(folder, out=out, json=True).run() == 1
    record, table = json.loads(capsys.readouterr().out), read_flight_table(out)
    seen = table.has_pose
    assert record["with_pose"] == seen.sum() >= 15
    assert table.p_world[seen, 0] == pytest.approx(
        -13.2 + 8.0 * table.t[seen], abs=0.4
    )  # three sigma when far out
    assert table.p_world[seen, 1] == pytest.approx(1.0, abs=0.4)
    assert np.median(table.extra["vx"][seen]) == pytest.approx(8.0, abs=0.5)
    assert table.commands == pytest.approx(np.tile(COMMAND, (COUNT, 1)))
    assert set(table.labels["source"]) <= {"marker", "bridged", "none"}


def test_a_flight_log_gives_the_same_frames(jpegs, tmp_path):
    """The same bytes by the other way."""
    path = tmp_path / "flight.mcap"
    with FlightLogWriter(path) as log:
        for k, data in enumerate(jpegs):
            image = Image(k, 0.05 * k, data)
            log.image(image)
            log.command(0.05 * k, Command(*COMMAND), image)
    video = read_video(path)
    assert len(video.t) == COUNT
    expected = cv2.cvtColor(cv2.imdecode(jpegs[5], cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    assert (video.image(5) == expected).all()
    assert video.commands[5] == pytest.approx(COMMAND)


def test_measured_poses_are_written_where_asked_for(folder, tmp_path, capsys):
    """Each frame's own pose has no velocity columns."""
    Poses(folder, out=tmp_path / "raw.csv", measured=True).run()
    assert "vx" not in read_flight_table(tmp_path / "raw.csv").extra
    assert "next: falconwing identify" in capsys.readouterr().out


def test_a_frame_that_is_gone_is_a_row_without_image(folder):
    """One deleted, one cut in half."""
    (folder / "003.jpg").unlink()
    (folder / "004.jpg").write_bytes(b"not a picture")
    video = read_video(folder)
    assert video.image(3) is None
    assert video.image(4) is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t,frame,throttle\n0,000.jpg,1\n", "columns t, frame"),
        ("t,frame,throttle,aileron,elevator,rudder\n0,000.jpg,1,2,3\n", "a number in every cell"),
        (
            "t,frame,throttle,aileron,elevator,rudder\n0,a.jpg,0,0,0,0\n0,b.jpg,0,0,0,0\n",
            "increasing time",
        ),
        (
            "t,frame,throttle,aileron,elevator,rudder\n0,../a.jpg,0,0,0,0\n1,b.jpg,0,0,0,0\n",
            "in the folder",
        ),
    ],
)
def test_commands_that_cannot_be_used_are_refused(tmp_path, text, words):
    """One sentence each, with the file's name."""
    (tmp_path / "commands.csv").write_text(text)
    with pytest.raises(InputError, match=words):
        read_video(tmp_path)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"marker": "7"}, "--marker: expected dictionary,id,size"),
        ({"marker_place": "0,0"}, "--marker-place: expected 3 numbers"),
        ({"room": "1,2,x,4,5,6"}, "--room: expected 6 numbers"),
    ],
)
def test_options_that_make_no_sense_are_refused(folder, options, words):
    """Before the video is looked at."""
    with pytest.raises(InputError, match=words):
        Poses(folder, **options).run()


def test_nothing_there_is_said(tmp_path):
    """Neither a folder with commands nor a log."""
    with pytest.raises(FileNotFoundError, match=r"commands\.csv"):
        read_video(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"flight\.mcap"):
        read_video(tmp_path / "flight.mcap")


def test_a_lens_is_scaled_to_the_frames():
    """Twice the width, twice every number; another shape shows something else."""
    large = scaled_camera(CAMERA, 640, 480)
    assert (large.fx, large.cx, large.cy) == (396.8, 320.0, 240.0)
    with pytest.raises(InputError, match="shape"):
        scaled_camera(CAMERA, 640, 360)
