"""falconwing class: what is refused in a sentence, and a class from the command to Ctrl-C."""

import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request

import pytest

from falconwing_kit.core.flight_log import read_flight_log
from falconwing_kit.tools.cli.main import main

START_S = 60.0  # for anything to happen, on a busy machine


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--pilot", "magic"), "expected one of expert"),
        (("--pilot", "expert_pid", "--task", "follow"), "expected one that flies the task follow"),
        (("--port", "/dev/ttyACM0"), "no real aircraft from the page; use sim or sim-python"),
        (("--port", "/dev/ttyACM0", "--lan"), "never from the network without --real-from-lan"),
        (("--task", "follow", "--manoeuvre", "nonsense"), "manoeuvre"),
        (("--scene", "nowhere.npz"), "nowhere.npz"),
        (("--web-port", "80"), "web-port"),
        (("--laps", "-1"), "laps"),
        (("--out", __file__), "expected a folder"),
    ],
)
def test_wrong_options_are_refused_in_a_sentence(capsys, words, sentence):
    """Before a port is opened: exit code 2 and one line."""
    assert main(["class", "--no-browser", *words]) == 2
    said = capsys.readouterr().err
    assert sentence in said and said.count("\n") == 1


def test_a_class_from_the_command_to_ctrl_c(tmp_path):
    """In a process of its own: addresses, the page, a flight, Ctrl-C; exit code 0, a readable log
    with its place, and another folder the next time.
    """
    command = [
        sys.executable, "-m", "falconwing_kit.tools.cli.main", "class", "--no-browser",
        "--web-port", "0", "--laps", "0", "--out", str(tmp_path / "logs"),
    ]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        lines = [process.stdout.readline() for _ in range(5)]
        assert "SIMULATION" in lines[0]
        students = re.search(r"students: (http://127\.0\.0\.1:\d+/)$", lines[1])[1]
        teacher = re.search(r"teacher:  (\S+)$", lines[3])[1]
        with urllib.request.urlopen(teacher, timeout=START_S) as answer:
            assert answer.status == 200 and b"TAKE BACK" in answer.read()
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(f"{students}desk?key=wrong", timeout=START_S)
        with urllib.request.urlopen(f"{students}flights.json", timeout=START_S) as answer:
            assert answer.read() == b"[]"
        while not list((tmp_path / "logs").glob("*.mcap")):
            assert process.poll() is None
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        rest = process.communicate(timeout=START_S)[0]
    finally:
        process.kill()
    assert process.returncode == 0
    assert "Traceback" not in rest and rest.splitlines()[-1].startswith("next: ")
    log = read_flight_log(tmp_path / "logs" / "flight_0001.mcap")
    assert log.metadata["scene"] == "arena" and log.metadata["task"] == "landing"
