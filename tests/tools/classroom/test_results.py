"""A log is flown again: same states, same verdict as live; changed logs are refused."""

import math
from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_log import FlightLogWriter, read_flight_log
from falconwing_kit.core.messages import Command, State
from falconwing_kit.flight.world import Contact
from falconwing_kit.tools.classroom import results
from falconwing_kit.tools.classroom.results import (
    AUTOPILOT,
    STUDENT,
    flight_data,
    judge,
    longest_run,
    record_of_log,
    refly,
)
from tests.tools.classroom.flights import edit_log, fly_log

WIND = {"wind_x": 0.0, "wind_y": 1.0}


@pytest.fixture(scope="module")
def landing(tmp_path_factory):
    """A landing in which Mia holds the sticks from 1 s on, with its live measures."""
    path = tmp_path_factory.mktemp("landing") / "flight.mcap"
    return fly_log(path, hands=[(0.0, "autopilot", "expert"), (1.0, "student", "Mia")])


@pytest.fixture(scope="module")
def follow(tmp_path_factory):
    """Following with an aileron that is held nearly to the right, so that the leader is lost."""
    path = tmp_path_factory.mktemp("follow") / "flight.mcap"
    hands = [(0.0, "student", "Ali"), (1.0, "autopilot", "expert"), (1.5, "student", "Mia")]
    return fly_log(path, "follow", bend=1.2, hands=hands)


def test_flying_again_reproduces_the_logged_states(landing):
    """A simulation has no chance in it: the same commands give the same bits; 1e-9 is for the
    text of the log's numbers.
    """
    flight = refly(landing[0])
    assert flight.difference < 1e-9 and not flight.refused
    assert len(flight.t) == len(read_flight_log(landing[0].log).states)


def test_measures_are_those_of_the_live_judge(landing, follow):
    """The task's own judge watched the flight while it was flown."""
    for record, live in (landing, follow):
        assert refly(record).measures == live
        assert judge(record).success == live["success"]


def test_sentence_of_a_landing_has_the_judges_numbers(landing):
    """Place and sink rate from the live judge, in centimetres and m/s."""
    record, live = landing
    verdict = judge(record)
    side = "left" if live["lateral_offset_m"] > 0 else "right"
    offset = 100.0 * live["ald_m"]
    assert verdict.sentence == (
        f"on the pad, {offset:.0f} cm {side} of the centre line, {live['sink_rate_m_s']:.2f} m/s"
        " down"
    )
    assert verdict.numbers["off the centre line"] == (pytest.approx(offset), "cm")


def test_score_belongs_to_who_held_the_sticks_at_the_touchdown(landing):
    """Mia flew the end; the autopilot before her has no score."""
    (score,) = judge(landing[0]).scores
    assert (score.name, score.task, score.unit) == ("Mia", "landing", "cm")
    flight = refly(landing[0])
    assert [flight.holder[flight.t < 0.99].max(), flight.holder[-1]] == [AUTOPILOT, STUDENT]


def test_longest_lock_is_counted_while_a_person_flies(follow):
    """Ali had the sticks for 20 steps of 50 ms with the leader in view from the start: 1 s."""
    record, live = follow
    assert not live["success"] and 0.0 < live["locked_share"] < 1.0
    verdict = judge(record)
    assert f"in view of the camera {100 * live['locked_share']:.0f} % of" in verdict.sentence
    scores = {score.name: score.value for score in verdict.scores}
    assert scores["Ali"] == pytest.approx(1.0)
    assert "expert" not in scores


def test_longest_run_by_hand():
    """Three neighbours are the most."""
    assert longest_run(np.array([1, 1, 0, 1, 1, 1, 0], bool)) == 3
    assert longest_run(np.zeros(4, bool)) == 0


@pytest.mark.parametrize(
    "point, text",
    [
        ((1.0 - 3.1, -2.0, 0.0), "touched the floor 3.1 m short of the pad"),
        ((14.0 + 0.4, -2.0, 0.0), "touched the floor 0.4 m past the pad"),
        ((5.0, -1.0 + 0.5, 0.0), "touched the floor 0.5 m left of the pad"),
        ((5.0, -3.0 - 0.25, 0.0), "touched the floor 0.2 m right of the pad"),
    ],
)
def test_a_miss_is_measured_from_the_pads_nearest_side(point, text):
    """The pad lies at x 1..14 m and y -3..-1 m, left is +y; distances by hand."""
    assert results._miss_text(np.array(point), "floor", LandingPad()) == text


def test_every_collision_has_a_sentence():
    """All obstacles of the world."""
    for obstacle in ("pad", "pad edge", "floor", "wall", "ceiling", "leader"):
        assert results._collision_text(Contact(1.0, obstacle, np.zeros(3)))


def test_effects_switched_in_flight_act_from_their_event_on(tmp_path):
    """Wind from 0.5 s and off again at 2 s: flown again with it, the states agree; without the
    events they part by more than 2 cm (wind of 1 m/s for 1.5 s).
    """
    effects = [(0.5, "wind", True, WIND), (2.0, "wind", False, {})]
    record, live = fly_log(tmp_path / "wind.mcap", effects=effects)
    flight = refly(record)
    assert flight.difference < 1e-9 and judge(record).success == live["success"]
    assert judge(record).scores == ()  # the autopilot landed, and it has no place on the board

    def calm(topic, values):
        if topic == "/event" and values["name"] == "effect":
            values["name"] = "nothing"

    edited = replace(record, log=edit_log(record.log, tmp_path / "calm.mcap", calm))
    assert refly(edited).difference > 0.02
    assert refly(edited).differs_at == pytest.approx(0.55, abs=0.11)


