"""The doctor: what works is said only after a try, and what is missing comes with its mend."""

import json

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.bridge import build
from falconwing_kit.tools.cli import doctor
from falconwing_kit.tools.cli.doctor import Doctor, SystemCheck, SystemCheckResult, examine
from falconwing_kit.trainer_port import usb
from falconwing_kit.trainer_port.usb import SerialBoard


def fine() -> str:
    """A capability that works."""
    return "seen"


def broken() -> str:
    """A capability that does not."""
    raise RuntimeError("it is broken\nand this is why")


def absent() -> str:
    """A capability whose library is not there."""
    raise ModuleNotFoundError("No module named 'attic'", name="attic")


@pytest.mark.parametrize(
    ("need", "attempt", "finding"),
    [
        ("demo", fine, SystemCheckResult("x", "works", True, "seen", "")),
        ("later", fine, SystemCheckResult("x", "works", False, "seen", "")),
        ("demo", broken, SystemCheckResult("x", "missing", True, "it is broken", "mend it")),
        ("now", broken, SystemCheckResult("x", "missing", False, "it is broken", "mend it")),
        (
            "later",
            absent,
            SystemCheckResult("x", "not needed yet", False, "attic is not installed", "mend it"),
        ),
    ],
)
def test_finding_follows_from_the_try(need, attempt, finding):
    """By hand: works only if nothing was raised, missing only if this version uses it, a mend only
    if it is needed.
    """
    assert examine(SystemCheck("x", need, attempt, "mend it")) == finding


@pytest.mark.parametrize(
    ("demo", "other", "code"),
    [(fine, fine, 0), (fine, broken, 0), (broken, fine, 1), (broken, broken, 1)],
)
def test_exit_code_is_the_answer_for_the_demo(monkeypatch, capsys, demo, other, code):
    """Only what the demo needs decides; table and JSON tell the same."""
    checks = (
        SystemCheck("core", "demo", demo, "mend the core"),
        SystemCheck("extra", "now", other, "mend the extra"),
    )
    monkeypatch.setattr(doctor, "CHECKS", checks)
    assert Doctor().run() == code
    table = capsys.readouterr().out
    assert ("mend the core" in table, "mend the extra" in table) == (
        demo is broken,
        other is broken,
    )
    assert ("next: falconwing demo" in table) == (code == 0)
    assert Doctor(json=True).run() == code
    record = json.loads(capsys.readouterr().out)
    assert record["demo_works"] == (code == 0)
    assert [f["status"] for f in record["findings"]] == [
        "missing" if f is broken else "works" for f in (demo, other)
    ]


def test_this_machine_runs_the_demo():
    """The tests run on a machine with everything installed, so each part that the demo needs was
    tried and works.
    """
    findings = [examine(check) for check in doctor.CHECKS if check.need == "demo"]
    assert [(f.capability, f.detail) for f in findings if f.status != "works"] == []


@pytest.mark.parametrize(
    ("found", "seen"),
    [
        ((), "no board on a USB serial port found"),
        (
            (SerialBoard("/dev/ttyUSB7", "weather station", False, True, ""),),
            "does not look like a Mega 2560",
        ),
        (
            (SerialBoard("/dev/ttyACM0", "Arduino Mega 2560", True, False, "join"),),
            "you may not open it",
        ),
    ],
)
def test_a_board_that_cannot_be_used_is_no_board(monkeypatch, found, seen):
    """Nothing there, another thing, or no right to it: each is said."""
    monkeypatch.setattr(usb, "find_boards", lambda: list(found))
    check = next(check for check in doctor.CHECKS if check.capability == "finding the board")
    finding = examine(check)
    assert (
        finding.status == "missing"
        and seen in finding.detail
        and "falconwing find-port" in finding.advice
    )


def test_firmware_tools_are_named_in_full(monkeypatch):
    """What to install is what the builder asks for, package by package."""
    check = next(check for check in doctor.CHECKS if check.capability == "firmware tools")
    assert all(
        package in check.advice.split() or f"{package};" in check.advice.split()
        for package in build.TOOLS
    )
    monkeypatch.setattr(build, "missing_tools", lambda: ["avr-libc"])
    assert examine(check).detail == "not installed: avr-libc"


@pytest.mark.parametrize(
    ("system", "way"), [("win32", "wsl --install"), ("darwin", "virtual"), ("linux", "Debian")]
)
def test_what_needs_linux_says_the_way_there(monkeypatch, system, way):
    """Microsoft's own command of WSL 2 on Windows; on Linux the package alone, as before."""
    monkeypatch.setattr(doctor.sys, "platform", system)
    monkeypatch.setattr(build, "missing_tools", lambda: ["avr-libc"])
    monkeypatch.setattr(doctor.shutil, "which", lambda name: None)
    for name in ("grading sandbox", "firmware tools"):
        found = examine(next(check for check in doctor.CHECKS if check.capability == name))
        assert way in found.advice and "apt install" in found.advice
        assert ("wsl" in found.advice) == (system == "win32")
        assert ("needs Linux" in found.detail) == (system != "linux")
    with pytest.raises(InputError, match="expected Linux" if system != "linux" else "avr-libc"):
        build.build_firmware()
