"""falconwing watch: exit codes, one line an event, streams that end anywhere."""

import io
import json
from types import SimpleNamespace

import numpy as np
import pytest

from falconwing_kit.core.flight_table import REQUIRED_COLUMNS
from falconwing_kit.gap import Monitor, Row
from falconwing_kit.tools.cli import watch as verb
from falconwing_kit.tools.cli.main import main
from tests.gap.free_body import FREE_BODY, falling_rows, noise

HEADER = ",".join(REQUIRED_COLUMNS)


@pytest.fixture
def free_body(monkeypatch):
    """A monitor of a falling body in place of the identified one, whose tests are elsewhere."""
    base = SimpleNamespace(
        result=SimpleNamespace(model=FREE_BODY), prior=None, parameter_prior=None
    )
    monitor = Monitor(base, noise(), 20.0, 20.0, 3600.0)  # type: ignore[arg-type]
    monkeypatch.setattr(verb, "read_flight_table", lambda path: None)
    monkeypatch.setattr(verb, "identify", lambda tables, model: None)
    monkeypatch.setattr(verb, "build_nominal_model", lambda found: base)
    monkeypatch.setattr(verb, "build_monitor", lambda base, tables, seconds: monitor)


def csv_text(rows: list[Row]) -> str:
    """Rows as a logger writes them."""
    lines = [[row.t, *row.pose, *row.commands] for row in rows]
    return "\n".join([HEADER, *(",".join(f"{value:.9g}" for value in line) for line in lines), ""])


def stream(monkeypatch, text: str) -> None:
    """Standard input."""
    monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=io.BytesIO(text.encode())))


def test_calm_stream_exits_0_and_ends_with_next(free_body, monkeypatch, capsys):
    """DESIGN.md, section 6: 0 where nothing was found. The last row is cut off in the middle."""
    stream(monkeypatch, csv_text(falling_rows(80, np.random.default_rng(1)))[:-10])
    assert main(["watch", "-", "--calm", "calm.csv"]) == 0
    printed = capsys.readouterr()
    lines = printed.out.splitlines()
    assert "79 rows, 3.9 s: no alarm" in lines[-2] and "times faster than real time" in lines[-2]
    assert lines[-1] == "next: nothing to do; the aircraft flies as modelled"
    assert "line 81 is no row" in printed.err


def test_alarm_exits_1_and_json_is_one_object_a_line(free_body, monkeypatch, capsys):
    """The answer "no longer as modelled" is 1; too little flight for a name is said."""
    stream(monkeypatch, csv_text(falling_rows(160, None, force_down=3.0, onset=5.0)))
    assert main(["watch", "-", "--calm", "calm.csv", "--json"]) == 1
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [e["event"] for e in events] == ["start", "start", "alarm", "wait", "end"]
    alarm, wait, end = events[2:]
    assert 5.0 < alarm["t"] < 6.0 and alarm["axis"] == "force down"
    assert "not enough flight" in wait["text"]
    assert end["alarm"] == alarm["t"] and end["rows"] == 160


def test_interrupt_ends_with_the_summary(free_body, monkeypatch, capsys):
    """Ctrl-C is how a live watch ends; the exit code is that of what was found."""

    def lines():
        yield from csv_text(falling_rows(60, None)).encode().splitlines(keepends=True)
        raise KeyboardInterrupt

    monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=lines()))
    assert main(["watch", "-", "--calm", "calm.csv"]) == 0
    assert "interrupted; 60 rows" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["watch", "-"], "expected --calm CSV or --model MODEL, got neither"),
        (["watch", "-", "--calm", "no.csv"], "no.csv"),
        (["watch", "no.csv", "--calm", "no.csv"], "no.csv"),
        (["watch", "-", "--model", "no.toml"], "no.toml"),
    ],
)
def test_wrong_use_is_one_sentence(words, sentence, capsys):
    """Exit code 2."""
    assert main(words) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1 and sentence in said[0]


def test_header_that_is_none_is_wrong_use(free_body, monkeypatch, capsys):
    """The stream's first line names the columns."""
    stream(monkeypatch, "1,2,3\n4,5,6\n")
    assert main(["watch", "-", "--calm", "calm.csv"]) == 2
    assert "expected a header with the columns t, px" in capsys.readouterr().err
