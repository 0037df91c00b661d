"""Baselines: they name a plain effect where the data are clean, so that what they do with noise is
not their bug.

    python -m pytest -m benchmark -s tests/benchmarks/test_baselines.py  # needs the extra `bench`

What they answer on noisy flights is printed, not asserted: it is theirs. All flights here are
simulated.
"""

import json
import time
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.model import paper_model
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_table import FlightTable, read_flight_table
from falconwing_kit.core.frames import euler_from_rotation, rotation_world_body
from falconwing_kit.gap.baseline import NominalModel, identify_baseline
from falconwing_kit.sysid.prepare import prepare
from tests.benchmarks.baselines import (
    TREATMENTS,
    Flown,
    Regression,
    baseline_answers,
    effect_regression,
    first_to_enter,
    pysindy_name,
    smoother_low_pass,
    sparse,
    stepwise_name,
)
from tests.gap.studies import EFFECTS, own_aircraft, own_base, own_flight
from tests.sysid.recorded import FOLDER
from tests.sysid.simulated import DT, fly_figure_eights, measured

PLANTED = {
    "adverse_yaw": {"adverse_yaw": 0.08},
    "extra_drag": {"drag_added": 0.015},
}  # a third of N_dr, as much as cD_0


@cache
def clean_flight(effect: str | None, seconds: float, seed: int) -> FlightTable:
    """A flight of the tests' own aircraft, measured without noise."""
    rng = np.random.default_rng(seed)
    model = own_aircraft()
    if effect is not None:
        model = model.with_effect(EFFECTS[effect]).with_values(PLANTED[effect])
    return measured(fly_figure_eights([model], seconds, rng), rng, noise=(0.0, 0.0))


@cache
def clean_base() -> NominalModel:
    return identify_baseline(clean_flight(None, 40.0, 11))


@pytest.mark.parametrize("treatment", TREATMENTS)
@pytest.mark.parametrize("effect", PLANTED)
def test_stepwise_names_a_planted_effect_on_clean_data(effect, treatment):
    """The flight was flown with it; the best of the others must stay behind by far."""
    answer = first_to_enter(
        effect_regression(clean_base(), clean_flight(effect, 40.0, 41), treatment)
    )
    assert (answer.verdict, answer.name) == ("named", effect)
    assert answer.ranking[0][1] > 1.5 * answer.ranking[1][1]


@pytest.mark.benchmark
@pytest.mark.parametrize("treatment", TREATMENTS)
@pytest.mark.parametrize("effect", PLANTED)
def test_pysindy_names_a_planted_effect_on_clean_data(effect, treatment):
    """The same flights; over a threefold range of thresholds."""
    regression = effect_regression(clean_base(), clean_flight(effect, 40.0, 41), treatment)
    assert {sparse(regression, threshold).name for threshold in (0.1, 0.2, 0.3)} == {effect}


def test_answers_without_pysindy_are_all_of_stepwise():
    """The effect was planted; PySINDy is an extra that a machine may lack."""
    answers = baseline_answers(clean_base(), clean_flight("adverse_yaw", 40.0, 41), pysindy=False)
    assert {answers[key] for key in ("stepwise", "stepwise@20", "stepwise_held@20")} == {
        "adverse_yaw"
    }
    assert all(key.startswith("stepwise") for key in answers)


@pytest.mark.benchmark
def test_two_tables_are_enough():
    """The same answers from flight tables alone."""
    calm, flight = clean_flight(None, 40.0, 11), clean_flight("adverse_yaw", 40.0, 41)
    assert stepwise_name(calm, flight).name == "adverse_yaw"
    assert pysindy_name(calm, flight)[0.2].name == "adverse_yaw"


def test_sticks_logged_a_row_early_are_a_control_delay():
    """A stick that is logged 50 ms before it moves is one whose command acts 50 ms late: the same
    accelerations.
    """
    flight = clean_flight(None, 30.0, 43)
    early = replace(flight, commands=np.concatenate([flight.commands[1:], flight.commands[-1:]]))
    explained, named = explained_by("control_delay", {"control_delay": DT}, flight, early)
    assert explained == pytest.approx(1.0, abs=0.01)  # all of it but the first and the last row
    assert named in ("control_delay", "actuator_lag")  # a regression hardly tells the two apart


def test_attitudes_turned_in_the_body_are_a_camera_tilt():
    """Each measured rotation times a small one on the body's side, composed as matrices: 1 deg up,
    0.7 deg about x.
    """
    flight, up, about = clean_flight(None, 30.0, 43), np.radians(1.0), np.radians(0.7)
    R_body_turned = rotation_world_body(0.0, 0.0, 0.0).T @ rotation_world_body(about, up, 0.0)
    angles = euler_from_rotation(rotation_world_body(*flight.attitude.T) @ R_body_turned)
    turned = replace(flight, attitude=np.stack(angles, axis=1))
    explained, named = explained_by(
        "camera_tilt", {"tilt_pitch": up, "tilt_roll": about}, flight, turned
    )
    assert explained == pytest.approx(
        1.0, abs=5e-4
    )  # 1e-4 is the tilt's own square; without the rates' turn 1e-3
    assert named == "camera_tilt"


