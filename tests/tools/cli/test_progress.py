"""Progress of a long verb: a stage that computes for a minute is not silent."""

import io
import time

import pytest

from falconwing_kit.tools.cli import progress
from falconwing_kit.tools.cli.demo import STAGES
from falconwing_kit.tools.cli.progress import StageProgress

TWO = (("fit", 0.25), ("figures", 0.9))


class Clock:
    """A clock that a test sets [s]."""

    def __init__(self):
        self.t = 0.0

    def __call__(self):
        return self.t


class Terminal(io.StringIO):
    """A stream that is a terminal."""

    def isatty(self):
        return True


@pytest.fixture
def clock():
    return Clock()


def test_lines_come_at_least_every_ten_seconds_and_not_more_often(clock):
    """By hand, ticks every half second for 35 s: lines at 10, 20 and 30 s."""
    told = io.StringIO()
    shown = StageProgress("demo", TWO, told, clock)
    shown("approach")
    for tick in range(71):
        clock.t = 0.5 * tick
        shown.tick()
    assert told.getvalue() == "".join(f"demo: 0 %, {t} s: approach\n" for t in (10, 20, 30))


def test_share_never_falls_and_gives_the_time_left(clock):
    """By hand: 25 % done after 20 s leave 60 s, and 10 s later at this rate 37.5 % and 50 s; before
    the next stage, at 90 %, it stays below 25 + 0.9 * 65 = 83.5 %.
    """
    told = io.StringIO()
    shown = StageProgress("demo", TWO, told, clock)
    clock.t = 20.0
    shown("fit of the model")
    assert told.getvalue() == "demo: 25 %, 20 s, about 60 s left: fit of the model\n"
    clock.t = 30.0
    shown("another stage")
    assert "demo: 38 %, 30 s, about 50 s left: another stage" in told.getvalue()
    clock.t = 2000.0
    assert shown.line() == "demo: 84 %, 2000 s, about 400 s left: another stage"
    clock.t = 30.0
    shown("figures")
    shown("fit of another")
    assert shown.line() == "demo: 90 %, 30 s, about 10 s left: fit of another"


def test_terminal_has_one_line_that_is_cleared(clock, capsys):
    """Each text returns to the line's begin and covers the longer one before; nothing stays."""
    told = Terminal()
    shown = StageProgress("demo", TWO, told, clock)
    shown("a long name of a stage")
    shown("fit")
    shown.write("landed")
    first, second, empty, _ = told.getvalue().split("\r")[1:]
    assert first.rstrip() == "demo: 0 %, 0 s: a long name of a stage"
    assert second.rstrip() == "demo: 25 %, 0 s, about 10 s left: fit"
    assert len(second) >= len(first) and empty == " " * len(second.rstrip())
    assert capsys.readouterr().out == "landed\n"


def test_busy_stage_is_reported_from_a_thread(monkeypatch):
    """The thread ticks while this one sleeps, and ends with the block."""
    monkeypatch.setattr(progress, "PERIOD_S", 0.1)
    monkeypatch.setattr(StageProgress.tick, "__defaults__", (0.1,))
    told = io.StringIO()
    with StageProgress("demo", TWO, told) as shown:
        shown("fit")
        end = time.monotonic() + 20.0
        while told.getvalue().count("fit") < 2 and time.monotonic() < end:
            time.sleep(0.1)
    count = told.getvalue().count("\n")
    assert count >= 2
    time.sleep(0.7)
    assert told.getvalue().count("\n") == count


def test_stages_of_the_demo_rise():
    """A share is a part of the whole; they are listed in their order."""
    shares = [share for _, share in STAGES]
    assert shares == sorted(set(shares)) and shares[0] == 0.0 and shares[-1] < 1.0
