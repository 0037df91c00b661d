"""Model file: an identified model <-> TOML with values, units, bounds, covariance and flights."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.aircraft.effect import Effect, standing_effect
from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.generic import GENERIC_EFFECTS
from falconwing_kit.aircraft.model import FORMS, Model
from falconwing_kit.aircraft.sparse import SPARSE_EFFECTS
from falconwing_kit.aircraft.terms import (
    ATTITUDE_HOLD,
    CROSS_MOMENTS,
    FORCES,
    MOMENTS,
    QUASI_STEADY_RATES,
    THRUST_CURVE,
    UNIFORM_WIND,
    Term,
    WindTerm,
)
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.config import from_toml, write_toml
from falconwing_kit.sysid.identify import Identification
from falconwing_kit.sysid.uncertainty import Uncertainty

VERSION = 2  # of the files that are written
# A file without a version is of version 1: symbol there -> symbol and sign here.
VERSION_1 = {
    "cL0": ("cL_0", 1), "cLa": ("cL_alpha", 1), "cLe": ("cL_de", 1),
    "cD0": ("cD_0", 1), "cDi": ("cD_induced", 1), "cDb": ("cD_beta", 1),
    "cY": ("cY_beta", -1), "cYr": ("cY_dr", 1),
    "L0": ("L_0", 1), "La": ("L_da", 1), "Lb": ("L_beta", 1), "Lp": ("L_p", -1), "Lr": ("L_r", 1),
    "M0": ("M_0", 1), "Me": ("M_de", 1), "Ma": ("M_alpha", -1), "Mq": ("M_q", -1),
    "N0": ("N_0", 1), "Nr": ("N_dr", 1), "Nb": ("N_beta", 1), "Nrr": ("N_r", -1), "Np": ("N_p", -1),
}  # fmt: skip

KNOWN_EFFECTS = (
    *CATALOGUE, *GENERIC_EFFECTS, *SPARSE_EFFECTS, *(standing_effect(e) for e in CATALOGUE),
)  # fmt: skip
KNOWN_TERMS: tuple[Term | WindTerm, ...] = (
    *FORCES, *MOMENTS, *QUASI_STEADY_RATES, THRUST_CURVE, CROSS_MOMENTS, ATTITUDE_HOLD,
    UNIFORM_WIND,
)  # fmt: skip


@dataclass(frozen=True)
class ModelFile:
    """The content of a model file."""

    model: Model
    names: tuple[str, ...]  # fitted parameters
    covariance: Array  # (F, F) in their units
    flights: tuple[str, ...]  # that they were fitted on
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
    effects: tuple[str, ...] = ()
    version: int = 1


def write_model(path: str | Path, found: Identification) -> None:
    """Write an identified model to a TOML file, atomically; OSError where that fails."""
    write_fitted_model(
        path, found.model, found.uncertainty, flights=found.names, train_chi2=found.train.chi2,
        held_out_chi2=found.held_out.chi2 if found.held_out else None, sigma=found.sigma,
    )  # fmt: skip


def write_fitted_model(
    path: str | Path,
    model: Model,
    confidence: Uncertainty,
    *,
    flights: tuple[str, ...],
    train_chi2: float,
    held_out_chi2: float | None,
    sigma: Array,
) -> None:
    """Write any fitted model, with or without effects.

    Args:
        path: the TOML file; it is replaced atomically.
        model: at its fitted values.
        confidence: of the fitted parameters.
        flights: names of the flights of the fit.
        train_chi2: per degree of freedom on the fitted time.
        held_out_chi2: the same on held-out time, or None.
        sigma: (6,) pose noise of the fit [m, rad].

    Raises:
        OSError: the file cannot be written.
    """
    parameters = {}
    for p in model.parameters:
        value = model.values[p.name]
        ends: tuple[float | None, float | None] = (None, None)
        if p.name in confidence.names:
            ends = confidence.interval(p.name, value)
        parameters[p.name] = _Parameter(value, p.unit, p.low, p.high, p.meaning, *ends)
    fit = _Fit(flights, train_chi2, held_out_chi2, tuple(map(float, sigma)))
    matrix = tuple(tuple(float(f"{c:.6g}") for c in row) for row in confidence.covariance)
    covariance = _Covariance(confidence.names, matrix)
    effects = tuple(e.name for e in model.effects)
    names = tuple(t.name for t in model.terms) + tuple(w.name for w in model.winds)
    terms = tuple(name for name in names if name not in effects)
    write_toml(path, _File(model.form, terms, fit, parameters, covariance, effects, VERSION))


def read_model(
    path: str | Path,
    known: tuple[Term | WindTerm, ...] = KNOWN_TERMS,
    catalogue: tuple[Effect, ...] = KNOWN_EFFECTS,
) -> ModelFile:
    """Read a model file of this version or an earlier one.

    Args:
        path: the TOML file.
        known: terms that a file may name.
        catalogue: effects that a file may name.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file is no model or of a later version, names an unknown term, effect or
            parameter, or its numbers are inconsistent.
    """
    file = _upgrade(from_toml(_File, path), path)
    if file.form not in FORMS:
        raise InputError(
            f"{Path(path).name}: form: expected one of {', '.join(FORMS)}, got {file.form!r}"
        )
    terms = _look_up(file.terms, {t.name: t for t in known}, "terms", path)
    # Forms of an effect share its name: those whose parameters are all in the file are taken.
    by_fit = sorted(catalogue, key=lambda e: all(p.name in file.parameters for p in e.parameters))
    forms = {e.name: [form for form in by_fit if form.name == e.name] for e in by_fit}
    _look_up(file.effects, {name: several[-1] for name, several in forms.items()}, "effects", path)
    effects = [
        form
        for name in dict.fromkeys(file.effects)
        for form in forms[name][-file.effects.count(name) :]
    ]
    base = FORMS[file.form]()
    in_base = {t.name for t in base.terms}
    model = base.with_terms(*(term for term in terms if term.name not in in_base))
    for effect in effects:
        model = model.with_effect(effect)
    missing = [name for name in model.names if name not in file.parameters]
    if missing or len(file.parameters) != len(model.names):
        odd = missing[0] if missing else next(n for n in file.parameters if n not in model.values)
        raise InputError(
            f"{Path(path).name}: parameters: expected {', '.join(model.names)}; {odd!r} does not"
            " fit"
        )
    bounds = file.parameters
    model = replace(
        model.with_values({name: p.value for name, p in file.parameters.items()}),
        parameters=tuple(
            replace(p, low=bounds[p.name].low, high=bounds[p.name].high) for p in model.parameters
        ),
    )
    return ModelFile(
        model, file.covariance.names, _covariance(file, path), file.fit.flights, _sigma(file)
    )


def _upgrade(file: _File, path: str | Path) -> _File:
    """A file of version 1 with the symbols and signs of this version; others unchanged."""
    if file.version == VERSION:
        return file
    if file.version != 1:
        raise InputError(
            f"{Path(path).name}: version: expected 1 or {VERSION}, got {file.version}: install a"
            " newer falconwing-kit"
        )
    parameters: dict[str, _Parameter] = {}
    for name, p in file.parameters.items():
        symbol, sign = VERSION_1.get(name, (name, 1))
        if symbol in parameters:
            raise InputError(
                f"{Path(path).name}: parameters: expected {symbol!r} once, got it by two names:"
                " remove one"
            )
        parameters[symbol] = p if sign > 0 else _negate(p)
    fitted = [VERSION_1.get(name, (name, 1)) for name in file.covariance.names]
    signs = np.array([sign for _, sign in fitted])
    matrix = signs[:, None] * _covariance(file, path) * signs  # cov(-a, b) = -cov(a, b)
    covariance = _Covariance(tuple(name for name, _ in fitted), tuple(map(tuple, matrix.tolist())))
    return replace(file, parameters=parameters, covariance=covariance, version=VERSION)


def _negate(p: _Parameter) -> _Parameter:
    """The parameter with the opposite sign; bounds and ends of the interval swap."""
    low95, high95 = (None if end is None else 0.0 - end for end in (p.high95, p.low95))
    return replace(
        p, value=0.0 - p.value, low=0.0 - p.high, high=0.0 - p.low, low95=low95, high95=high95
    )


def _look_up(
    names: tuple[str, ...], known: Mapping[str, Any], what: str, path: str | Path
) -> list[Any]:
    unknown = [name for name in names if name not in known]
    if unknown:
        raise InputError(
            f"{Path(path).name}: {what}: expected names out of {', '.join(known)}, got"
            f" {unknown[0]!r}"
        )
    return [known[name] for name in names]


def _covariance(file: _File, path: str | Path) -> Array:
    names, rows = file.covariance.names, file.covariance.matrix
    if any(len(row) != len(names) for row in rows) or len(rows) != len(names):
        raise InputError(
            f"{Path(path).name}: covariance: expected {len(names)} rows of {len(names)} numbers,"
            " got another shape"
        )
    if any(name not in file.parameters for name in names):
        raise InputError(f"{Path(path).name}: covariance: expected names of parameters, got others")
    return np.array(rows).reshape(len(names), len(names))


def _sigma(file: _File) -> Array:
    return np.array(file.fit.sigma) if len(file.fit.sigma) == 6 else np.full(6, np.nan)
