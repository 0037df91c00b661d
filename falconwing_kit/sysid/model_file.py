"""Model file: an identification <-> TOML with values, units, bounds, covariance and the flights it was fitted on."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from falconwing_kit.aircraft.model import FORMS, Model
from falconwing_kit.aircraft.terms import FORCES, MOMENTS, QUASI_STEADY_RATES, UNIFORM_WIND, Term, WindTerm
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.config import from_toml, write_toml
from falconwing_kit.sysid.identify import Identification

KNOWN_TERMS: tuple[Term | WindTerm, ...] = (*FORCES, *MOMENTS, *QUASI_STEADY_RATES, UNIFORM_WIND)


@dataclass(frozen=True)
class ModelFile:
    """A model as read from its file."""

    model: Model
    names: tuple[str, ...]  # the parameters that were fitted
    covariance: Array  # (F, F) in their units
    flights: tuple[str, ...]  # what they were fitted on
    sigma: Array  # (6,) pose noise of the fit [m, rad], nan where unknown


@dataclass(frozen=True)
class _Parameter:
    value: float
    unit: str
    low: float
    high: float
    meaning: str = ""
    low95: float | None = None
    high95: float | None = None


@dataclass(frozen=True)
class _Fit:
    flights: tuple[str, ...]
    train_chi2: float
    held_out_chi2: float | None = None
    sigma: tuple[float, ...] = ()  # px, py, pz [m], roll, pitch, yaw [rad]


@dataclass(frozen=True)
class _Covariance:
    names: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class _File:
    form: str
    terms: tuple[str, ...]
    fit: _Fit
    parameters: Mapping[str, _Parameter]
    covariance: _Covariance


def write_model(path: str | Path, found: Identification) -> None:
    """Write an identified model.

    Args:
        path: the TOML file; it is replaced whole or not at all.
        found: the identification.

    Raises:
        OSError: the file cannot be written.
    """
    model, sure = found.model, found.uncertainty
    parameters = {}
    for p in model.parameters:
        low95, high95 = found.interval(p.name) if p.name in sure.names else (None, None)
        parameters[p.name] = _Parameter(model.values[p.name], p.unit, p.low, p.high, p.meaning, low95, high95)
    held_out = found.held_out.chi2 if found.held_out else None
    fit = _Fit(found.names, found.train.chi2, held_out, tuple(map(float, found.sigma)))
    matrix = tuple(tuple(float(f"{c:.6g}") for c in row) for row in sure.covariance)
    terms = tuple(t.name for t in model.terms) + tuple(w.name for w in model.winds)
    write_toml(path, _File(model.form, terms, fit, parameters, _Covariance(sure.names, matrix)))


def read_model(path: str | Path, known: tuple[Term | WindTerm, ...] = KNOWN_TERMS) -> ModelFile:
    """Read a model file.

    Args:
        path: the TOML file.
        known: the terms a file may name.

    Returns:
        The model with its uncertainty.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file is not a model, names an unknown term or parameter, or its numbers do not fit together.
    """
    file = from_toml(_File, path)
    if file.form not in FORMS:
        raise InputError(f"{Path(path).name}: form: want one of {', '.join(FORMS)}, got {file.form!r}")
    by_name = {t.name: t for t in known}
    unknown = [name for name in file.terms if name not in by_name]
    if unknown:
        raise InputError(f"{Path(path).name}: terms: want names out of {', '.join(by_name)}, got {unknown[0]!r}")
    base = FORMS[file.form]()
    own = {t.name for t in base.terms}
    model = base.adding(*(by_name[name] for name in file.terms if name not in own))
    missing = [name for name in model.names if name not in file.parameters]
    if missing or len(file.parameters) != len(model.names):
        odd = missing[0] if missing else next(n for n in file.parameters if n not in model.values)
        raise InputError(f"{Path(path).name}: parameters: want {', '.join(model.names)}; {odd!r} does not fit")
    model = model.with_values({name: p.value for name, p in file.parameters.items()})
    bounds = file.parameters
    model = replace(
        model, parameters=tuple(replace(p, low=bounds[p.name].low, high=bounds[p.name].high) for p in model.parameters)
    )
    return ModelFile(model, file.covariance.names, _covariance(file, path), file.fit.flights, _sigma(file))


def _covariance(file: _File, path: str | Path) -> Array:
    names, rows = file.covariance.names, file.covariance.matrix
    if any(len(row) != len(names) for row in rows) or len(rows) != len(names):
        raise InputError(
            f"{Path(path).name}: covariance: want {len(names)} rows of {len(names)} numbers, got another shape"
        )
    if any(name not in file.parameters for name in names):
        raise InputError(f"{Path(path).name}: covariance: want names of parameters, got others")
    return np.array(rows).reshape(len(names), len(names))


def _sigma(file: _File) -> Array:
    return np.array(file.fit.sigma) if len(file.fit.sigma) == 6 else np.full(6, np.nan)
