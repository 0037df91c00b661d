"""The model file: read equals written, and a damaged file is refused in one sentence."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.integrate import roll_out
from falconwing_kit.aircraft.model import FORMS, add_uniform_wind, rates_model
from falconwing_kit.aircraft.terms import air_flow
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.config import write_toml
from falconwing_kit.sysid.model_file import read_model, write_fitted_model, write_model
from falconwing_kit.sysid.uncertainty import Uncertainty
from tests.core.test_fuzz import mutate
from tests.sysid.simulated import example_found

DAMAGED = 2000


@pytest.fixture
def path(tmp_path):
    """The example's model file."""
    write_model(tmp_path / "model.toml", example_found())
    return tmp_path / "model.toml"


def edited(path, old, new):
    """The file with one text replaced."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    return path


# Round trip


def test_what_was_written_comes_back(path):
    """Inverse: values, bounds, names, noise, flights to the last bit, covariance to six digits."""
    found, read = example_found(), read_model(path)
    assert dict(read.model.values) == dict(found.model.values)
    assert read.model.parameters == found.model.parameters
    assert (read.model.form, read.model.terms, read.model.winds) == ("rates", found.model.terms, ())
    assert (read.names, read.flights) == (found.uncertainty.names, ("simulated",))
    assert np.array_equal(read.sigma, found.sigma)
    assert read.covariance == pytest.approx(found.uncertainty.covariance, rel=1e-5)


def test_the_read_model_flies_the_same_flight(path):
    """The same bits in, the same bits out."""
    start, commands = np.zeros(12), np.full((40, 4), 0.1)
    start[[2, 6]] = 2.0, 7.0
    flown = [
        roll_out(m, start, commands, 0.025) for m in (example_found().model, read_model(path).model)
    ]
    assert np.array_equal(*flown)


def test_the_file_is_plain_toml_with_units(path):
    """With units, bounds, intervals, scores and the flights' names."""
    content = tomllib.loads(path.read_text())
    found = example_found()
    kT = content["parameters"]["kT"]
    low, high = found.interval("kT")
    assert (kT["unit"], kT["low95"], kT["high95"]) == ("m/s^2", low, high)
    assert low < kT["value"] < high
    assert content["fit"]["held_out_chi2"] == found.held_out.chi2
    assert content["fit"]["flights"] == ["simulated"]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("windy", [False, True])
def test_every_form_and_the_wind_come_back(tmp_path, form, windy):
    """Terms are named in the file; fixed parameters have no interval; bounds are those of the
    model.
    """
    model = add_uniform_wind(FORMS[form](), 0.5, -0.25) if windy else FORMS[form]()
    model = model.with_fixed(["kT"])
    confidence = Uncertainty(("L_da",), np.array([[1e-4]]), 1.0, (), (), ())
    write_model(
        tmp_path / "m.toml",
        replace(example_found(), model=model, uncertainty=confidence, held_out=None),
    )
    read = read_model(tmp_path / "m.toml")
    assert dict(read.model.values) == dict(model.values)
    assert (read.model.parameters, read.model.terms, read.model.winds) == (
        model.parameters,
        model.terms,
        model.winds,
    )
    assert (read.names, read.covariance.tolist()) == (("L_da",), [[1e-4]])
    assert "low95" not in tomllib.loads((tmp_path / "m.toml").read_text())["parameters"]["kT"]


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda e: e.name)
def test_every_effect_comes_back(tmp_path, effect):
    """With its values, bounds and functions."""
    model = rates_model().with_effect(effect)
    model = model.with_values({p.name: 0.5 * (p.low + p.high) for p in effect.parameters})
    confidence = Uncertainty(("L_da",), np.array([[1e-4]]), 1.0, (), (), ())
    write_model(tmp_path / "m.toml", replace(example_found(), model=model, uncertainty=confidence))
    read = read_model(tmp_path / "m.toml").model
    assert (dict(read.values), read.parameters) == (dict(model.values), model.parameters)
    assert (read.effects, read.terms, read.winds) == (model.effects, model.terms, model.winds)


