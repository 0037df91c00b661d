"""`falconwing export` and `replay`: a flight log converted, repaired, shown and drawn."""

import gzip
import json
import re
import shutil
import urllib.error
import urllib.request
import webbrowser

import numpy as np
import pytest

from falconwing_kit.core.flight_log import FlightLogWriter, read_flight_log
from falconwing_kit.core.flight_table import read_flight_table
from falconwing_kit.core.messages import Command, Image, State
from falconwing_kit.tools.classroom.flight_page import FlightPage
from falconwing_kit.tools.cli.main import main


@pytest.fixture
def log(tmp_path):
    """Ten frames, each command with its own throttle; beside it the log as it is in mid-flight."""
    path = tmp_path / "flight.mcap"
    with FlightLogWriter(path) as writer:
        for k in range(10):
            writer.state(
                0.05 * k, State.from_vector(np.arange(9.0) / 10.0 + k / 100.0), image_sequence=k
            )
            writer.command(
                0.05 * k + 0.03,
                Command(0.1 * k, 0.0, 0.0, 0.0, k),
                Image(k, 0.05 * k, np.zeros(9, np.uint8)),
            )
        shutil.copy(path, tmp_path / "interrupted.mcap")
    return path


def test_a_log_becomes_a_table(log, tmp_path, capsys):
    """Ten rows with their poses and commands; the last line says what to type next."""
    assert main(["export", str(log), "--out", str(tmp_path / "flight.csv")]) == 0
    table = read_flight_table(tmp_path / "flight.csv")
    assert (
        table.commands[:, 0] == pytest.approx([0.1 * k for k in range(10)]) and table.has_pose.all()
    )
    assert capsys.readouterr().out.splitlines()[-1].startswith("next: falconwing identify")


def test_an_interrupted_log_becomes_a_whole_one(log, tmp_path, capsys):
    """All that was recorded is there, the interruption is said, and the new log has none."""
    (tmp_path / "saved").mkdir()
    assert (
        main(
            [
                "export",
                str(tmp_path / "interrupted.mcap"),
                "--to",
                "mcap",
                "--out",
                str(tmp_path / "saved"),
                "--json",
            ]
        )
        == 0
    )
    report = json.loads(capsys.readouterr().out)
    saved = read_flight_log(tmp_path / "saved" / "interrupted.mcap")
    assert (
        report["command"] == len(saved.commands) == 10 and "closing record" in report["warnings"][0]
    )
    assert saved.warnings == ()


def test_an_interrupted_log_becomes_a_bag(log, tmp_path, capsys):
    """Ten of each by hand, as the library that wrote the bag reads it; the interruption is said."""
    from rosbags.rosbag1 import Reader

    assert (
        main(
            [
                "export",
                str(tmp_path / "interrupted.mcap"),
                "--to",
                "bag",
                "--out",
                str(tmp_path),
                "--json",
            ]
        )
        == 0
    )
    report = json.loads(capsys.readouterr().out)
    assert "closing record" in report["warnings"][0]
    with Reader(tmp_path / "interrupted.bag") as bag:
        counts = {topic: info.msgcount for topic, info in bag.topics.items()}
    assert counts == {f"/falconwing/{name}": 10 for name in ("image", "command", "pose", "twist")}
    assert {topic: report[topic] for topic in counts} == counts


