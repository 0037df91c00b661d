"""falconwing fly: exit codes, what is printed and written, and one sentence for what is not there
yet.
"""

import json
import re
import time
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.model import paper_model, rates_model, scale_model
from falconwing_kit.control.manoeuvres import MANOEUVRES
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_log import read_flight_log
from falconwing_kit.core.messages import Command
from falconwing_kit.flight.pilots import load_pilot
from falconwing_kit.flight.sources import decode_jpeg
from falconwing_kit.flight.tasks import TASKS, LandingTask
from falconwing_kit.scene import GaussianScene
from falconwing_kit.sysid.model_file import write_fitted_model
from falconwing_kit.sysid.uncertainty import Uncertainty
from falconwing_kit.tools.cli.fly import Fly
from falconwing_kit.tools.cli.main import main
from tests import clusters

QUICK = ("--headless", "--no-render")


class Dive:
    """A pilot that leaves everything alone: the aircraft comes down before the pad."""

    def act(self, observation) -> Command:
        return Command(0.0, 0.0, -1.0, 0.0)


def test_a_pilot_that_is_not_there_is_wrong_use(capsys):
    """Exit 2 and one sentence, before anything is flown."""
    assert main(["fly", "--pilot", "autopilot"]) == 2
    assert capsys.readouterr().err == (
        "falconwing: --pilot autopilot: expected one of expert, expert_pid, pose, student, rgb,"
        " mask, rgb_mask, manual, got autopilot; use one of these\n"
    )


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--pilot", "pose", "--task", "follow"), "got pose, which does not yet; use expert"),
        (("--pilot", "expert_pid", "--task", "follow"), "got expert_pid, which does not yet"),
        (("--pilot", "pose", "--scene", "arena"), "expected hall for pilot pose, got arena"),
        (("--pilot", "pose", "--no-render"), "--no-render: expected it with a pilot by the state"),
        (("--pilot", "pose", "--size", "16x16"), "image: expected 32 pixels a side or more"),
        (("--pilot", "autopilot"), "expected one of expert, expert_pid, pose, student, rgb, mask"),
        (("--pilot", "manual"), "which nobody holds here; use `falconwing class`"),
        (("--pilot", "manual", "--headless"), "nobody holds here; use `falconwing class`"),
    ],
)
def test_what_a_pilot_cannot_do_is_wrong_use(words, sentence, monkeypatch, capsys):
    """Exit 2 and one sentence, before a page is opened: there is none to open."""
    monkeypatch.setattr("falconwing_kit.tools.classroom.flight_page.FlightPage", None)
    assert main(["fly", *words]) == 2
    said = capsys.readouterr().err
    assert sentence in said
    assert len(said.splitlines()) == 1


def test_help_offers_the_pilots_that_are_there(capsys, monkeypatch):
    """Each with the tasks that it flies; none of a later version."""
    monkeypatch.setenv("COLUMNS", "2000")
    with pytest.raises(SystemExit):
        main(["fly", "--help"])
    said = capsys.readouterr().out
    assert "{expert,expert_pid,pose,student,rgb,mask,rgb_mask}" in said
    assert "expert (landing, follow): " in said and "pose (landing): " in said


def test_expert_pid_lands(capsys):
    """The same door as for all pilots."""
    assert main(["fly", *QUICK, "--pilot", "expert_pid", "--seed", "500"]) == 0
    assert "landing by expert_pid\nsuccess: 1 of 1" in capsys.readouterr().out