@pytest.mark.parametrize("name", ["fan_jet", "camera_tilt"])
def test_two_forms_of_an_effect_come_back_together(tmp_path, name):
    """A jet in a hall and a stream outdoors, or two tilts of the camera, in one model."""
    model = rates_model()
    for size, form in enumerate(e for e in CATALOGUE if e.name == name):
        model = model.with_effect(form)
        model = model.with_values({p.name: 0.01 * (1 + size) for p in form.amplitudes})
    confidence = Uncertainty(("L_da",), np.array([[1e-4]]), 1.0, (), (), ())
    write_model(tmp_path / "m.toml", replace(example_found(), model=model, uncertainty=confidence))
    back = read_model(tmp_path / "m.toml").model
    assert dict(back.values) == dict(model.values)
    assert back.effects == model.effects


def test_without_noise_it_is_unknown(path):
    """A missing or short list of sigmas: six nan."""
    text = path.read_text().splitlines(keepends=True)
    begin = next(i for i, line in enumerate(text) if line.startswith("sigma"))
    end = next(i for i in range(begin, len(text)) if text[i].rstrip().endswith("]"))
    path.write_text("".join(text[:begin] + text[end + 1 :]))
    assert np.isnan(read_model(path).sigma).all() and len(read_model(path).sigma) == 6


# Files of version 1

OLD = (
    Path(__file__).parents[1] / "data"
)  # written by falconwing-kit 0.1 from case02_calm.csv, one file a form
NEGATED = ("cY_beta", "L_p", "M_alpha", "M_q", "N_r", "N_p")


def old_moments(V, rates, angles, commands, K):
    """Angular accelerations by the formulas of version 1, with its symbols and signs."""
    (p, q, r), (alpha, beta), (aileron, elevator, rudder) = rates, angles, commands
    return (
        V * (V * (K["L0"] + K["La"] * aileron + K["Lb"] * beta) - K["Lp"] * p + K["Lr"] * r)
        + K["Jx"] * q * r,
        V * (V * (K["M0"] + K["Me"] * elevator - K["Ma"] * alpha) - K["Mq"] * q) + K["Jy"] * p * r,
        V * (V * (K["N0"] + K["Nr"] * rudder + K["Nb"] * beta) - K["Nrr"] * r - K["Np"] * p)
        + K["Jz"] * p * q,
    )


def test_an_old_file_has_todays_symbols_and_signs():
    """By hand from the file's text: L_p = -Lp and so on, bounds swap, the rudder's Nr is N_dr, Nrr
    is -N_r.
    """
    read = read_model(OLD / "model_version1_rates.toml")
    values, bounds = read.model.values, {p.name: (p.low, p.high) for p in read.model.parameters}
    old = tomllib.loads((OLD / "model_version1_rates.toml").read_text())["parameters"]
    pairs = {
        "cY_beta": "cY", "L_p": "Lp", "M_alpha": "Ma", "M_q": "Mq", "N_r": "Nrr", "N_p": "Np",
        "cL_0": "cL0", "cL_alpha": "cLa", "cL_de": "cLe", "cD_0": "cD0", "cD_induced": "cDi",
        "cD_beta": "cDb", "cY_dr": "cYr", "kT": "kT", "kTV": "kTV", "L_0": "L0", "L_da": "La",
        "L_beta": "Lb", "L_r": "Lr", "M_0": "M0", "M_de": "Me", "N_0": "N0", "N_dr": "Nr",
        "N_beta": "Nb", "Jx": "Jx", "Jy": "Jy", "Jz": "Jz",
        "delay": "delay", "lag": "lag",
    }  # fmt: skip
    assert set(pairs) == set(values)
    for name, before in pairs.items():
        sign = -1.0 if name in NEGATED else 1.0
        assert values[name] == sign * old[before]["value"]
        assert bounds[name] == tuple(
            sorted((sign * old[before]["low"], sign * old[before]["high"]))
        )
    assert [round(values[name], 3) for name in ("L_p", "M_alpha", "N_dr", "N_r")] == [
        -3.691,
        -2.018,
        0.490,
        -0.460,
    ]
    assert bounds["M_alpha"] == (-20.0, 1.0) and bounds["M_q"] == (-12.0, 0.0)