def explained_by(
    effect: str, values: dict[str, float], before: FlightTable, after: FlightTable
) -> tuple[float, str]:
    """Share of what changed between two tables that an effect of a given size explains, and what
    stepwise names.
    """
    base = clean_base()
    model = base.result.model
    plain, other = (
        Flown.of(prepare(table).flights, model, np.ones(6)) for table in (before, after)
    )
    changed = other.residual - plain.residual
    (form,) = (
        e for e in CATALOGUE if e.name == effect and {p.name for p in e.parameters} == {*values}
    )
    left = changed - other.change(model.with_effect(form).with_values(values))
    return 1.0 - float(left @ left / (changed @ changed)), first_to_enter(
        effect_regression(base, after, "held")
    ).name


def test_low_pass_is_what_the_smoother_does_to_a_wave():
    """A wave of 1 Hz: its second derivative as `prepare` gives it, over the true one."""
    omega = 2.0 * np.pi
    t = np.arange(0.0, 10.0, DT)
    position = np.stack([np.cos(omega * t), 0.0 * t, 0.0 * t], axis=1)
    table = FlightTable("wave", t, position, np.zeros((len(t), 3)), np.zeros((len(t), 4)))
    seen = prepare(table).flights[0].state_derivatives[100, 6] / (
        -(omega**2) * np.cos(omega * t[100])
    )
    weights = smoother_low_pass(6)
    at = np.cos(omega * DT * (np.arange(len(weights)) - 5))
    assert weights.sum() == pytest.approx(1.0, abs=1e-9)
    assert weights @ at == pytest.approx(
        seen, rel=0.02
    )  # it averages accelerations over a row, which costs 0.8 %
    assert seen < 0.8


def two_columns() -> Regression:
    """Four rows, two columns of root mean square 1 that explain 9 and 16 of 26."""
    columns = np.array([[2.0, 0.0], [0.0, 2.0], [0.0, 0.0], [0.0, 0.0]])
    return Regression(np.array([3.0, 4.0, 0.0, 1.0]), columns, ("wind", "flap"), 4)


def test_partial_f_by_hand():
    """16 explained, 10 left over 3 rows: F = 4.8; 9 explained, 17 left: F = 27/17."""
    answer = first_to_enter(two_columns(), 4.0)
    assert answer.name == "flap"
    assert dict(answer.ranking) == pytest.approx({"flap": 4.8, "wind": 27.0 / 17.0})
    assert first_to_enter(two_columns(), 5.0).verdict == "none"


@pytest.mark.benchmark
def test_sparse_regression_by_hand():
    """Coefficients 1.5 and 2: a threshold of 1.7 drops the first, of 2.5 both; they explain 9 and
    16 of 25.
    """
    assert dict(sparse(two_columns(), 0.1).ranking) == pytest.approx(
        {"flap": 0.64, "wind": 0.36}, rel=1e-6
    )
    assert dict(sparse(two_columns(), 1.7).ranking) == pytest.approx({"flap": 1.0}, rel=1e-6)
    assert sparse(two_columns(), 2.5).name == "none"


def test_base_without_body_rates_is_refused():
    """The 9-state model has no angular accelerations to compare."""
    base = replace(clean_base(), result=replace(clean_base().result, model=paper_model()))
    with pytest.raises(InputError, match="body rates"):
        effect_regression(base, clean_flight(None, 30.0, 43))


@pytest.mark.benchmark
@pytest.mark.timeout(900)
def test_answers_with_noise(capsys: pytest.CaptureFixture[str]) -> None:
    """Prints right names and false alarms of every recipe and threshold: own aircraft, then the
    labelled cases.
    """
    own = {effect: own_flight(effect, 40.0, 41, **values) for effect, values in PLANTED.items()}
    own["none"] = own_flight(None, 40.0, 41)
    tables = [
        answers_table(
            "own aircraft, marker noise", [(e, own_base(), flight) for e, flight in own.items()]
        )
    ]
    if (FOLDER / "truth.json").is_file():
        truth = json.loads((FOLDER / "truth.json").read_text(encoding="utf-8"))
        known = [
            (t["effect"], *(read_flight_table(FOLDER / c / f"{f}.csv") for f in ("calm", "flight")))
            for c, t in truth.items()
        ]
        tables.append(
            answers_table(
                "labelled cases",
                [(e, identify_baseline(calm), flight) for e, calm, flight in known],
            )
        )
    with capsys.disabled():
        print("\n\n" + "\n\n".join(tables))


def answers_table(title: str, cases: list[tuple[str, NominalModel, FlightTable]]) -> str:
    """Markdown: of each recipe how many effects it names, names wrongly, and how often it names one
    where none is.
    """
    began = time.process_time()
    answers = [(effect, baseline_answers(base, flight)) for effect, base, flight in cases]
    seconds = (time.process_time() - began) / len(cases)
    shown = [(e, answer) for e, answer in answers if e != "none"]
    calm = [answer for e, answer in answers if e == "none"]
    rows = [
        f"| {title}, {seconds:.1f} s a flight | right | another name | false alarms |",
        "|---|---|---|---|",
    ]
    for key in answers[0][1]:
        right = sum(answer[key] == effect for effect, answer in shown)
        wrong = sum(answer[key] not in (effect, "none") for effect, answer in shown)
        alarms = sum(answer[key] != "none" for answer in calm)
        rows.append(
            f"| {key} | {right} of {len(shown)} | {wrong} of {len(shown)} "
            f"| {alarms} of {len(calm)} |"
        )
    return "\n".join(rows)
