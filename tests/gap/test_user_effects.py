"""A user's effects, one of each kind: hidden by their own draw, named by `gap --effects`.

No file of the kit knows these names; simulated flights, not measured ones.
"""

import json
from functools import cache
from pathlib import Path

import pytest

from falconwing_kit.aircraft import CATALOGUE, load_effects
from falconwing_kit.core.flight_table import write_flight_table
from falconwing_kit.gap import NominalModel, identify_baseline, name_effect, study
from falconwing_kit.tools.cli.main import main
from falconwing_kit.tools.trials.hidden import HiddenCase, hidden_flights

FILE = '''"""Four effects of a user, one of each kind."""

import numpy as np

from falconwing_kit.aircraft import Effect, Parameter


def thrust_line(air, K):
    """Thrust below the centre of gravity pitches the nose up: dq/dt = line T/m."""
    thrust = (K.kT - K.kTV * air.airspeed) * air.throttle
    return 0.0, 0.0, 0.0, 0.0, K.line * thrust, 0.0


def draught(px, py, height, time, K):
    """Wind across the hall that changes its side every 4 m along it."""
    return 0.0, K.draught_y * np.sin(np.pi * px / 4.0), 0.0


def mixer(t, commands, K):
    """The transmitter adds elevator with the square of aileron."""
    added = K.mix * commands[:, 1] ** 2
    return commands + added[:, None] * np.array([0.0, 0.0, 1.0, 0.0])


def marker_scale(pose, K):
    """The marker was printed at another size: positions are scaled."""
    return np.concatenate([pose[:3] * (1.0 + K.scale), pose[3:]])


EFFECTS = [
    Effect(
        name="thrust_line",
        physics="The thrust passes below the centre of gravity.",
        parameters=(Parameter("line", 0.1, -5.0, 5.0, "1/m", "pitching moment per thrust"),),
        loads=thrust_line,
        acts_on=("pitch",),
        separated_by={"throttle steps": "only thrust pitches the nose then"},
        note="check the motor mount with a ruler",
        sizes=(1.5, 1.6, 2.0),
        draw=lambda rng, size: {"line": size},
    ),
    Effect(
        name="draught",
        physics="Doors on both sides are open.",
        parameters=(Parameter("draught_y", 0.3, -5.0, 5.0, "m/s", "largest speed"),),
        wind_field=draught,
        acts_on=("air",),
        sizes=(0.6, 0.8, 1.0),
        draw=lambda rng, size: {"draught_y": size},
    ),
    Effect(
        name="mixer",
        physics="A mixer of the transmitter is on.",
        parameters=(Parameter("mix", 0.1, -2.0, 2.0, "-", "elevator per squared aileron"),),
        command_map=mixer,
        acts_on=("pitch",),
        sizes=(0.6, 0.7, 0.8),
        draw=lambda rng, size: {"mix": size},
    ),
    Effect(
        name="marker_scale",
        physics="The marker has another size than the camera assumes.",
        parameters=(Parameter("scale", 0.01, -0.3, 0.3, "-", "share added to each position"),),
        measurement_map=marker_scale,
        acts_on=("camera",),
        sizes=(0.05, 0.06, 0.08),
        draw=lambda rng, size: {"scale": size},
    ),
]
'''
NAMES = ("thrust_line", "draught", "mixer", "marker_scale")


@pytest.fixture(scope="module")
def file(tmp_path_factory) -> Path:
    """The file as a user keeps it."""
    path = tmp_path_factory.mktemp("user") / "my_effects.py"
    path.write_text(FILE)
    return path


@cache
def hidden(path: Path) -> dict[str, HiddenCase]:
    """A flight with each effect and one baseline flight, drawn by the effects' own hooks."""
    catalogue = (*CATALOGUE, *load_effects(path))
    cases = hidden_flights(7, NAMES, calm_seconds=45.0, flight_seconds=21.0, catalogue=catalogue)
    return dict(zip(NAMES, cases, strict=True))


@cache
def baseline(path: Path) -> NominalModel:
    """What the baseline flight says, identified once for all four runs."""
    catalogue = (*CATALOGUE, *load_effects(path))
    return identify_baseline(hidden(path)[NAMES[0]].calm, catalogue=catalogue)


@pytest.mark.parametrize("name", NAMES)
def test_gap_names_an_effect_of_a_users_file(name, file, tmp_path, monkeypatch, capsys):
    """By construction: what was hidden is named, with its size within 25 %, three standard
    deviations or more of a flight of 21 s; a line says that the file is code that runs.
    """
    case = hidden(file)[name]
    monkeypatch.setattr(study, "identify_baseline", lambda *how: baseline(file))
    # Without the search for an onset, which has tests of its own: seconds less for each effect.
    monkeypatch.setattr(study, "name_with_onset", lambda *how: (name_effect(*how), None))
    for table, key in ((case.calm, "calm"), (case.flight, "flight")):
        write_flight_table(tmp_path / f"{key}.csv", table)
    out = tmp_path / "out"
    words = ["--calm", f"{tmp_path}/calm.csv", "--flight", f"{tmp_path}/flight.csv"]
    assert main(["gap", *words, "--out", str(out), "--effects", str(file)]) == 0
    record = json.loads((out / "report.json").read_text())
    assert (record["verdict"], record["effects"]) == ("named", [name])
    ((parameter, size),) = record["parameters"].items()
    assert size["value"] == pytest.approx(case.truth["size"][parameter], rel=0.25)
    assert {r["effect"] for r in record["ranking"]} >= {*NAMES, *(e.name for e in CATALOGUE)}
    assert "runs now, with all your rights" in capsys.readouterr().err
    if name == "thrust_line":
        assert record["next_flight"].endswith("check the motor mount with a ruler")