def test_an_old_covariance_changes_sign_with_one_of_the_two():
    """cov(-a, b) = -cov(a, b) and cov(-a, -b) = cov(a, b), for pairs of either kind; same
    variances.
    """
    read = read_model(OLD / "model_version1_rates.toml")
    old = tomllib.loads((OLD / "model_version1_rates.toml").read_text())["covariance"]
    matrix, was = np.array(old["matrix"]), old["names"].index
    now = read.names.index
    of = read.covariance
    assert len(read.names) == 29 and np.array_equal(np.diag(of), np.diag(matrix))
    assert of[now("L_p"), now("L_da")] == -matrix[was("Lp"), was("La")] < 0.0
    assert of[now("L_da"), now("L_p")] == -matrix[was("La"), was("Lp")] < 0.0
    assert of[now("M_alpha"), now("M_q")] == matrix[was("Ma"), was("Mq")] != 0.0
    assert of[now("N_dr"), now("N_r")] == -matrix[was("Nr"), was("Nrr")] != 0.0
    assert of[now("cL_alpha"), now("kT")] == matrix[was("cLa"), was("kT")] != 0.0


def test_an_old_file_flies_as_before():
    """Moments and side force by the formulas of version 1, from the numbers in the file."""
    read = read_model(OLD / "model_version1_rates.toml").model
    content = tomllib.loads((OLD / "model_version1_rates.toml").read_text())["parameters"]
    K = {name: entry["value"] for name, entry in content.items()}
    rates, command = (0.3, -0.4, 0.5), (0.6, 0.2, -0.1, 0.3)
    air = air_flow((7.0, 0.8, 0.5), rates, (0.0, 0.0, 2.0), 0.0, command)
    loads = np.sum(
        [np.array(term.evaluate(air, read.K), dtype=float) for term in read.terms], axis=0
    )
    assert loads[3:] == pytest.approx(
        old_moments(air.airspeed, rates, (air.alpha, air.beta), command[1:], K), rel=1e-12
    )
    side = next(term for term in read.terms if term.name == "side_force").evaluate(air, read.K)[1]
    assert side == pytest.approx(air.airspeed**2 * (K["cYr"] * 0.3 - K["cY"] * air.beta), rel=1e-12)


def test_an_old_file_of_the_nine_state_model_flies_as_before():
    """The rates by the formulas of version 1, from the numbers in the file; fixed zeros stay."""
    read = read_model(OLD / "model_version1_paper.toml").model
    content = tomllib.loads((OLD / "model_version1_paper.toml").read_text())["parameters"]
    K = {name: entry["value"] for name, entry in content.items()}
    air = air_flow((7.0, 0.8, 0.5), (0.0, 0.0, 0.0), (0.0, 0.0, 2.0), 0.0, (0.6, 0.2, -0.1, 0.3))
    loads = np.sum(
        [np.array(term.evaluate(air, read.K), dtype=float) for term in read.terms], axis=0
    )
    V, alpha, beta = air.airspeed, air.alpha, air.beta
    p, q = (
        V * (K["L0"] + K["La"] * 0.2 + K["Lb"] * beta),
        V * (K["M0"] - K["Me"] * 0.1 - K["Ma"] * alpha),
    )
    assert loads[3:] == pytest.approx(
        (p, q, V * (K["N0"] + K["Nr"] * 0.3 + K["Nb"] * beta)), rel=1e-12
    )
    assert {p.name for p in read.parameters if p.low == p.high == 0.0} == {
        "cL_de",
        "cY_dr",
        "cD_beta",
        "delay",
        "lag",
    }


def test_an_old_file_is_written_as_todays(tmp_path):
    """Read, written and read again: version 2 and the same model."""
    old = read_model(OLD / "model_version1_rates.toml")
    confidence = Uncertainty(old.names, old.covariance, 1.0, (), (), ())
    path = tmp_path / "new.toml"
    write_fitted_model(
        path,
        old.model,
        confidence,
        flights=old.flights,
        train_chi2=1.0,
        held_out_chi2=None,
        sigma=old.sigma,
    )
    new = read_model(path)
    assert tomllib.loads(path.read_text())["version"] == 2
    assert (new.model.parameters, dict(new.model.values)) == (
        old.model.parameters,
        dict(old.model.values),
    )
    assert np.array_equal(new.covariance, old.covariance)


def test_a_parameter_by_both_names_is_refused(tmp_path):
    """It would be ambiguous."""
    text = (OLD / "model_version1_paper.toml").read_text()
    entry = '\n[parameters.M_alpha]\nvalue = -1.0\nunit = "1/m"\nlow = -2.0\nhigh = 0.0\n'
    (tmp_path / "m.toml").write_text(text + entry)
    with pytest.raises(
        InputError, match=r"m\.toml: parameters: expected 'M_alpha' once, got it by two names"
    ):
        read_model(tmp_path / "m.toml")