def test_a_log_becomes_a_recording_of_ros2_and_a_table_again(log, tmp_path, capsys):
    """Ten rows by hand, written by one verb and read by the same."""
    folder = tmp_path / "recordings"
    folder.mkdir()
    assert main(["export", str(log), "--to", "ros2", "--out", str(folder)]) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("next: ros2 bag info")
    words = ["export", str(folder / "flight.ros2"), "--out", str(tmp_path / "back.csv")]
    assert main(words) == 0
    back = read_flight_table(tmp_path / "back.csv")
    assert len(back.t) == 9  # the first pose comes before the first command
    assert back.p_world[:, 0] == pytest.approx([k / 100.0 for k in range(1, 10)], abs=1e-6)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["absent.mcap", "--out", "a.csv"], "absent.mcap"),
        (["flight.mcap", "--out", "none/a", "--to", "ros2"], "expected a folder"),
        (["flight.mcap", "--out", "flight.mcap"], "another name"),
        (["flight.mcap", "--out", "none/a.csv"], "expected a folder"),
        (["flight.mcap", "--out", "none/a.bag", "--to", "bag"], "expected a folder"),
        (["notes.txt", "--out", "a.csv"], "expected a flight log in MCAP format"),
    ],
)
def test_wrong_use_is_one_sentence_and_exit_2(log, tmp_path, monkeypatch, capsys, words, sentence):
    """Nothing is written and the log is as before."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes.txt").write_text("no log")
    before = sorted(tmp_path.iterdir())
    assert main(["export", *words]) == 2
    error = capsys.readouterr().err
    assert sentence in error and error.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before
    assert len(read_flight_log(log).commands) == 10


@pytest.fixture
def flown(tmp_path):
    """A short flight with views, each of one grey, and a mode that changes."""
    with FlightLogWriter(tmp_path / "flown.mcap") as writer:
        writer.metadata({"simulated": "yes"})
        for k in range(20):
            state = State(np.array([0.3 * k, -2.0, 1.0]), 0.0, 0.0, 0.0, np.array([6.0, 0.0, 0.0]))
            writer.state(0.05 * k, state, image_sequence=k)
            writer.command(
                0.05 * k,
                Command(0.05 * k, 0.0, 0.0, 0.0, k),
                Image(k, 0.05 * k, np.full((24, 32, 3), 10 * k, np.uint8)),
            )
            if k in (0, 10):
                writer.event(0.05 * k, "mode", {"mode": ("approach", "flare")[k // 10]})
    return tmp_path / "flown.mcap"


def test_replay_draws_the_figures_of_the_demo(flown, tmp_path, capsys):
    """Headless: the four figures in a folder that was not there; the last line says what to type
    next.
    """
    assert main(["replay", str(flown), "--headless", "--out", str(tmp_path / "figures")]) == 0
    assert sorted(path.name for path in (tmp_path / "figures").iterdir()) == [
        "flight_film.png", "flight_fpv.png", "flight_path.png", "flight_sticks.png",
    ]  # fmt: skip
    assert capsys.readouterr().out.splitlines()[-1].startswith("next: falconwing export")


def test_replay_serves_the_flight_of_the_log(flown, monkeypatch, capsys):
    """The player's page at its own address; the flight by its poses and throttles as written, as
    it was logged; --speed is in the address; no seat and no desk. Ctrl-C ends it.
    """
    found = {}

    def visit(page, **how):
        address = page.url.partition("?")[0]
        for name in ("", "flights/1.json", "wall", "desk"):
            try:
                with urllib.request.urlopen(address + name, timeout=30.0) as answer:
                    found[name] = answer.read()
            except urllib.error.HTTPError as error:
                found[name] = error.code

    monkeypatch.setattr(FlightPage, "set_scene", lambda page, scene: None)
    monkeypatch.setattr(FlightPage, "wait", visit)
    monkeypatch.setattr(webbrowser, "open", lambda url: False)
    assert main(["replay", str(flown), "--speed", "0.5", "--port", "18431"]) == 0
    assert re.search(r"page: http://127.0.0.1:\d+/\?speed=0.5 ", capsys.readouterr().out)
    assert b"flight.js" in found[""] and (found["wall"], found["desk"]) == (404, 403)
    flight = json.loads(gzip.decompress(found["flights/1.json"]))
    assert flight["t"] == pytest.approx([0.05 * k for k in range(20)])
    assert [row[0] for row in flight["pose"]] == pytest.approx([0.3 * k for k in range(20)])
    assert [row[0] for row in flight["command"]] == pytest.approx([0.05 * k for k in range(20)])
    assert [event["text"] for event in flight["events"]] == ["approach", "flare"]
    assert flight["simulated"] is True and flight["success"] is None


@pytest.mark.parametrize(
    ("named", "words", "shown", "said"),
    [
        ("hall", [], "hall", ""),
        ("hall", ["--scene", "arena"], "arena", ""),
        ("", [], "arena", "the log does not say where it was flown"),
        ("gone/hall.ply", [], "arena", "the log's scene 'gone/hall.ply' is not here"),
    ],
)
def test_replay_is_in_the_hall_of_the_log(tmp_path, monkeypatch, capsys, named, words, shown, said):
    """The scene reaches the page, of the two only the arena with a leader of its own; --scene has
    precedence; the arena otherwise, and a sentence says so. A log without poses is shown by its
    steps, again and again until Ctrl-C: the leader flies as logged.
    """
    path = tmp_path / "flown.mcap"
    with FlightLogWriter(path) as writer:
        writer.metadata({"simulated": "yes", **({"scene": named} if named else {})})
        for k in range(3):
            writer.command(0.05 * k, Command(0.1, 0.0, 0.0, 0.0))
            writer.leader(0.05 * k, State.from_vector(np.full(9, 1.0 + k)))
    scenes, steps = [], []

    def show(page, step):
        steps.append(step)
        if len(steps) == 5:
            raise KeyboardInterrupt

    monkeypatch.setattr(FlightPage, "set_scene", lambda page, scene: scenes.append(scene))
    monkeypatch.setattr(FlightPage, "show", show)
    monkeypatch.setattr(webbrowser, "open", lambda url: False)
    words = ["replay", str(path), "--speed", "4", "--port", "18431", *words]
    assert main(words) == 0
    assert ["arena" if "leader" in s.label_names else "hall" for s in scenes] == [shown]
    out = capsys.readouterr().out
    assert said in out and ("shown in the arena" in out) == bool(said)
    assert [step.leader.p_world[0] for step in steps] == [1.0, 2.0, 3.0, 1.0, 2.0]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["flown.mcap", "--scene", "nowhere"], "scene: expected a file or a name that ships"),
        (["flown.mcap", "--scene", "gone.ply"], "gone.ply: expected a file"),
        (["absent.mcap"], "absent.mcap: expected a file, found nothing there"),
        (["absent.mcap", "--headless"], "absent.mcap: expected a file, found nothing there"),
        (["flown.mcap", "--speed", "0"], "speed: expected a finite number in"),
        (["flown.mcap", "--port", "80"], "port: expected a finite number in"),
        (
            ["flown.mcap", "--headless", "--out", "flown.mcap"],
            "--out flown.mcap: expected a folder, got a file",
        ),
    ],
)
def test_replay_of_nothing_is_one_sentence_and_exit_2(
    flown, tmp_path, monkeypatch, capsys, words, sentence
):
    """Nothing is opened or written."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(webbrowser, "open", lambda url: pytest.fail("a browser was opened"))
    before = sorted(tmp_path.iterdir())
    assert main(["replay", *words]) == 2
    error = capsys.readouterr().err
    assert sentence in error and error.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before
