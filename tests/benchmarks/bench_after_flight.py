"""After a flight of the class: seconds to the verdict from the log, to the player's data and to the
answer what is missing, and the size of the shared file.

    python -m pytest -m benchmark tests/benchmarks/bench_after_flight.py -s

Flights are simulated. Times are of this machine with whatever else runs on it.
"""

import os
import time

import pytest

from falconwing_kit.core.flight_log import FlightLogWriter
from falconwing_kit.core.messages import Command, State
from falconwing_kit.scene.arena import load_scene
from falconwing_kit.tools.classroom import missing
from falconwing_kit.tools.classroom.results import FlightRecord, flight_data, refly
from falconwing_kit.tools.classroom.scene_file import scene_bytes
from falconwing_kit.tools.classroom.share import LARGEST_BYTES, page_of_data
from tests.tools.classroom.flights import fly_log

ANSWER_S = 30.0  # that a class waits for the name of what is missing
EFFECTS = {
    "wind": {"wind_x": 0.0, "wind_y": 1.0},
    "extra_drag": {"drag_added": 0.02},
}


@pytest.mark.benchmark
def test_verdict_data_and_size(tmp_path, capsys):
    """A landing and a followed leader: flown again, drawn, shared; the file is small."""
    hall = scene_bytes(load_scene("arena"))
    fly_log(tmp_path / "compile.mcap")
    for task in ("landing", "follow"):
        record, _ = fly_log(tmp_path / f"{task}.mcap", task)
        begin = time.perf_counter()
        flight = refly(record)
        judged = time.perf_counter()
        data = flight_data(record)
        shown = time.perf_counter()
        size = len(page_of_data(data, hall).encode())
        with capsys.disabled():
            print(
                f"\n{task}, {len(flight.t) / 20:.1f} s flown: verdict {judged - begin:.2f} s, data"
                f" {shown - judged:.2f} s, shared file {size / 1e6:.2f} MB,"
                f" load {os.getloadavg()[0]:.1f}"
            )
        assert size <= LARGEST_BYTES


@pytest.mark.benchmark
@pytest.mark.parametrize("effect", EFFECTS)
def test_what_is_missing(effect, tmp_path, capsys):
    """Laps of 40 s by the autopilot alone against the simulated calm flight: the right name."""
    missing.calm_flight()
    table = missing.simulate_laps(40.0, 11, {effect: EFFECTS[effect]}, excitation=0.0)
    path = tmp_path / "flight.mcap"
    with FlightLogWriter(path) as log:
        for t, p, a, c in zip(table.t, table.p_world, table.attitude, table.commands, strict=True):
            log.command(t, Command(*c.tolist()))
            log.state(t, State(p, a[1], a[2], a[0], 0.0 * p))
    record = FlightRecord(1, path, "landing", "", "arena", 1, "expert", (), ())
    begin = time.perf_counter()
    answer = missing.name_missing(record, None, limit_s=600.0)
    seconds = time.perf_counter() - begin
    with capsys.disabled():
        print(
            f"\n{effect}: {answer['sentence']}\n{seconds:.0f} s (wanted {ANSWER_S:.0f} s), load"
            f" {os.getloadavg()[0]:.1f}"
        )
    assert effect in answer["effects"]
