"""Metadata of a flight's log: what it takes to show the flight again and to judge it again."""

import json
from dataclasses import replace

import numpy as np
import pytest

import falconwing_kit
from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.core.flight_log import FlightLogWriter, read_flight_log
from falconwing_kit.flight.metadata import describe_model, flight_metadata
from falconwing_kit.flight.tasks import FollowTask, LandingTask, trial_seed

KEYS = {
    "simulated", "task", "manoeuvre", "scene", "seed", "pilot", "aircraft", "model", "kit_version",
    "start", "port", "p_body_camera",
}  # fmt: skip


@pytest.mark.parametrize(
    ("task", "name", "manoeuvre"),
    [
        (LandingTask(), "landing", ""),
        (FollowTask("right_turn_sharp_climb"), "follow", "right_turn_sharp_climb"),
    ],
)
def test_a_log_says_what_was_flown(tmp_path, task, name, manoeuvre):
    """The world made again from task, manoeuvre and seed of the log starts where the log says."""
    trial = task.trial(trial_seed(3, 1))
    with FlightLogWriter(tmp_path / "a.mcap") as log:
        log.metadata(flight_metadata(task, trial, scene="hall", pilot="expert", port="sim"))
    found = read_flight_log(tmp_path / "a.mcap").metadata
    assert set(found) == KEYS
    assert (found["task"], found["manoeuvre"], found["seed"]) == (name, manoeuvre, "20003")
    assert (found["scene"], found["pilot"], found["port"]) == ("hall", "expert", "sim")
    assert (found["simulated"], found["kit_version"]) == ("yes", falconwing_kit.__version__)
    assert found["aircraft"] == task.airframe.name
    again = task.trial(int(found["seed"])).world.state.vector
    assert np.array_equal(json.loads(found["start"]), again)
    assert json.loads(found["p_body_camera"]) == list(task.airframe.p_body_camera)


def test_models_that_differ_have_different_texts():
    """One value changed by a part in a billion, or an effect added."""
    model = LandingTask().model
    name, value = next(iter(model.values.items()))
    other = replace(model, values={**model.values, name: value * (1.0 + 1e-9)})
    windy = model.with_effect(CATALOGUE[0])
    texts = [describe_model(m) for m in (model, other, windy, LandingTask().model, None)]
    assert len(set(texts)) == 4 and texts[0] == texts[3] and texts[4] == ""
    assert texts[0].startswith("rates; ") and texts[2].startswith(f"rates, {CATALOGUE[0].name}; ")
