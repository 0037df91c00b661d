"""A newcomer's first evening, by the words on the command line: flight in, model out, and what to
trust of it.
"""

import json
import re

import numpy as np
import pytest

from falconwing_kit.core.flight_log import FlightLogWriter
from falconwing_kit.core.flight_table import read_flight_table, slice_time
from falconwing_kit.core.messages import Command, Image, State
from falconwing_kit.data import data_path
from falconwing_kit.sysid.model_file import read_model
from falconwing_kit.tools.cli.main import main

FLIGHT = data_path("case02_calm.csv")


def run(*words: object) -> int:
    """The exit code of a typed command."""
    return main([str(word) for word in words])


def asked(capsys: pytest.CaptureFixture[str], *words: object) -> dict:
    """The JSON that a verb prints."""
    run(*words, "--json")
    return json.loads(capsys.readouterr().out)


@pytest.fixture(scope="module")
def identified(tmp_path_factory):
    """A model and three figures of a flight that ships."""
    folder = tmp_path_factory.mktemp("identified")
    assert (
        run("identify", FLIGHT, "--out", folder / "model.toml", "--figures", folder / "figures")
        == 0
    )
    return folder


@pytest.fixture(autouse=True)
def in_folder(identified, monkeypatch):
    """Work where the model lies, as a person would."""
    monkeypatch.chdir(identified)


def test_flight_becomes_a_model_and_three_figures(identified):
    """The files that README promises; the model names its flight and what it was fitted on."""
    assert sorted(path.name for path in (identified / "figures").iterdir()) == [
        "intervals.png", "predicted.png", "residuals.png",
    ]  # fmt: skip
    file = read_model(identified / "model.toml")
    assert file.flights == ("data/case02_calm.csv",)
    assert set(file.names) <= set(file.model.names) and len(file.names) >= 23


def test_found_model_is_an_ordinary_aircraft(identified):
    """Signs from flight mechanics: lift grows with incidence, every rotation is damped, sticks act
    as they should.
    """
    K = read_model(identified / "model.toml").model.K
    assert min(K.cL_alpha, K.N_beta) > 0.0
    assert max(K.cY_beta, K.L_beta, K.L_p, K.M_alpha, K.M_q, K.N_r) < 0.0
    assert min(K.L_da, K.M_de, K.N_dr, K.kT) > 0.0


def test_going_on_from_a_model_finds_the_same_flight_as_good(identified, capsys):
    """The second fit starts where the first ended; less than a tenth of the noise variance may
    change.
    """
    held_out = [
        asked(capsys, "identify", FLIGHT, *more)["held_out"]["chi2_per_dof"]
        for more in ((), ("--start", "model.toml"))
    ]
    assert held_out[0] == pytest.approx(held_out[1], abs=0.1)
    assert max(held_out) < 1.3  # the release's goal


def test_own_log_becomes_a_table_and_a_model(tmp_path, capsys):
    """A shipped flight, flown into a log as the loop would: a command for each image, a pose where
    there was one.

    The exported table must hold the same to the last bit but for times, which a log keeps in
    nanoseconds.
    """
    table = slice_time(read_flight_table(FLIGHT), 0.0, 45.0)
    with FlightLogWriter(tmp_path / "flight.mcap") as log:
        for k, (t, p, (roll, pitch, yaw)) in enumerate(
            zip(table.t, table.p_world, table.attitude, strict=True)
        ):
            image = Image(k, t, np.zeros(100, np.uint8))
            if table.has_pose[k]:
                log.state(t, State(p, pitch, yaw, roll, np.zeros(3)), image_sequence=k)
            log.command(t + 0.03, Command(*table.commands[k], image_sequence=k), image)
    assert run("export", tmp_path / "flight.mcap", "--out", tmp_path / "flight.csv") == 0
    following = re.search(r"next: falconwing (.*)", capsys.readouterr().out)[1].split()
    exported = read_flight_table(tmp_path / "flight.csv")
    assert np.allclose(exported.t, table.t, rtol=0.0, atol=1e-9)
    for name in ("p_world", "attitude", "commands"):
        assert np.array_equal(getattr(exported, name), getattr(table, name), equal_nan=True), name
    record = asked(capsys, *following)  # what the verb said to type next
    assert record["held_out"]["windows"] > 0
    assert record["held_out"]["chi2_per_dof"] < 1.3


@pytest.mark.parametrize(
    ("mass_g", "speed", "radius", "code"), [(150, 7.04, 8.77, 0), (324, 10.35, 18.9, 1)]
)
def test_size_answers_whether_it_fits_the_hall(capsys, mass_g, speed, radius, code):
    """The paper's appendix by hand: V^2 = 2 m g / (rho S C), R = V^2 / (g tan 30 deg); 2 R against
    20 m.
    """
    assert run("size", "--mass-g", mass_g, "--json") == code
    record = json.loads(capsys.readouterr().out)
    assert record["minimum_speed_m_per_s"] == pytest.approx(speed, abs=0.01)
    assert record["paper_turn"]["radius_m"] == pytest.approx(radius, abs=0.05)


def test_doctor_ends_well_and_says_what_to_type_next(capsys):
    """On a machine that runs the tests everything that the demo needs works."""
    assert run("doctor") == 0
    printed = capsys.readouterr().out
    assert printed.splitlines()[-1] == "next: falconwing demo"
    assert not re.search(r"^(Python|arrays|figures|airframe).*missing", printed, re.MULTILINE)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda text: text.replace("aileron", "roll_stick", 1), "missing column aileron"),
        (lambda text: text.replace(",", ";"), "expected commas"),
        (lambda text: "", "got an empty file"),
        (lambda text: text.splitlines()[0] + "\n", "expected at least one row"),
        (lambda text: "\n".join(text.splitlines()[:2]), "expected at least two rows"),
        (lambda text: degrees(text), "looks like degrees; convert to radians"),
        (lambda text: sticks(text, 0.5), "expected sticks that move"),
        (lambda text: sticks(text, 1500.0), "looks like microseconds"),
    ],
)
def test_ordinary_mistake_is_one_sentence_and_exit_2(tmp_path, capsys, make, sentence):
    """Each mistake is made in a flight that is fine; the sentence must say what it is, and no model
    is written.
    """
    flight = tmp_path / "flight.csv"
    flight.write_text(make(FLIGHT.read_text()))
    assert run("identify", flight, "--out", tmp_path / "model.toml") == 2
    said = [
        line for line in capsys.readouterr().err.splitlines() if not line.startswith("warning: ")
    ]
    assert len(said) == 1 and sentence in said[0]
    assert not (tmp_path / "model.toml").exists()


def degrees(text: str) -> str:
    """The table with its angles in degrees."""
    head, *rows = (line.split(",") for line in text.splitlines())
    angles = [head.index(name) for name in ("roll", "pitch", "yaw")]
    for row in rows:
        for place in angles:
            row[place] = str(np.degrees(float(row[place])))
    return "\n".join(",".join(row) for row in [head, *rows]) + "\n"


def sticks(text: str, value: float) -> str:
    """The table with every stick at one value in every row."""
    head, *rows = (line.split(",") for line in text.splitlines())
    first = head.index("throttle")
    return (
        "\n".join(
            ",".join(row) for row in [head, *(row[:first] + [str(value)] * 4 for row in rows)]
        )
        + "\n"
    )