# Refused


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('form = "rates"', 'form = "glider"', "form: expected one of paper, rates, got 'glider'"),
        ('"drag"', '"magic"', r"terms: expected names out of .*drag.*, got 'magic'"),
        (
            "effects = []",
            'effects = ["magic"]',
            "effects: expected names out of .*wind.*, got 'magic'",
        ),
        (
            "[parameters.cL_alpha]",
            "[parameters.cL_x]",
            "parameters: expected .*'cL_alpha' does not fit",
        ),
        ("[parameters.kT]\nvalue = ", "[parameters.kT]\nvalue = nan #", "parameters.kT.value"),
        ("[parameters.kT]\nvalue = ", '[parameters.kT]\nvalue = "much" #', "parameters.kT.value"),
        ("[parameters.kT]\nvalue", "[parameters.kT]\nworth", "worth"),
        (
            "version = 2",
            "version = 3",
            "version: expected 1 or 2, got 3: install a newer falconwing-kit",
        ),
        ("version = 2", "version = 0", "version: expected 1 or 2, got 0"),
        ("[fit]", "[fits]", "fits"),
        ("[covariance]", "[covariances]", "covariances"),
    ],
)
def test_a_wrong_entry_is_named(path, old, new, sentence):
    """One sentence with the file's name and the entry."""
    with pytest.raises(InputError, match=sentence) as refusal:
        read_model(edited(path, old, new))
    assert str(refusal.value).count("\n") == 0 and "model.toml" in str(refusal.value)


def test_a_parameter_too_many_is_named(path):
    """A parameter that no term of the form reads."""
    path.write_text(
        path.read_text() + '\n[parameters.extra]\nvalue = 1.0\nunit = "-"\nlow = 0.0\nhigh = 2.0\n'
    )
    with pytest.raises(InputError, match="'extra' does not fit"):
        read_model(path)


@pytest.mark.parametrize(
    "change", ["row missing", "number missing", "name unknown", "name missing"]
)
def test_a_covariance_of_another_shape_is_refused(path, change):
    """29 names require 29 rows of 29 numbers, of existing parameters."""
    content = tomllib.loads(path.read_text())
    covariance = content["covariance"]
    if change == "row missing":
        covariance["matrix"].pop()
    elif change == "number missing":
        covariance["matrix"][3].pop()
    elif change == "name missing":
        covariance["names"].pop()
    else:
        covariance["names"][0] = "cXX"
    write_toml(path, content)
    message = (
        "names of parameters" if change == "name unknown" else r"expected \d+ rows of \d+ numbers"
    )
    with pytest.raises(InputError, match=f"model.toml: covariance: .*{message}"):
        read_model(path)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9])
def test_a_file_that_is_cut_off_is_refused(path, share):
    """Any missing entry is an error."""
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError) as refusal:
        read_model(path)
    assert str(refusal.value).count("\n") == 0


def test_no_file_is_no_file(tmp_path):
    """The path is in the message."""
    with pytest.raises(FileNotFoundError, match=r"absent\.toml"):
        read_model(tmp_path / "absent.toml")


def test_damaged_files_are_read_or_refused_in_a_sentence(tmp_path):
    """2,000 mutations of a small file: the only exception is an InputError of one line, and a model
    that is read has finite numbers.
    """
    confidence = Uncertainty(("L_da", "kT"), np.diag([1e-4, 1e-2]), 1.0, (), (), ())
    path = tmp_path / "m.toml"
    write_model(path, replace(example_found(), model=FORMS["paper"](), uncertainty=confidence))
    whole, outcomes = path.read_bytes(), {"read": 0, "refused": 0}
    for number in range(DAMAGED):
        path.write_bytes(mutate(whole, np.random.default_rng(number)))
        try:
            read = read_model(path)
            assert np.isfinite(read.model.vector).all() and np.isfinite(read.covariance).all()
            outcomes["read"] += 1
        except InputError as error:
            assert str(error).count("\n") == 0 and len(str(error)) < 2000, (
                f"mutation {number}: {error}"
            )
            outcomes["refused"] += 1
    assert sum(outcomes.values()) == DAMAGED and min(outcomes.values()) > DAMAGED // 100, outcomes