def test_the_pose_pilot_lands_in_the_hall_without_a_state(tmp_path, monkeypatch, capsys):
    """By images alone: the world's measured states are not read at all, and the log holds the
    pilot's own estimates, within a metre of the truth that the evaluator recorded.
    """
    monkeypatch.setattr("falconwing_kit.tools.trials.trials.MeasuredStates", None)
    words = ["fly", "--pilot", "pose", "--headless", "--seed", "500", "--size", "160x120"]
    assert main([*words, "--out", str(tmp_path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["scene"], found["pilot"], found["faults"]) == ("hall", "pose", 0)
    states = read_flight_log(tmp_path / "trial_000.mcap").states
    record = json.loads((tmp_path / "trials.jsonl").read_text().splitlines()[1])
    truth = np.array(record["path_m"])[: len(states)]
    estimates = np.array([state.p_world for state in states])
    assert len(states) == record["steps"]
    assert np.linalg.norm(estimates - truth, axis=1)[5:].max() < 1.0


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--size", "320"), "expected WIDTHxHEIGHT"),
        (("--size", "0x0"), "expected WIDTHxHEIGHT"),
        (("--trials", "0"), "trials: expected a finite number"),
        (
            ("--task", "follow", "--manoeuvre", "loop"),
            "manoeuvre: expected one of left_turn_s_descent",
        ),
        (
            ("--manoeuvre", "loop"),
            "--manoeuvre loop: expected it with --task follow only, got --task landing",
        ),
        (("--seed", "-1"), "seed: expected a finite number"),
        (("--against", "nowhere"), "found none there"),
        (("--camera-at", "0.2,0"), "--camera-at: expected x,y,z, three numbers in metres"),
        (("--camera-at=36,0,-75",), "within 2 of the centre of gravity"),
        (("--camera-at=nan,0,0",), "got 'nan,0,0'"),
    ],
)
def test_wrong_options_are_wrong_use(words, sentence, monkeypatch, capsys):
    """Exit 2, one sentence, and before a page is opened: there is none to open."""
    monkeypatch.setattr("falconwing_kit.tools.classroom.flight_page.FlightPage", None)
    assert main(["fly", "--no-render", *words]) == 2
    said = capsys.readouterr().err
    assert sentence in said
    assert len(said.splitlines()) == 1


def test_the_cameras_place_reaches_pilot_and_log(tmp_path, monkeypatch, capsys):
    """By definition: the three numbers given, for the pilot by images and in the flight's log; and
    they make another task, whose trials are not mixed with those of the nose camera.
    """
    seen = []

    def load(name, task, scene, camera, p_body_camera_m, **more):
        seen.append(tuple(p_body_camera_m))
        return load_pilot("expert", task, scene)

    monkeypatch.setattr("falconwing_kit.tools.cli.fly.load_pilot", load)
    words = ["fly", *QUICK, "--pilot", "expert_pid", "--out", str(tmp_path)]
    assert main([*words, "--camera-at=0.036,0,-0.075"]) == 0
    assert set(seen) == {(0.036, 0.0, -0.075)}
    log = read_flight_log(tmp_path / "trial_000.mcap")
    assert json.loads(log.metadata["p_body_camera"]) == [0.036, 0.0, -0.075]
    assert main(words) == 2 and "airframe" in capsys.readouterr().err


def test_help_lists_the_tables(capsys, monkeypatch):
    """Every task and manoeuvre with its summary, read from the tables; a terminal wide enough
    breaks no line.
    """
    monkeypatch.setenv("COLUMNS", "2000")
    with pytest.raises(SystemExit):
        main(["fly", "--help"])
    said = capsys.readouterr().out
    for table in (TASKS, MANOEUVRES):
        for name, entry in table.items():
            assert f"{name}: {entry.summary}" in said


def test_an_unknown_task_in_python_is_one_sentence():
    """The command line offers only those that are there; a Python call can say anything."""
    with pytest.raises(InputError, match="--task loop: expected one of follow, landing"):
        Fly(task="loop").run()


