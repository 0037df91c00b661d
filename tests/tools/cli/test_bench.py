"""`falconwing bench` with a simulated bench of known truth, and what takes its file: fly, record,
poses, scene poses.
"""

import json
import tomllib
from dataclasses import replace
from datetime import date

import cv2
import numpy as np
import pytest

from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.config import write_toml
from falconwing_kit.core.flight_log import FlightLogWriter, read_flight_log
from falconwing_kit.core.messages import Command, Image
from falconwing_kit.tools.cli.fly import Fly
from falconwing_kit.tools.cli.fly_aircraft import _limits
from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.cli.poses import Poses, read_video
from falconwing_kit.tools.cli.scene_photos import undistort_photos
from falconwing_kit.tools.devices.calibration import BenchCalibration, read_bench
from falconwing_kit.tools.devices.latency import LatencyFit
from falconwing_kit.tools.devices.lens import LensFit
from falconwing_kit.tools.devices.simulated_bench import LENS, BenchTruth, draw_checkerboard
from falconwing_kit.tools.hardware import bench_record
from falconwing_kit.trainer_port.ppm import load_calibration

TRUTH = BenchTruth()
LATENCY = LatencyFit(0.0717, 0.001, 0.01, 0.0017, 0.07, 0.02, 0.09, 60)
MEASURED = BenchCalibration(
    "2026-03-01", False, "0", "board", lens=LensFit(LENS, 20, 0.1, 0.001), latency=LATENCY
)


