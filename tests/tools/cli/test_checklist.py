"""`falconwing doctor --bench` asks, tries by itself, stops where it must, and writes a record only
where told.
"""

import io
import json

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.cli import checklist as walking
from falconwing_kit.tools.cli.checklist import ChecklistDevices, walk
from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.devices.cameras import CameraFault, FakeCamera
from falconwing_kit.tools.hardware.checklists import Checklist, Step, load_checklists


class Terminal(io.StringIO):
    """Somebody who types these answers."""

    def isatty(self):
        return True


def listed(*ids, stop=False, automatic=""):
    return Checklist(
        "a list",
        tuple(Step(name, "do it", "it done", f"mend {name}", stop, automatic) for name in ids),
    )


def typed(monkeypatch, text):
    monkeypatch.setattr("sys.stdin", Terminal(text))


@pytest.fixture(autouse=True)
def in_empty_folder(tmp_path, monkeypatch):
    """Whatever is written by mistake lands here and is seen."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(walking, "OBSERVE_S", 0.6)


@pytest.mark.parametrize(
    ("answers", "code", "results"),
    [
        ("y\ny\ny\n", 0, ["yes", "yes", "yes"]),
        ("y\nperhaps\n\nn\ny\n", 1, ["yes", "NO", "yes"]),  # what is no answer is asked again
        ("Y\ns\nskip\n", 0, ["yes", "skipped", "skipped"]),
        (
            "y\n",
            1,
            ["yes", "not done", "not done"],
        ),  # the terminal was closed: a walk that ended early did not pass
    ],
)
def test_answers_decide(monkeypatch, capsys, answers, code, results):
    """By hand: any no, or an end before the last step, is exit code 1; a skipped step is not a
    failed one.
    """
    typed(monkeypatch, answers)
    assert walk(listed("one", "two", "three"), ChecklistDevices(), as_json=True) == code
    record = json.loads(capsys.readouterr().out)
    assert [step["result"] for step in record["steps"]] == results
    assert record["failed"] == bool(code) and record["complete"] == (results == ["yes"] * 3)


def test_no_at_a_step_that_stops_ends_the_walk(monkeypatch, capsys):
    """With the propeller on, nothing else is asked; what to do is said."""
    typed(monkeypatch, "n\ny\ny\n")
    assert walk(listed("one", "two", stop=True), ChecklistDevices()) == 1
    printed = capsys.readouterr()
    assert "2/2" not in printed.err and printed.out.rstrip().endswith("next: mend one")


def test_the_last_preflight_item_is_spoken_after_the_port_is_free(monkeypatch, capsys):
    """The operator starts the recording between the program's end and "cut off": the program asks
    for eleven items, prints the twelfth and never asks for it; after a no it does not print it.
    """
    preflight = load_checklists().preflight
    typed(monkeypatch, "y\n" * 50)
    assert walk(preflight, ChecklistDevices()) == 0
    printed = capsys.readouterr()
    assert printed.err.count("[y/n/s]") == len(preflight.asked) == len(preflight.steps) - 1
    assert preflight.steps[-1].id == "cut_off" and preflight.steps[-1].do in printed.err
    assert printed.out.rstrip().endswith("then item 12 aloud")
    typed(monkeypatch, "n\n")
    assert walk(preflight, ChecklistDevices()) == 1
    assert preflight.steps[-1].do not in capsys.readouterr().err


def test_automatic_step_without_a_tool_is_asked(monkeypatch, capsys):
    """No port was given: the person reports the board's state, and a no stops the checklist."""
    typed(monkeypatch, "n\ny\n")
    assert (
        walk(listed("look", "fly", stop=True, automatic="board"), ChecklistDevices(), as_json=True)
        == 1
    )
    steps = json.loads(capsys.readouterr().out)["steps"]
    assert [(step["result"], step["by"]) for step in steps] == [("NO", "person"), ("not done", "")]


def test_without_a_terminal_it_is_printed(monkeypatch, capsys, tmp_path):
    """Every step's words stand there, nothing is waited for, nothing is called done, no file is
    written.
    """
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n" * 50))
    for word, checklist in (
        ("--bench", load_checklists().bench),
        ("--preflight", load_checklists().preflight),
    ):
        assert main(["doctor", word, "--json"]) == 0
        printed = capsys.readouterr()
        record = json.loads(printed.out)
        assert all(step.do in printed.err and step.see in printed.err for step in checklist.steps)
        wanted = ["skipped" if step.automatic else "not done" for step in checklist.asked]
        assert [step["result"] for step in record["steps"]] == wanted and not record["complete"]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.filterwarnings("ignore:the calibration")
def test_simulated_board_and_camera_pass_and_are_called_simulated(monkeypatch, capsys, tmp_path):
    """The kit's own board and a camera without faults have nothing to complain of; the record says
    what they were.
    """
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert (
        main(
            [
                "doctor",
                "--bench",
                "--port",
                "sim-python",
                "--camera",
                "sim",
                "--out",
                "deep/records",
            ]
        )
        == 0
    )
    (path,) = (tmp_path / "deep" / "records").iterdir()
    record = json.loads(path.read_text(encoding="utf-8"))
    tried = {step["id"]: step for step in record["steps"] if step["by"] == "computer"}
    assert {name: step["result"] for name, step in tried.items()} == dict.fromkeys(
        ("picture", "board", "sticks"), "yes"
    )
    assert "SIMULATED" in tried["picture"]["seen"] and "SIMULATED" in tried["board"]["seen"]
    assert record["port"] == "sim-python" and record["date"][:2] == "20"


