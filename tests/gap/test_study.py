"""Study: the Python interface gives the record of report.json and hands on airframe and effects."""

import inspect
from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.aircraft import Effect, Parameter, load_airframe, rates_model, scale_model
from falconwing_kit.core.checks import InputError
from falconwing_kit.gap import Study, gap_record, study
from falconwing_kit.gap import name as name_module
from falconwing_kit.sysid.shooting import select_windows
from tests.gap.studies import own_base, own_flight, shipped, wind_study

SIZE = (Parameter("gear_size", 0.01, 0.0, 0.3, "1/m", "drag of the gear"),)


def gear(air, K):
    """A drag along the nose."""
    return -K.gear_size * air.airspeed * air.u, 0.0, 0.0, 0.0, 0.0, 0.0


class StudyStoppedError(Exception):
    """Ends a study before its long part."""


def handed_on(monkeypatch, **how):
    """What the identification of the baseline is called with."""
    calls = []

    def stop(*arguments):
        calls.append(arguments)
        raise StudyStoppedError

    monkeypatch.setattr(study, "identify_baseline", stop)
    with pytest.raises(StudyStoppedError):
        Study(baseline=shipped("case08_calm"), flight=shipped("case08_flight"), **how).report()
    return calls[0]


def test_the_signature_is_the_fixed_one():
    """DESIGN.md, section 5."""
    assert str(inspect.signature(Study)).startswith("(baseline:")
    names = list(inspect.signature(Study).parameters)
    assert names[:4] == ["baseline", "flight", "airframe", "effects"]
    assert Study(shipped("case08_calm"), shipped("case08_flight")).effects == ()


def test_report_is_the_record(monkeypatch):
    """The same keys and values as report.json has; computed once for two reports."""
    calls = []
    monkeypatch.setattr(study, "study_gap", lambda *pair, **how: calls.append(how) or wind_study())
    two = Study(baseline=shipped("case08_calm"), flight=shipped("case08_flight"))
    assert two.report() == two.report() == gap_record(wind_study())
    assert len(calls) == 1


def test_own_effects_are_tried_beside_the_catalogue(monkeypatch):
    """They come after it, and the fit starts from the ordinary aircraft."""
    own = Effect("gear", "The gear is out.", SIZE, loads=gear)
    (calm,), _, catalogue, start, _ = handed_on(monkeypatch, effects=[own])
    assert calm.name.endswith("case08_calm.csv")
    assert catalogue[-1] is own and catalogue[0].name == "wind" and start is None


def test_an_airframe_scales_the_start(monkeypatch):
    """As `identify --airframe` does."""
    airframe = load_airframe()
    expected = scale_model(rates_model(), airframe.mass, airframe.wing_area, airframe.span)
    assert handed_on(monkeypatch, airframe=airframe)[3].values == expected.values


def test_an_effect_that_clashes_is_refused():
    """Before anything is computed."""
    clash = Effect("flap", "Another flap.", SIZE, loads=gear)
    pair = shipped("case08_calm"), shipped("case08_flight")
    with pytest.raises(InputError, match="'flap': expected a new name"):
        Study(*pair, effects=[clash]).report()


def test_a_report_says_which_windows_are_left_out(monkeypatch):
    """One window of a flight is taken away, as where the nominal model diverges: the report is
    whole, names what is hidden in the others, and says so.
    """
    fit_flight = name_module.fit_flight

    def without_the_third(base, prepared):
        windows, before = fit_flight(base, prepared)
        kept = np.delete(np.arange(len(windows)), 2)
        names = ("initial_states", "residual", "parameter_jacobian", "initial_state_jacobian")
        rest = {name: getattr(before, name)[kept] for name in names}
        return select_windows(windows, kept), replace(before, **rest)

    monkeypatch.setattr(name_module, "fit_flight", without_the_third)
    monkeypatch.setattr(study, "identify_baseline", lambda *_: own_base())
    flight = own_flight("adverse_yaw", 30.0, 41, adverse_yaw=0.08)
    report = Study(baseline=own_flight(None, 30.0, 47), flight=flight).report()
    assert report["effects"] == ["adverse_yaw"]
    assert [w for w in report["warnings"] if "windows" in w] == [
        "in 1 of 14 windows the calm flight's model diverges; they are left out: "
        "4.5 to 6.5 s"  # 2 s each, 2.05 s apart, from 0.4 s on
    ]