def test_a_landing_leaves_log_table_and_figures(tmp_path, capsys):
    """Exit 0; everything under --out; the last line says what next."""
    out = tmp_path / "new" / "out"
    assert main(["fly", *QUICK, "--seed", "500", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert said.startswith("SIMULATED: landing by expert\nsuccess: 1 of 1")
    assert said.splitlines()[-1].startswith("next: ")
    names = {path.name for path in out.iterdir()}
    assert names == {
        "trial_000.mcap",
        "trials.jsonl",
        "trials.csv",
        "summary.json",
        "paths.png",
        "results.png",
    }
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


def test_a_failed_task_exits_1_and_pairs_are_compared(tmp_path, monkeypatch, capsys):
    """The expert lands twice, the dive never: exit 1, pairs 2, and the other one won both. p = 2
    (1/2)^2.
    """
    words = ["fly", *QUICK, "--seed", "500", "--trials", "2"]
    assert main([*words, "--out", str(tmp_path / "expert"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["successes"] == 2
    monkeypatch.setattr(LandingTask, "expert", lambda self, trial: Dive())
    assert main([*words, "--against", str(tmp_path / "expert"), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert (found["successes"], found["simulated"]) == (0, True)
    assert found["against"] == {"pairs": 2, "only_first": 0, "only_second": 2, "p_value": 0.5}
    assert main([*words, "--against", str(tmp_path / "expert")]) == 1
    said = capsys.readouterr().out
    assert "trial 0: touched floor" in said
    assert "McNemar p = 0.5" in said


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--task", "follow"), "task 'landing' instead of 'follow left_turn_s_descent'"),
        (("--seed", "501"), "list 500 instead of 501"),
    ],
)
def test_other_tasks_and_starts_are_not_paired_or_mixed(words, told, tmp_path, monkeypatch, capsys):
    """A landing of list 500 is kept; a chase or another list is no pair of it and does not go on
    there.

    Found before anything is flown: there is no page to open.
    """
    kept = str(tmp_path / "kept")
    monkeypatch.setattr(LandingTask, "expert", lambda self, trial: Dive())
    assert main(["fly", *QUICK, "--seed", "500", "--out", kept]) == 1
    monkeypatch.setattr("falconwing_kit.tools.classroom.flight_page.FlightPage", None)
    for option in ("--against", "--out"):
        capsys.readouterr()
        assert main(["fly", "--seed", "500", *words, option, kept]) == 2
        said = capsys.readouterr().err
        assert said.startswith(f"falconwing: {option} ")
        assert told in said
        assert len(said.splitlines()) == 1


def test_a_study_with_other_images_is_found_before_it_flies(tmp_path, monkeypatch, capsys):
    """Flown without images as fast as it can; with images, or in real time, it is another study."""
    monkeypatch.setattr(LandingTask, "expert", lambda self, trial: Dive())
    assert main(["fly", *QUICK, "--out", str(tmp_path)]) == 1
    monkeypatch.setattr("falconwing_kit.tools.trials.trials.fly_trials", None)
    monkeypatch.setattr("falconwing_kit.tools.cli.fly._page", None)
    for words, told in (
        (("--headless",), "rendered False"),
        (("--no-render",), "clock 'SimulatedClock'"),
    ):
        assert main(["fly", *words, "--out", str(tmp_path)]) == 2
        assert told in capsys.readouterr().err


def test_a_file_in_place_of_the_folder_is_wrong_use(tmp_path, capsys):
    """Found before anything is flown."""
    (tmp_path / "taken").write_text("")
    assert main(["fly", *QUICK, "--out", str(tmp_path / "taken")]) == 2
    assert "expected a folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("stadium", "expected a file or a name that ships (arena, "),
        ("leader", "expected a hall to fly in, got an aircraft"),
        ("plane.npz", "expected a hall to fly in, got an aircraft"),
        ("nowhere.npz", "nowhere.npz"),
        ("half.npz", "half.npz"),
    ],
)
def test_a_scene_that_is_no_hall_is_wrong_use(name, sentence, tmp_path, monkeypatch, capsys):
    """Exit 2 and one sentence before a page is opened: no such name or file, half a file, an
    aircraft alone.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("falconwing_kit.tools.classroom.flight_page.FlightPage", None)
    plane = GaussianScene(
        [[0, 0, 0]], [[1, 0, 0, 0]], [[0.1] * 3], [0.9], [[[0.5] * 3]], (), ("leader",)
    )
    plane.save("plane.npz")
    Path("half.npz").write_bytes(Path("plane.npz").read_bytes()[:300])
    for verb in ("fly", "demo"):
        assert main([verb, "--scene", name]) == 2
        said = capsys.readouterr().err
        assert sentence in said and len(said.splitlines()) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["half.npz", "plane.npz"]


def test_a_scene_file_is_what_the_camera_sees(tmp_path, monkeypatch, capsys):
    """One large red cloud for a hall: every image of the log is red and nothing else; the arena has
    no such view.
    """
    monkeypatch.setattr(LandingTask, "expert", lambda self, trial: Dive())
    red = [[[1.77, -1.77, -1.77]]]  # 1/2 + 0.282 * 1.77 = 1
    GaussianScene([[30, 0, 0]], [[1, 0, 0, 0]], [[9.0] * 3], [0.99], red, (), ("wall",)).save(
        tmp_path / "fog.npz"
    )
    words = ["fly", "--headless", "--size", "32x24", "--json", "--out", str(tmp_path / "out")]
    assert main([*words, "--scene", str(tmp_path / "fog.npz")]) == 1
    assert json.loads(capsys.readouterr().out)["scene"].endswith("fog.npz")
    seen = [
        decode_jpeg(image)
        for image in read_flight_log(tmp_path / "out" / "trial_000.mcap").images()
    ]
    assert len(seen) > 2
    brightest = np.array([pixels.max(axis=(0, 1)) for pixels in seen])
    assert (brightest[:, 0] > 100).all() and (
        brightest[:, 1:] < 25
    ).all()  # JPEG shifts colours by a few steps


class StandInPage:
    """A page without a browser that counts the steps it is shown."""

    url, shown = "http://127.0.0.1:8080", 0

    def __init__(self, scene, task) -> None:
        assert (scene, task) == ("arena", "landing")

    def __enter__(self):
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def open(self) -> bool:
        return False

    def set_scene(self, scene) -> None:
        self.scene = scene

    def show(self, step) -> None:
        type(self).shown += 1


def test_without_headless_a_page_is_shown_the_flight_in_real_time(monkeypatch, capsys):
    """Every step flown is shown; the page's address does not disturb the JSON. How the dive ends is
    not asked here.
    """
    monkeypatch.setattr("falconwing_kit.tools.classroom.flight_page.FlightPage", StandInPage)
    monkeypatch.setattr(LandingTask, "expert", lambda self, trial: Dive())
    assert main(["fly", "--no-render", "--json"]) == 1
    said = capsys.readouterr()
    assert json.loads(said.out)["trials"] == 1
    assert "live page: http://127.0.0.1:8080" in said.err
    assert StandInPage.shown > 2


FOLLOW = ("--task", "follow", "--headless", "--seed", "500")


def test_the_expert_follows_with_images(capsys):
    """4 m behind, the leader's outline of 0.047 m^2 is 29 px of a 160 x 120 image (f = 99 px):
    locked throughout.
    """
    assert main(["fly", *FOLLOW, "--size", "160x120", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["images"].startswith("160x120 images by ")
    assert found["task"] == "follow left_turn_s_descent"
    assert found["locked_share"]["mean"] == 1.0


def test_a_leader_too_small_in_the_image_is_lost_at_once(tmp_path, capsys):
    """The same outline is 1.2 px of a 32 x 24 image (f = 20 px), fewer than the six that a lock
    needs.

    What a chase keeps can be taken up again: the second time nothing is left to fly.
    """
    words = ["fly", *FOLLOW, "--size", "32x24", "--no-render", "--out", str(tmp_path)]
    assert main(words) == 1
    assert main(words) == 1
    said = capsys.readouterr().out
    assert "trial 0: duration, lock lost at 0.00 s" in said
    assert "\nocclusion not evaluated: no images\n" in said


def test_a_landing_needs_no_judge_of_occlusion_and_says_what_its_times_are_of(capsys):
    """Flown without images too, but nothing can hide the pad: only the run time tells that there
    were none.
    """
    assert main(["fly", *QUICK, "--seed", "500"]) == 0
    said = capsys.readouterr().out
    assert "occlusion" not in said
    (told,) = (line for line in said.splitlines() if line.startswith("ART: "))
    assert " steps within " in told
    assert "(no images; " in told


def model_file(path: Path, model) -> str:
    """A model file as identify or gap writes it, without a covariance."""
    write_fitted_model(
        path, model, Uncertainty((), np.zeros((0, 0)), 1.0, (), (), ()),
        flights=("calm.csv",), train_chi2=1.0, held_out_chi2=None, sigma=np.full(6, 0.01),
    )  # fmt: skip
    return str(path)


def results(capsys) -> dict:
    """The printed record without run times."""
    found = json.loads(capsys.readouterr().out)
    return {key: value for key, value in found.items() if not key.startswith(("art_", "pilot"))}


def test_the_nominal_model_flies_as_without_one(tmp_path, capsys):
    """The kit's own model from a file: the same touchdown to the last digit; the pilot's name has
    the file. With a trim bias in the file that the aircraft does not have it lands elsewhere; a
    bias of 0.3, for the integrals remove most of a small one.
    """
    words = ["fly", *QUICK, "--seed", "500", "--json"]
    assert main(words) == 0
    without = results(capsys)
    assert main([*words, "--model", model_file(tmp_path / "own.toml", rates_model())]) == 0
    said = capsys.readouterr().out
    assert '"pilot": "expert on own.toml ' in said
    found = json.loads(said)
    assert {key: found[key] for key in without} == without
    bias = next(effect for effect in CATALOGUE if effect.name == "trim_bias")
    biased = rates_model().with_effect(bias).with_values({"bias_aileron": 0.3})
    main([*words, "--model", model_file(tmp_path / "biased.toml", biased)])
    assert abs(results(capsys)["ald_m"]["mean"] - without["ald_m"]["mean"]) > 0.005


@pytest.mark.parametrize(
    ("made", "sentence"),
    [
        (None, "expected a file"),
        ("not a model", "m.toml"),
        (paper_model(), "--model m.toml: model: expected the 12-state model"),
        (scale_model(rates_model(), 3.4, 0.6, 2.0), "--model m.toml: model: expected an aircraft"),
    ],
)
def test_a_model_that_cannot_be_flown_is_wrong_use(made, sentence, tmp_path, monkeypatch, capsys):
    """No file, no model, no body rates, too fast for the hall: exit 2, one sentence, no page."""
    monkeypatch.setattr("falconwing_kit.tools.classroom.flight_page.FlightPage", None)
    path = tmp_path / "m.toml"
    if isinstance(made, str):
        path.write_text(made)
    elif made is not None:
        model_file(path, made)
    assert main(["fly", "--model", str(path)]) == 2
    said = capsys.readouterr().err
    assert sentence in said and len(said.splitlines()) == 1


def test_studies_on_two_models_are_paired_and_not_mixed(tmp_path, monkeypatch, capsys):
    """Two pilots of one task: --against compares them, --out keeps them apart."""
    monkeypatch.setattr(LandingTask, "expert", lambda self, trial, model=None: Dive())
    own = model_file(tmp_path / "own.toml", rates_model())
    kept = str(tmp_path / "kept")
    assert main(["fly", *QUICK, "--out", kept]) == 1
    assert main(["fly", *QUICK, "--model", own, "--out", kept]) == 2
    assert "pilot 'expert' instead of 'expert on own.toml" in capsys.readouterr().err
    assert main(["fly", *QUICK, "--model", own, "--against", kept, "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["against"]["pairs"] == 1


def test_workers_fly_the_same_trials(tmp_path, capsys):
    """Two processes: records in order and equal to those of one; a page shows one flight only."""
    words = ["fly", *QUICK, "--seed", "500", "--trials", "2", "--json"]
    assert main(words) == 0
    alone = results(capsys)
    assert main([*words, "--workers", "2", "--out", str(tmp_path)]) == 0
    assert results(capsys) == alone
    lines = (tmp_path / "trials.jsonl").read_text().splitlines()[1:]
    assert [json.loads(line)["trial"] for line in lines] == [0, 1]
    assert main(["fly", "--workers", "2"]) == 2
    assert "--headless" in capsys.readouterr().err


def test_cluster_flies_the_same_trials_and_goes_on_with_a_folder(tmp_path, capsys):
    """One trial here, the others by a worker of a cluster: records equal to those of this machine,
    the first of them kept as it was.
    """
    pytest.importorskip("distributed")
    words = ["fly", *QUICK, "--seed", "500", "--json"]
    kept = ["--out", str(tmp_path / "kept")]
    assert main([*words, "--trials", "1", *kept]) == 0
    first = (tmp_path / "kept" / "trials.jsonl").read_text().splitlines()[1]
    assert main([*words, "--trials", "3"]) == 0
    alone = capsys.readouterr().out.split("\n}\n")[1] + "\n}"
    with clusters.running(tmp_path) as (address, start_worker):
        start_worker()
        assert main([*words, "--trials", "3", *kept, "--cluster", address]) == 0
    there = json.loads(capsys.readouterr().out)
    assert {key: there[key] for key in ("trials", "successes", "ald_m", "bank_abs_deg")} == {
        key: json.loads(alone)[key] for key in ("trials", "successes", "ald_m", "bank_abs_deg")
    }
    lines = (tmp_path / "kept" / "trials.jsonl").read_text().splitlines()[1:]
    assert [json.loads(line)["trial"] for line in lines] == [0, 1, 2] and lines[0] == first


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--cluster", "tcp://127.0.0.1:9"), "add --headless"),
        ((*QUICK, "--logs", "--cluster", "tcp://127.0.0.1:9"), "disks of their own"),
        ((*QUICK, "--cluster", "tcp://127.0.0.1:9"), "expected a scheduler"),
    ],
)
def test_a_cluster_that_cannot_fly_is_refused(words, sentence, monkeypatch, capsys):
    """A page, logs on other disks, no scheduler: one sentence, exit 2."""
    pytest.importorskip("distributed")
    monkeypatch.setattr("falconwing_kit.tools.jobs.cluster.TIMEOUT_S", 0.5)
    assert main(["fly", *words]) == 2
    assert sentence in capsys.readouterr().err


def test_a_flight_starts_where_it_is_told(tmp_path, monkeypatch, capsys):
    """The log's first state is the pose given, within the noise of 1 cm and 0.7 deg; from that log
    and from a table the next flights start there too.
    """
    monkeypatch.setattr(LandingTask, "expert", lambda self, trial, model=None: Dive())
    table = tmp_path / "table.csv"
    header = "t,px,py,pz,roll,pitch,yaw,throttle,aileron,elevator,rudder"
    table.write_text(f"{header}\n0,-15,-1,2.5,0.1,0.09,-0.2,0,0,0,0\n0.05,0,0,0,0,0,0,0,0,0,0\n")
    log = str(tmp_path / "a" / "trial_000.mcap")
    starts = ("-15,-1,2.5,5.73,5.157,-11.46", log, str(table))
    for start, folder in zip(starts, "abc", strict=True):
        assert main(["fly", *QUICK, f"--start={start}", "--out", str(tmp_path / folder)]) == 1
        first = read_flight_log(tmp_path / folder / "trial_000.mcap").states[0]
        assert first.p_world == pytest.approx([-15.0, -1.0, 2.5], abs=0.1)
        attitude = (first.roll, first.pitch, first.yaw)
        assert attitude == pytest.approx((0.1, 0.09, -0.2), abs=0.06)
    capsys.readouterr()
    assert main(["fly", *QUICK, "--start", "1,2,3"]) == 2
    assert "--start: expected x,y,z,roll,pitch,yaw" in capsys.readouterr().err


class KeptPage(StandInPage):
    """A page that a browser shows, and what it was kept with."""

    verdicts: tuple[str, ...] = ()

    def open(self) -> bool:
        return True

    def wait_for_viewer(self, seconds: float) -> bool:
        return True

    def show(self, step) -> None:
        time.sleep(0.08)  # slower than the 50 ms of a step

    def keep(self, verdict: str, success: bool) -> None:
        assert success is False
        type(self).verdicts += (verdict,)


def test_a_slow_page_stretches_time_and_stays_with_the_verdict(monkeypatch, capsys):
    """Steps of 80 ms instead of 50: none is left out, the stretch of 1.6 or more is said, and the
    page is kept with the outcome.
    """
    monkeypatch.setattr("falconwing_kit.tools.classroom.flight_page.FlightPage", KeptPage)
    monkeypatch.setattr(LandingTask, "expert", lambda self, trial: Dive())
    assert main(["fly", "--no-render", "--json"]) == 1
    said = capsys.readouterr()
    assert json.loads(said.out)["skipped"] == 0
    stretch = float(re.search(r"took ([\d.]+) s", said.err)[1])
    assert stretch >= 1.55 and "the page stays until Ctrl-C" in said.err
    (verdict,) = KeptPage.verdicts
    assert verdict.startswith("failed: touched")
