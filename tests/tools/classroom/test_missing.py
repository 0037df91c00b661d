"""What is missing: refusals and limits at once; a whole study is in tests/benchmarks."""

import pytest

from falconwing_kit.core.flight_log import FlightLogWriter, read_flight_log
from falconwing_kit.gap.study import require_pair
from falconwing_kit.tools.classroom import missing
from falconwing_kit.tools.classroom.missing import answer_sentence, calm_flight, simulate_laps
from falconwing_kit.tools.classroom.results import FlightRecord, name_missing
from tests.tools.classroom.flights import fly_log


@pytest.fixture(scope="module")
def laps():
    """Calm laps of 21 s."""
    return simulate_laps(21.0, 5)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache folder."""
    monkeypatch.setattr(missing, "cache_folder", lambda: tmp_path)
    return tmp_path


def test_a_short_landing_is_told_what_to_fly(tmp_path):
    """A few seconds name nothing; the sentence says how long they were, and what to fly."""
    path = tmp_path / "x.mcap"
    record, _ = fly_log(path)
    answer = name_missing(record, None)
    assert answer["verdict"] == "too short" and answer["effects"] == []
    t = read_flight_log(path).state_times
    assert f"lasted {t[-1] - t[0]:.1f} s" in answer["sentence"] and "fly laps" in answer["sentence"]


def test_calm_flight_is_flown_once_and_is_fit_for_gap(cache, laps, monkeypatch):
    """Simulated, kept, and read back the next time; two of them pass the study's own checks."""
    monkeypatch.setattr(missing, "simulate_laps", lambda seconds, seed: laps)
    first = calm_flight(21.0)
    (kept,) = (cache / "classroom").iterdir()
    stamp = kept.stat().st_mtime_ns
    again = calm_flight(21.0)
    assert kept.stat().st_mtime_ns == stamp
    assert again.p_world == pytest.approx(first.p_world, abs=1e-4)
    require_pair(first, again)


def test_laps_with_an_effect_differ_from_calm_ones():
    """Wind of 0.5 m/s that the autopilot's feedback cannot hide, at equal seeds and noise."""
    calm = simulate_laps(3.0, 5)
    windy = simulate_laps(3.0, 5, {"wind": {"wind_x": 0.0, "wind_y": 0.5}})
    assert abs(windy.p_world - calm.p_world).max() > 0.1


def test_a_study_that_takes_too_long_is_ended(laps, tmp_path, monkeypatch):
    """The process is killed at the limit; one sentence."""
    path = tmp_path / "x.mcap"
    _log_of(path, laps)
    monkeypatch.setattr(missing, "calm_flight", lambda: laps)
    record = FlightRecord(3, path, "landing", "", "arena", 1, "expert", (), ())
    told = []
    answer = missing.name_missing(record, None, told.append, limit_s=0.2)
    assert answer["verdict"] == "failed" and "took longer" in answer["sentence"]
    assert told[0] == "the calm flight"


@pytest.mark.parametrize("is_named", [True, False])
def test_a_first_answer_is_given_when_the_time_is_over(is_named, laps, monkeypatch):
    """A study that named the effect and then goes on: its name, said to be the first answer."""
    first = {"verdict": "named", "effects": ["wind"], "parameters": {}, "headline": "Missing: wind"}

    class Pipe:
        """The study's end of the pipe: perhaps one message, then silence."""

        messages = [("first", first)] if is_named else []

        def poll(self, seconds):
            return bool(self.messages)

        def recv(self):
            return self.messages.pop()

        def close(self):
            pass

    class Context:
        """Starts nothing."""

        def Pipe(self):
            return Pipe(), Pipe()

        def Process(self, **arguments):
            return self

        def start(self):
            pass

        kill = join = start

    monkeypatch.setattr(missing.multiprocessing, "get_context", lambda kind: Context())
    answer = missing._study_in_process(laps, laps, lambda stage: None, 9.0, 0.0)
    if is_named:
        assert answer["effects"] == ["wind"] and answer["parameters"] == {}
        assert answer["sentence"].startswith("Not finished")
        assert answer["sentence"].endswith("without sizes, is: Missing: wind.")
    else:
        assert answer["verdict"] == "failed" and answer["effects"] == []


def test_answer_names_sizes_and_the_next_flight():
    """Sizes with their intervals; where the verdict is open, what to fly next."""
    report = {
        "headline": "Missing: wind", "verdict": "named", "next_flight": "fly circles",
        "parameters": {"wind_y": {"value": 0.98, "low95": 0.9, "high95": 1.06, "unit": "m/s"}},
    }  # fmt: skip
    assert answer_sentence(report) == "Missing: wind (wind y 0.98 m/s, 95 %: 0.9 to 1.06)."
    open_report = {**report, "verdict": "ambiguous", "parameters": {}, "headline": "A or B"}
    assert answer_sentence(open_report) == "A or B. fly circles."


def test_a_log_without_states_is_one_sentence(tmp_path):
    """Nothing to compare."""
    path = tmp_path / "x.mcap"
    with FlightLogWriter(path) as log:
        log.metadata({"task": "landing"})
    record = FlightRecord(3, path, "landing", "", "arena", 1, "expert", (), ())
    assert "no states" in name_missing(record)["sentence"]


def _log_of(path, table):
    """A log with the states and commands of a table."""
    from falconwing_kit.core.messages import Command, State

    with FlightLogWriter(path) as log:
        for t, p, a, c in zip(table.t, table.p_world, table.attitude, table.commands, strict=True):
            log.command(t, Command(*c.tolist()))
            log.state(t, State(p, a[1], a[2], a[0], p * 0.0))
