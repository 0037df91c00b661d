"""`falconwing firmware`: checks pass a sound board and fail one that breaks its promise; the
program is built.
"""

import json
import os
from functools import partial

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.bridge.build import missing_tools
from falconwing_kit.tools.bridge.python_board import PythonBoard
from falconwing_kit.tools.cli.firmware import CHECKS, FLASH_BUDGET, RAM_BUDGET, run_check
from falconwing_kit.tools.cli.main import main
from falconwing_kit.trainer_port.protocol import CommandFrame, SyncRequest, decode, encode_channels
from falconwing_kit.trainer_port.safety import SafetyConfig

TOOLS = pytest.mark.skipif(
    bool(missing_tools()) and not os.environ.get("CI"),
    reason=f"not installed: {', '.join(missing_tools())}",
)


class Spoilt(PythonBoard):
    """A board between whose wire and program somebody sits: `replace` gives what reaches the
    program.
    """

    def replace(self, data, message):
        return data

    def write(self, data):
        try:
            message = decode(data)
        except InputError:
            message = None
        super().write(self.replace(data, message))


class NeverLetsGo(Spoilt):
    def replace(self, data, message):
        flying = (
            isinstance(message, CommandFrame)
            and not message.engage
            and self._safety.state == "ACTIVE"
        )
        return b"" if flying else data


class BelievesAll(Spoilt):
    numbers = iter(range(1000, 60000))

    def replace(self, data, message):
        return encode_channels(next(self.numbers), (1500,) * 4, False) if message is None else data


class CountsItself(Spoilt):
    number = 0

    def replace(self, data, message):
        self.number += 1
        return encode_channels(self.number, message.channels_us, message.engage)


class HasNoClock(Spoilt):
    def replace(self, data, message):
        return b"" if isinstance(message, SyncRequest) else data


class MeasuresBadly(PythonBoard):
    def set_pilot(self, channels_us):
        super().set_pilot([us + 3 for us in channels_us])


def configured(**changes):
    return partial(PythonBoard, SafetyConfig(**changes))


BREAKERS = {  # the promise -> a board that breaks it
    "starts SAFE": configured(safe_us=(1500,) * 8),
    "pulses and frames": partial(PythonBoard, gap_us=402),
    "edge plus five": configured(engage_frames=4),
    "idle and neutral": configured(engage_idle_us=60),
    "measured sticks": configured(engage_near_us=115),
    "stick moved": configured(pilot_moved_us=130),
    "on the pin": configured(slew_us=1),
    "no commands": configured(host_timeout_ms=230),
    "program hangs": configured(host_timeout_ms=400),
    "disengaged": NeverLetsGo,
    "damaged frames": BelievesAll,
    "old sequences": CountsItself,
    "out of range": configured(range_fault_frames=6),
    "the pilot's pulses": MeasuresBadly,
    "clock": HasNoClock,
}


@pytest.mark.parametrize(("name", "check"), CHECKS, ids=[name for name, _ in CHECKS])
def test_a_sound_board_passes(name, check):
    """The plain Python board was written from the same requirements, without these checks."""
    result = run_check(name, check, PythonBoard)
    assert result.passed, result.seen


@pytest.mark.parametrize("promise", BREAKERS)
def test_a_board_that_breaks_a_promise_fails_its_check(promise):
    """One board for each promise, broken in one thing."""
    name, check = next(row for row in CHECKS if promise in row[0])
    result = run_check(name, check, BREAKERS[promise])
    assert not result.passed and result.seen


def test_every_check_has_a_breaker():
    """No check that cannot fail."""
    assert all(sum(promise in name for promise in BREAKERS) == 1 for name, _ in CHECKS)


def run(*words):
    """The verb, as `falconwing firmware WORDS`."""
    return main(["firmware", *words])


@TOOLS
def test_the_shipped_program_keeps_its_promises(capsys):
    """In the simulated chip; and the answer says that it is simulated."""
    assert run("test", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert (
        record["passed"] and len(record["checks"]) == len(CHECKS) and "simulated" in record["board"]
    )


@TOOLS
def test_the_program_is_built_within_its_budget(tmp_path, capsys):
    """Sizes by avr-size; the hex has as many bytes as the flash, by its own record lengths."""
    assert run("build", "--out", str(tmp_path), "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert 1000 < record["flash_bytes"] < FLASH_BUDGET and 100 < record["ram_bytes"] < RAM_BUDGET
    lines = (tmp_path / "trainer_bridge.hex").read_text().split()
    assert sum(int(line[1:3], 16) for line in lines if line[7:9] == "00") == record["flash_bytes"]
    assert sorted(os.listdir(tmp_path)) == ["trainer_bridge.elf", "trainer_bridge.hex"]


@TOOLS
def test_the_table_says_how_to_flash(tmp_path, capsys):
    """With the propeller off."""
    assert run("build", "--out", str(tmp_path)) == 0
    out = capsys.readouterr().out
    assert (
        "propeller off" in out
        and "avrdude" in out
        and out.splitlines()[-1] == "next: falconwing firmware test"
    )


@TOOLS
def test_a_failed_check_is_the_answer_no(monkeypatch, capsys):
    """Exit code 1, and the row says so."""
    from falconwing_kit.tools.bridge import simulated_board

    broken = configured(host_timeout_ms=400)
    broken.kind = PythonBoard.kind
    monkeypatch.setattr(simulated_board, "SimulatedBoard", broken)
    assert run("test") == 1
    assert "FAILED" in capsys.readouterr().out


def test_missing_tools_are_one_sentence(monkeypatch, capsys, tmp_path):
    """What to install; exit code 2."""
    from falconwing_kit.tools.bridge import build

    monkeypatch.setattr(build, "missing_tools", lambda: ["gcc-avr"])
    assert run("build", "--out", str(tmp_path)) == 2
    assert "sudo apt install gcc-avr" in capsys.readouterr().err