@pytest.mark.parametrize(
    ("faults", "text"),
    [
        ([CameraFault("noise", 0.0, 60.0, 10.0)], "noise"),
        ([CameraFault("unplug", 0.0, 60.0)], "expected an image"),
        ([CameraFault("freeze", 0.2, 60.0)], "alarm"),
    ],
)
def test_bad_camera_fails_the_step(monkeypatch, capsys, faults, text):
    """A scripted camera with 10 dB of noise, unplugged, or frozen: no, with the reason."""
    monkeypatch.setattr(walking, "_simulated_camera", lambda: FakeCamera(faults))
    monkeypatch.setattr(walking, "FIRST_IMAGE_S", 1.0)
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert (
        walk(listed("look", automatic="picture"), ChecklistDevices(camera="sim"), as_json=True) == 1
    )
    (step,) = json.loads(capsys.readouterr().out)["steps"]
    assert step["result"] == "NO" and text in step["seen"]


@pytest.mark.filterwarnings("ignore:the calibration")
def test_board_that_is_not_there_stops_the_bench_test(monkeypatch, capsys):
    """No such port: the step fails with a sentence, the steps behind it are not done."""
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert (
        walk(
            listed("look", "fly", stop=True, automatic="board"),
            ChecklistDevices(port="/dev/nothing"),
            as_json=True,
        )
        == 1
    )
    steps = json.loads(capsys.readouterr().out)["steps"]
    assert steps[0]["result"] == "NO" and "/dev/nothing" in steps[0]["seen"]
    assert steps[1]["result"] == "not done"


@pytest.mark.parametrize(
    ("sticks", "fine"),
    [((0.0, 0.0, 0.0, 0.0), True), ((0.4, 0, 0, 0), False), ((0, 0, -0.5, 0), False)],
)
def test_sticks_off_idle_fail(sticks, fine):
    """Throttle up, or a stick off its centre, is not what a motor may be plugged in to."""
    from falconwing_kit.core.messages import Command

    if fine:
        walking._require_idle(Command(*sticks))
    else:
        with pytest.raises(InputError, match="idle"):
            walking._require_idle(Command(*sticks))


@pytest.mark.parametrize(
    ("words", "text"), [(["--port", "sim"], "--bench"), (["--bench", "--preflight"], "one of them")]
)
def test_options_that_do_not_go_together_are_wrong_use(words, text, capsys):
    """Exit code 2 and a sentence."""
    assert main(["doctor", *words]) == 2
    assert text in capsys.readouterr().err


@pytest.mark.parametrize(
    ("typed_length", "code", "result"),
    [("99.8", 0, "yes"), ("100 mm", 0, "yes"), ("99,7", 0, "yes"), ("99.0", 1, "NO"),
     ("103", 1, "NO"), ("wide\n-3\n99.9", 0, "yes")],
)  # fmt: skip
def test_a_print_of_wrong_scale_fails_the_bench_test(
    monkeypatch, capsys, typed_length, code, result
):
    """Half a millimetre of 100 by hand: 99.0 is a scale error of -1.0 %, said in one sentence; what
    is no length is asked again.
    """
    typed(monkeypatch, f"y\n{typed_length}\n")
    assert walk(listed("one"), ChecklistDevices(), as_json=True, asks_print=True) == code
    printed = capsys.readouterr()
    check = json.loads(printed.out)["print_check"]
    assert check["result"] == result and check["seen"].endswith("of 100 mm")
    said = [line for line in printed.err.splitlines() if "scale error" in line]
    assert len(said) == code and all("print again at 100 %" in line for line in said)


@pytest.mark.parametrize("answers", ["y\n\n", "y\n"])
def test_without_a_print_nothing_is_required(monkeypatch, capsys, answers):
    """Enter, or the end of the input: a marker of another source needs no check line."""
    typed(monkeypatch, answers)
    assert walk(listed("one"), ChecklistDevices(), as_json=True, asks_print=True) == 0
    assert "print_check" not in json.loads(capsys.readouterr().out)


def test_a_print_is_not_asked_for_after_a_stop(monkeypatch, capsys):
    """With the propeller on, nothing else is asked."""
    typed(monkeypatch, "n\n99.9\n")
    walk(listed("one", stop=True), ChecklistDevices(), asks_print=True)
    assert "check length" not in capsys.readouterr().err


def test_print_length_by_an_option(tmp_path, capsys):
    """Without a terminal the length comes by --print-mm, and is recorded; elsewhere it is wrong."""
    assert main(["doctor", "--bench", "--print-mm", "99.0", "--json", "--out", str(tmp_path)]) == 1
    (file,) = tmp_path.glob("checklist_*.json")
    record = json.loads(file.read_text())
    assert record["print_check"] == {
        "id": "print_scale", "result": "NO", "by": "person", "seen": "99 of 100 mm"
    }  # fmt: skip
    assert record["failed"] and "scale error of -1.0 %" in capsys.readouterr().err
    assert main(["doctor", "--print-mm", "99.0"]) == 2
    assert main(["doctor", "--preflight", "--print-mm", "99.0"]) == 2
    assert main(["doctor", "--bench", "--print-mm", "nan"]) == 2