def test_a_switch_noted_at_the_end_of_its_step_is_found_too(tmp_path):
    """The event says 0.55 s where the effect acted from 0.5 s on: the earlier step fits."""
    record, _ = fly_log(tmp_path / "wind.mcap", effects=[(0.5, "wind", True, WIND)])

    def late(topic, values):
        if topic == "/event" and values["name"] == "effect":
            values["t"] = 0.55

    assert not refly(replace(record, log=edit_log(record.log, tmp_path / "x.mcap", late))).refused


def test_a_camera_effect_is_in_the_measured_states(tmp_path):
    """A camera tilt, in the form with a yaw, changes what is measured: the states agree with it."""
    tilt = {"mount_pitch": math.radians(3.0), "mount_yaw": math.radians(2.0)}
    record, _ = fly_log(tmp_path / "tilt.mcap", effects=[(0.5, "camera_tilt", True, tilt)])
    assert refly(record).difference < 1e-9


def test_changed_commands_are_not_judged(landing, tmp_path):
    """A log whose elevator was bettered by 0.1 does not lead to its own states."""

    def better(topic, values):
        if topic == "/command":
            values["elevator"] = min(1.0, values["elevator"] + 0.1)

    edited = replace(landing[0], log=edit_log(landing[0].log, tmp_path / "x.mcap", better))
    verdict = judge(edited)
    assert verdict.success is None and not verdict.reproduced and not verdict.scores
    assert "the log was changed" in verdict.sentence


def test_changed_states_are_not_judged(landing, tmp_path):
    """One state moved by 1 cm."""

    def move(topic, values):
        if topic == "/state" and abs(values["t"] - 2.0) < 0.01:
            values["py"] += 0.01

    edited = replace(landing[0], log=edit_log(landing[0].log, tmp_path / "x.mcap", move))
    assert not judge(edited).reproduced
    assert refly(edited).differs_at == pytest.approx(2.0)


def test_another_seed_is_not_judged(landing):
    """The log says which start it had."""
    assert "seed" in judge(replace(landing[0], seed=landing[0].seed + 1)).sentence


@pytest.mark.parametrize(
    "metadata, text", [({"simulated": "no"}, "real aircraft"), ({"port": "sim"}, "trainer port")]
)
def test_what_cannot_be_flown_again_is_said(tmp_path, metadata, text):
    """No verdict where there is no truth, and still data to look at."""
    record, _ = fly_log(tmp_path / "x.mcap", duration=1.0, metadata=metadata)
    verdict = judge(record)
    assert verdict.success is None and text in verdict.sentence
    assert len(flight_data(record)["t"]) == 20


def test_a_logged_start_replaces_the_drawn_one(landing, tmp_path):
    """The classroom names the start; 12 numbers, and one sentence for anything else."""
    log = read_flight_log(landing[0].log)
    start = refly(landing[0]).states[0].tolist()
    for text, good in ((str(start), True), ("[1, 2]", False)):
        path = tmp_path / f"{good}.mcap"
        with FlightLogWriter(path) as writer:
            writer.metadata({**log.metadata, "start": text})
            for t, command, state in zip(log.state_times, log.commands, log.states, strict=False):
                writer.command(t, command)
                writer.state(t, state)
        record = replace(landing[0], log=path)
        if good:
            assert refly(record).difference < 1e-9
        else:
            with pytest.raises(InputError, match="12 numbers"):
                judge(record)


def test_record_of_a_log_is_that_of_the_flight(landing):
    """Task, seed, scene and who flew, from the log alone."""
    record = record_of_log(landing[0].log)
    assert (record.task, record.seed, record.scene) == ("landing", landing[0].seed, "arena")
    assert "Mia" in record.holders
    assert judge(record) == judge(landing[0])


def test_player_data_are_finite_json_of_one_length(landing):
    """The interface: one row for each 50 ms, rounded, poses as x y z roll pitch yaw."""
    import json

    data = json.loads(json.dumps(flight_data(landing[0]), allow_nan=False))
    n = len(data["t"])
    for key in ("pose", "speed", "command", "holder"):
        assert len(data[key]) == n
    assert len(data["ghost"]["pose"]) == len(data["ghost"]["distance"]) == n
    truth = refly(landing[0]).states
    row = data["pose"][20]
    assert row[:3] == pytest.approx(truth[20, :3], abs=6e-4)
    assert row[3:] == pytest.approx(truth[20, [5, 3, 4]], abs=6e-5)
    assert data["simulated"] is True and data["seed"] == landing[0].seed
    assert any("Mia flies" in event["text"] for event in data["events"])


def test_a_log_without_states_is_one_sentence(tmp_path):
    """Nothing to draw."""
    path = tmp_path / "x.mcap"
    with FlightLogWriter(path) as log:
        log.metadata({"simulated": "yes", "task": "landing", "seed": 10_000})
        log.command(0.0, Command(0.5, 0.0, 0.0, 0.0))
    record = record_of_log(path)
    assert judge(record).success is None
    assert isinstance(State, type)


def test_a_log_of_another_kind_is_one_sentence(tmp_path):
    """No MCAP, no file."""
    path = tmp_path / "x.mcap"
    path.write_bytes(b"not a log")
    with pytest.raises(InputError, match="MCAP"):
        record_of_log(path)
    with pytest.raises(FileNotFoundError):
        record_of_log(tmp_path / "none.mcap")
