"""The sequential tests against their formulas, the stream against what loggers do, the watch."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import slice_time
from falconwing_kit.gap.innovations import AXES, Row, filter_rows, table_rows
from falconwing_kit.gap.watch import (
    ChangeTests,
    Monitor,
    Watch,
    build_monitor,
    cusum,
    cusum_run_length,
    return_level,
    spread_score,
    stream_rows,
    watch_rows,
)
from falconwing_kit.sysid.fit import Prior
from falconwing_kit.sysid.prepare import prepare
from tests.gap.free_body import DT, FREE_BODY, WHITE, falling_rows, noise
from tests.gap.studies import own_aircraft, own_flight, shipped
from tests.sysid.simulated import MARKER

HEADER = b"t,px,py,pz,roll,pitch,yaw,throttle,aileron,elevator,rudder\n"


def free_monitor(step: float = 12.0, spread: float = 12.0) -> Monitor:
    """A monitor of the free body; naming is replaced in these tests."""
    base = SimpleNamespace(result=SimpleNamespace(model=FREE_BODY), parameter_prior=None)
    return Monitor(base, noise(), step, spread, 3600.0)  # type: ignore[arg-type]


def verdict(kind: str, *effects: str) -> SimpleNamespace:
    """What naming returns, as far as the watch reads it."""
    chosen = tuple(SimpleNamespace(effect=SimpleNamespace(name=e), delta_bic=50.0) for e in effects)
    return SimpleNamespace(verdict=kind, chosen=chosen, ranking=chosen)


# ---- Sequential tests


def test_run_length_is_that_of_the_tables():
    """One-sided CUSUM with k = 0.5: 336 samples at h = 4 and 930 at h = 5, twice the two-sided 168
    and 465 of Montgomery, Statistical Quality Control, table 9.3.
    """
    assert cusum_run_length(0.5, 4.0) == pytest.approx(336.0, rel=0.02)
    assert cusum_run_length(0.5, 5.0) == pytest.approx(930.0, rel=0.02)


def test_false_alarms_of_the_cusum_on_white_noise():
    """By that formula: 118.6 samples at k = 0.5, h = 3. 100,000 samples give some 840 alarms,
    3.5 % of scatter.
    """
    g, alarms, count = 0.0, 0, 100_000
    for score in (np.random.default_rng(1).normal(size=count) - 0.5).tolist():
        g = cusum(g, score)
        if g > 3.0:
            g, alarms = 0.0, alarms + 1
    assert count / alarms == pytest.approx(cusum_run_length(0.5, 3.0), rel=0.1)


def test_spread_score_falls_without_change_and_rises_with_twice_the_covariance():
    """By hand, k = 2 and m = 6: chi2 has mean 6, so (6 / 2 - 6 ln 2) / 2 = -0.579; with twice the
    covariance 12, so (12 / 2 - 6 ln 2) / 2 = 0.921.
    """
    assert spread_score(6.0, 6) == pytest.approx(-0.579, abs=1e-3)
    assert spread_score(12.0, 6) == pytest.approx(0.921, abs=1e-3)


def test_threshold_is_the_return_level_of_a_gumbel_distribution():
    """Maxima of 3 s blocks drawn from Gumbel(5, 1.5): once an hour 5 + 1.5 ln 1200 = 15.6."""
    rng, count = np.random.default_rng(2), 2000
    t = np.arange(count) * 3.0 + 1.0
    level = return_level(t, rng.gumbel(5.0, 1.5, count), 3600.0)
    assert level == pytest.approx(15.6, rel=0.05)
    with pytest.raises(InputError, match="expected at least 26 s"):
        return_level(t[:5], np.ones(5), 3600.0)


def test_step_test_finds_axis_size_and_onset():
    """A body pushed down by 1.5 m/s^2 since 6 s: the estimate has the statistic's own standard
    error, size / sqrt(2 statistic); an onset is tried every 0.25 s.
    """
    tests, values = ChangeTests(12), []
    rows = falling_rows(160, np.random.default_rng(3), force_down=1.5, onset=6.0)
    for step in filter_rows(FREE_BODY, noise(), rows):
        if (value := tests.update(step)) is not None:
            values.append(value)
    before = max(v.step for v in values if v.t < 6.0)
    last = values[-1]
    assert AXES[last.axis] == "force down"
    assert last.step > 2.0 * before
    assert last.size == pytest.approx(1.5, abs=3.0 * last.size / np.sqrt(2.0 * last.step))
    assert last.onset == pytest.approx(6.0, abs=0.5)
    assert any(v.step > 12.0 and v.t < 7.5 for v in values)


def test_step_statistic_is_half_a_chi2():
    """By law: c^2 J of one onset and axis is chi2 with one degree of freedom. 16 flights
    of 6 axes: mean 1 with a standard error of 0.14.
    """
    found = []
    for seed in range(16):
        tests = ChangeTests(12)
        rows = falling_rows(80, np.random.default_rng(100 + seed))
        for step in filter_rows(FREE_BODY, noise(), rows):
            tests.update(step)
        found.append(tests._b[0] ** 2 / tests._J[0])
    assert np.mean(found) == pytest.approx(1.0, abs=0.42)


def test_drift_of_another_day_is_no_alarm():
    """By the formula c^2 / (2 (1/J + s^2)): with a drift s of 4 m/s^2, and c up to twice the true
    2 m/s^2 at wrong onsets, some 4^2 / (2 4^2) = 0.5; without drift it grows with J.
    """
    rows = falling_rows(160, None, force_down=2.0, onset=3.0)
    steps = filter_rows(FREE_BODY, noise(), rows)
    last = []
    for drift in (0.0, 4.0):
        tests = ChangeTests(12)
        values = [tests.update(replace(step, drift=np.full(6, drift))) for step in steps]
        last.append(max(v.step for v in values[-20:] if v is not None))
    assert last[0] > 30.0
    assert last[1] < 2.0


# ---- Streams


def line(t: float, *cells: str) -> bytes:
    words = cells or ("1", "2", "3", "0.1", "0.1", "0.2", "0.4", "0", "0.1", "0")
    return (",".join([f"{t:g}", *words]) + "\n").encode()


def test_stream_survives_what_loggers_do():
    """Empty cells and nan, an empty line, a damaged line, other column orders, and the end of the
    stream within a row.
    """
    warnings: list[str] = []
    lines = [
        b"source," + HEADER.strip() + b",vx\n",
        b"a,0,1,2,3,,nan,0.2,0.4,0,0.1,0,7\n",
        b"\n",
        b"a,0.05,1,2,three,0.1,0.1,0.2,0.4,0,0.1,0,7\n",
        b"a,0.1,1,2\n",
        b"a,0.15,1,2,inf,0.1,0.1,0.2,0.4,0,0.1,1.05,7\n",
        b"a,0.2,1,2,3,0.1,0.1,0.2,0.4,0,0.1,0,7",
    ]
    rows = list(stream_rows(lines, warnings.append))
    assert [row.t for row in rows] == [0.0, 0.15]
    assert np.isnan(rows[0].pose[[3, 4]]).all() and rows[0].pose[5] == 0.2
    assert np.isnan(rows[1].pose[2]) and rows[1].commands[3] == 1.0
    assert rows[0].motion[0] == 7.0 and np.isnan(rows[0].motion[1:]).all()
    assert [text.split(" is")[0] for text in warnings] == ["line 4", "line 5", "line 7"]


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([b""], "an empty line"),
        ([b"t,x,y\n"], "expected a header with the columns px"),
        ([HEADER, *(line(50.0 * k) for k in range(20))], "divide the column t by 1000"),
        ([HEADER, line(0, *["1"] * 3, "40", "3", "0", "0.4", "0", "0", "0")], "degrees"),
        ([HEADER, line(0, *["1"] * 6, "1500", "1500", "1500", "1500")], "microseconds"),
        ([HEADER, *[b"noise\n"] * 25], "21 lines in a row"),
    ],
)
def test_streams_that_are_no_flight_are_refused(lines, words):
    """One sentence with the likely cause."""
    with pytest.raises(InputError, match=words):
        list(stream_rows(lines))


# ---- Watch


def test_alarm_then_not_enough_flight_then_a_name():
    """The order of events, and their times: names are tried 10 and 20 s after the onset."""
    verdicts = [verdict("ambiguous", "wind", "flap"), verdict("named", "flap")]
    tried = []

    def name(base, table, catalogue):
        tried.append((table.t[0], table.t[-1]))
        return verdicts.pop(0)

    rows = falling_rows(560, None, force_down=3.0, onset=5.0)
    watch = Watch(free_monitor(), name=name)
    alarm, wait, found = watch_rows(watch, rows)
    assert (alarm.kind, wait.kind, found.kind) == ("alarm", "wait", "name")
    assert 5.0 < alarm.t < 6.0 and alarm.details["onset"] == pytest.approx(5.0, abs=0.5)
    assert alarm.details["axis"] == "force down" and "m/s^2" in alarm.text
    assert "not enough flight yet" in wait.text and "wind, flap" in wait.text
    assert found.details["effects"] == ["flap"] and watch.named
    onset = alarm.details["onset"]
    assert [t1 - t0 for t0, t1 in tried] == pytest.approx([10.0, 20.0], abs=0.2)
    assert all(t0 == pytest.approx(onset, abs=DT) for t0, _ in tried)


def test_end_soon_after_the_alarm_is_not_enough_flight():
    """Eight seconds after the onset are needed; nothing is named on less."""
    rows = falling_rows(180, None, force_down=3.0, onset=5.0)
    alarm, wait = watch_rows(Watch(free_monitor(), name=lambda *how: 1 / 0), rows)
    assert alarm.kind == "alarm" and wait.kind == "wait"
    assert wait.text.startswith("not enough flight for a name: ")


def test_no_alarm_without_a_change_whatever_the_rows_lack():
    """Poses and commands of nan, times that stand still or go back, jitter, a gap of 3 s."""
    rng, rows = np.random.default_rng(6), falling_rows(400, np.random.default_rng(5))
    rows = [row._replace(t=row.t + rng.uniform(-5e-5, 5e-5)) for row in rows]
    for k in rng.integers(20, 400, 60):
        rows[k] = rows[k]._replace(pose=np.full(6, np.nan))
    rows[0] = rows[0]._replace(commands=np.full(4, np.nan))
    rows[50] = rows[50]._replace(commands=np.full(4, np.nan))
    rows = [*rows[:100], rows[99], rows[40], *rows[100:200], *rows[260:]]
    rows.insert(120, rows[120]._replace(t=np.nan))
    watch = Watch(free_monitor(20.0, 20.0))
    events = list(watch_rows(watch, rows))
    assert watch.alarm is None and watch.skipped == 3
    assert [event.kind for event in events] == ["gap"]
    assert np.isfinite(watch.flight.commands).all()


def test_a_name_that_cannot_be_computed_is_said():
    """Poses end after the alarm: the reason is passed on, and the watch goes on."""
    rows = falling_rows(400, None, force_down=3.0, onset=5.0)

    def refuse(*how):
        raise InputError("stream: expected at least 3 s of poses without a break, found none")

    events = list(watch_rows(Watch(free_monitor(), name=refuse), rows))
    assert [event.kind for event in events] == ["alarm", "wait", "wait"]
    assert events[1].text == (
        "no name yet: stream: expected at least 3 s of poses without a break, found none"
    )


def test_thrust_loss_raises_an_alarm_and_a_calm_flight_none():
    """The kit's aircraft, its model known exactly, noise and thresholds from 40 s of baseline; 40 %
    of the thrust missing slow it down at once. Simulated.
    """
    model, calm = own_aircraft(), own_flight(None, 40.0, 21)
    sigma = {n: 0.01 * abs(v) for n, v in model.values.items()}
    base = SimpleNamespace(
        result=SimpleNamespace(model=model),
        noise=WHITE,
        found=SimpleNamespace(sigma=np.repeat(MARKER, 3), prepared=(prepare(calm),)),
        parameter_prior=Prior(dict(model.values), sigma),
    )
    monitor = build_monitor(base, [calm])  # type: ignore[arg-type]

    def events(table):
        watch = Watch(monitor, name=lambda *how: verdict("named", "thrust_loss"))
        return list(watch_rows(watch, table_rows(table)))

    assert events(own_flight(None, 20.0, 22)) == []
    alarm, name = events(own_flight("thrust_loss", 15.0, 23, thrust_lost=0.4))
    assert alarm.kind == "alarm" and alarm.t < 4.0
    assert name.details["effects"] == ["thrust_loss"]


def test_rows_of_other_rates_are_the_same_flight():
    """A log at 200 Hz with poses at 20 Hz raises the same alarm as one at 20 Hz."""
    rows = falling_rows(200, None, force_down=3.0, onset=5.0)
    fast = []
    for row in rows:
        fast += [row, *(row._replace(t=row.t + k * 0.005, pose=np.full(6, np.nan)) for k in
                        range(1, 10))]  # fmt: skip
    slow, quick = (Watch(free_monitor(), name=lambda *how: verdict("none")) for _ in range(2))
    list(watch_rows(slow, rows)), list(watch_rows(quick, fast))
    assert slow.alarm is not None and quick.alarm is not None
    assert quick.alarm.t == pytest.approx(slow.alarm.t, abs=1e-9)
    assert replace(slow.alarm, t=0.0).kind == "alarm"


def test_a_row_type_holds_what_a_table_does():
    """Columns of a table come back from its rows."""
    table = slice_time(shipped("case08_calm"), 0.0, 1.0)
    row = next(table_rows(table))
    assert isinstance(row, Row) and row.t == table.t[0]
    assert row.pose == pytest.approx([*table.p_world[0], *table.attitude[0]])