@pytest.fixture(autouse=True)
def in_empty_folder(tmp_path, monkeypatch):
    """Files land here."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def file(tmp_path):
    """A file of a real bench."""
    write_toml(tmp_path / "bench.toml", MEASURED)
    return tmp_path / "bench.toml"


def test_the_simulated_bench_is_measured_as_it_is(capsys):
    """Truth: BenchTruth. Delay to 2 ms (to the pulse by hand: 1.4 ms of wire, 11 of half a frame,
    5.5 of channels), focal lengths to 0.5 %, rate to 0.1 Hz, jitter to a fifth, frame to 15 us. The
    file holds the same and says that it is simulated; a real aircraft refuses it.
    """
    assert main(["bench", "--port", "sim-python", "--camera", "sim", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["latency"]["camera_s"] == pytest.approx(TRUTH.camera_s, abs=0.002)
    pulse_s = 0.0014 + 0.011 + 0.0055
    assert found["latency"]["camera_to_pulse_s"] == pytest.approx(
        TRUTH.camera_s + pulse_s, abs=0.002
    )
    lens = found["lens"]["lens"]
    assert lens["fx_px"] == pytest.approx(LENS.fx_px, rel=0.005)
    assert lens["fy_px"] == pytest.approx(LENS.fy_px, rel=0.005)
    assert lens["k1"] == pytest.approx(LENS.k1, abs=0.03)
    assert found["frames"]["rate_hz"] == pytest.approx(TRUTH.rate_hz, abs=0.1)
    assert found["frames"]["jitter_s"] == pytest.approx(TRUTH.jitter_s, rel=0.2)
    assert found["ppm"]["frame_us"] == pytest.approx(22000.0, abs=15.0)
    with open("bench.toml", "rb") as opened:
        assert tomllib.load(opened)["latency"] == found["latency"]
    measured = read_bench("bench.toml")
    assert measured.simulated and measured.measured == date.today().isoformat()
    with pytest.raises(InputError, match="got a SIMULATED bench"):
        read_bench("bench.toml", for_aircraft=True)


def test_a_lens_alone_needs_no_board(tmp_path, capsys):
    """Photos of a checkerboard in a folder, as a phone or the camera itself took them."""
    (tmp_path / "photos").mkdir()
    for view in range(12):
        cv2.imwrite(str(tmp_path / "photos" / f"{view:02d}.png"), draw_checkerboard(LENS, view))
    words = ["bench", "--camera", "sim", "--photos", "photos", "--views", "12"]
    assert main([*words, "--out", "lens.toml"]) == 0
    assert "SIMULATED" in capsys.readouterr().out
    found = read_bench("lens.toml")
    assert found.latency is None and found.ppm is None and found.lens.views >= 10
    assert found.lens.lens.fx_px == pytest.approx(LENS.fx_px, rel=0.005)
    assert found.with_delay(rates_model()).values == rates_model().values
    assert main([*words, "--out", "lens.toml"]) == 2
    assert "--replace" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--port", "sim", "--camera", "0"], "both SIMULATED or neither"),
        (["--port", "COM3", "--camera", "sim"], "both SIMULATED or neither"),
        (["--camera", "sim", "--checkerboard", "9"], "--checkerboard: expected"),
        (["--camera", "sim", "--views", "3"], "--views: expected"),
        (["--camera", "sim", "--cycles", "3"], "--cycles: expected"),
        (["--camera", "sim", "--photos", "nowhere"], "--photos nowhere: expected a folder"),
        (["--camera", "nowhere.avi"], "nowhere.avi"),
        (["--camera", "sim", "--out", "no/folder.toml"], "expected a folder"),
    ],
)
def test_wrong_use_is_one_sentence(words, sentence, capsys):
    """Exit 2, nothing written."""
    assert main(["bench", *words]) == 2
    said = capsys.readouterr().err.splitlines()
    assert sentence in said[-1]


def test_the_simulator_flies_the_measured_camera_and_delay(file):
    """By hand: 90 ms measured where the world has 50, through a simulated port too: 40 ms more than
    the aircraft's own 20. The camera is the lens's at the size of the images.
    """
    assert Fly(bench=file)._task().model.values["delay"] == pytest.approx(0.06)
    assert Fly(bench=file, port="sim")._task().model.values["delay"] == pytest.approx(0.06)
    assert Fly()._task().model.values["delay"] == pytest.approx(0.02)
    camera = Fly(bench=file, size="160x120")._setting().camera
    assert (camera.fx, camera.cy, camera.width) == pytest.approx((102.5, 58.5, 160))
    with pytest.raises(InputError, match="of the shape of 320 x 240"):
        Fly(bench=file, size="320x200")._setting()


def test_a_flight_with_the_measured_delay_is_another_flight(file, capsys):
    """The same start; the expert lands with 40 ms more delay, elsewhere."""
    words = ["fly", "--headless", "--no-render", "--seed", "500", "--json"]
    assert main(words) == 0
    plain = json.loads(capsys.readouterr().out)
    assert main([*words, "--bench", str(file)]) == 0
    late = json.loads(capsys.readouterr().out)
    assert late["successes"] == 1 and late["ald_m"]["mean"] != plain["ald_m"]["mean"]


def test_the_cameras_delay_counts_towards_the_age_of_an_image():
    """An image is 70 ms old when it arrives, so it may be 330 ms old by its arrival, of 400."""
    assert _limits(Fly(), MEASURED).max_image_age_s == pytest.approx(0.33)
    assert _limits(Fly(), None).max_image_age_s == 0.4


def test_a_real_aircraft_refuses_a_simulated_bench(tmp_path, monkeypatch, capsys):
    """Behind a passed bench test; no port is opened."""
    radio = replace(load_calibration(), radio="NX8", measured=date.today().isoformat())
    write_toml("trainer_port.toml", radio)
    write_toml("simulated.toml", replace(MEASURED, simulated=True))
    monkeypatch.setattr(bench_record, "require_bench_test", lambda *given: tmp_path)
    words = ["fly", "--port", "COM3", "--source", "camera", "--pilot", "pose"]
    assert main([*words, "--bench", "simulated.toml"]) == 2
    assert "got a SIMULATED bench" in capsys.readouterr().err
    assert main(["record", "--port", "COM3", "--bench", "simulated.toml"]) == 2
    assert "got a SIMULATED bench" in capsys.readouterr().err


def test_delays_that_cannot_be_simulated_are_refused():
    """Shorter than what the world has at least; a negative one is no measurement."""
    short = replace(MEASURED, latency=replace(LATENCY, camera_to_pulse_s=0.02))
    with pytest.raises(InputError, match=r"latency: expected 0\.03 s or more"):
        short.with_delay(rates_model())
    with pytest.raises(InputError, match=r"latency\.camera_s"):
        replace(MEASURED, latency=replace(LATENCY, camera_s=-0.01))


def write_log(path, pixels, metadata):
    with FlightLogWriter(path) as log:
        log.metadata(metadata)
        for k in range(3):
            log.command(0.05 * k, Command(0.1, 0, 0, 0, k), Image(k, 0.05 * k, pixels))
    return path


def test_poses_undistorts_once(file, tmp_path):
    """A log of raw images is undistorted; one that says that it was recorded so is left alone."""
    pixels = np.repeat(draw_checkerboard(LENS, 2)[..., None], 3, axis=2)
    straight = LENS.undistort(pixels)
    raw = write_log(tmp_path / "raw.mcap", pixels, {"undistorted": "no"})
    done = write_log(tmp_path / "done.mcap", straight, {"undistorted": "yes"})
    for path in (raw, done):
        seen = read_video(path, LENS).image(1)
        assert np.abs(seen.astype(int) - straight).mean() < 3.0  # JPEG
    assert np.abs(read_video(raw).image(1).astype(int) - straight).mean() > 10.0
    camera = Poses(raw, bench=file)._camera(read_video(raw), LENS)
    assert camera == LENS.camera()
    with pytest.raises(InputError, match="--bench: expected it without --camera"):
        Poses(raw, bench=file, camera=file)._lens()


def test_a_recording_is_undistorted_at_the_source(file, tmp_path, capsys):
    """A video of a bent checkerboard as camera; the log's images are straight, and it says so."""
    bent = draw_checkerboard(LENS, 2)
    writer = cv2.VideoWriter("bent.avi", cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (320, 240))
    for k in range(30):
        writer.write(np.repeat(np.roll(bent, k % 2, axis=1)[..., None], 3, axis=2))
    writer.release()
    words = ["--port", "sim-python", "--camera", "bent.avi", "--bench", str(file)]
    assert main(["record", *words, "--seconds", "1", "--json"]) == 0
    log = read_flight_log(json.loads(capsys.readouterr().out)["file"])
    assert log.metadata["undistorted"] == "yes"
    assert json.loads(log.metadata["camera"])["fx"] == LENS.fx_px
    image = cv2.imdecode(next(iter(log.images())).pixels, cv2.IMREAD_GRAYSCALE).astype(int)
    errors = [np.abs(image - LENS.undistort(np.roll(bent, k, axis=1))).mean() for k in (0, 1)]
    assert min(errors) < 4.0 < np.abs(image - bent).mean()


def test_photos_are_undistorted_before_their_poses_are_estimated(tmp_path):
    """The files of a folder under their own names; those of another shape are refused."""
    (tmp_path / "photos").mkdir()
    for view in range(3):
        drawn = draw_checkerboard(LENS, view)
        cv2.imwrite(str(tmp_path / "photos" / f"{view}.png"), drawn)
    folder = undistort_photos(tmp_path / "photos", LENS, tmp_path / "out")
    assert sorted(path.name for path in folder.iterdir()) == ["0.png", "1.png", "2.png"]
    seen = cv2.imread(str(folder / "2.png"), cv2.IMREAD_GRAYSCALE)
    assert np.array_equal(seen, LENS.undistort(draw_checkerboard(LENS, 2)))
    with pytest.raises(InputError, match="of the shape of"):
        undistort_photos(tmp_path / "photos", replace(LENS, height_px=180), tmp_path / "other")
