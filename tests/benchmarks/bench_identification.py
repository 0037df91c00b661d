"""Identification: seconds beside SciPy, accuracy beside the paper's loss, coverage of the
intervals, the calm cases.

    python -m pytest -m benchmark -s tests/benchmarks/bench_identification.py

All flights but the last table's are simulated by the kit's own aircraft with marker noise (3 cm,
0.6 deg), 0.5 % of poses off by metres and 1 % missing. Times are CPU seconds, so other work on the
machine does not count.
"""

import time

import numpy as np
import pytest

from falconwing_kit.aircraft.model import Model, paper_model, rates_model
from falconwing_kit.core.checks import Array
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.sysid.identify import identify
from falconwing_kit.sysid.one_step import fit_one_step
from falconwing_kit.sysid.prepare import prepare
from falconwing_kit.sysid.shooting import cut_windows, residuals
from tests.benchmarks.bench_rollouts import machine
from tests.sysid.recorded import CASES, calm_flight
from tests.sysid.simulated import drawn, fly_figure_eights, measured

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(1800)]
ADDED = (
    "Jx",
    "Jy",
    "Jz",
    "cD_beta",
    "delay",
    "lag",
)  # beyond the 23 parameters of the plain 12-state model


def flights(count: int, seconds: float, seed: int) -> list[tuple[Model, FlightTable]]:
    """Aircraft with parameters spread by 15 %, and a measured flight of each."""
    rng = np.random.default_rng(seed)
    models = [drawn(rates_model(), rng) for _ in range(count)]
    flown = fly_figure_eights(models, seconds, rng)
    return [
        (m, measured(flown, rng, i, outliers=0.005, missing=0.01)) for i, m in enumerate(models)
    ]


def errors(found: Model, truth: Model) -> Array:
    """Relative error of each parameter whose ordinary value is not zero."""
    names = [p.name for p in truth.parameters if p.start != 0.0 and p.high > p.low]
    return np.array([abs(found.values[n] / truth.values[n] - 1.0) for n in names])


def show(capsys: pytest.CaptureFixture[str], *lines: str) -> None:
    with capsys.disabled():
        print("\n\n" + "\n".join((f"{machine()}, NumPy {np.__version__}; one core.", "", *lines)))


def test_seconds_beside_scipy(capsys: pytest.CaptureFixture[str]) -> None:
    """Ten minutes with 23 and 29 parameters; SciPy in full on 60 s, estimated on ten minutes."""
    from scipy.optimize import least_squares

    truth, table = flights(1, 600.0, 1)[0]
    rows = [
        "| flight | parameters | unknowns with start states | kit "
        "| SciPy, dense differences | ratio |"
    ]
    rows += ["|---|---|---|---|---|---|"]
    for seconds, fixed in ((60.0, ADDED), (600.0, ADDED), (600.0, ())):
        model = rates_model().with_values({n: truth.values[n] for n in fixed}).with_fixed(fixed)
        part = flights(1, seconds, 1)[0][1] if seconds < 600.0 else table
        began = time.process_time()
        found = identify([part], model=model)
        ours = time.process_time() - began
        windows = cut_windows([f for p in found.prepared for f in p.flights], model)
        free = [i for i, p in enumerate(model.parameters) if p.high > p.low]
        scale = np.array([max(abs(model.parameters[i].start), 0.1) for i in free])
        unknowns = len(free) + windows.initial_guess.size

        def mismatch(x: Array, model=model, windows=windows, free=free, scale=scale) -> Array:  # type: ignore[no-untyped-def]
            vector = model.vector
            vector[free] = x[: len(free)] * scale
            initial_states = x[len(free) :].reshape(windows.initial_guess.shape)
            return np.nan_to_num(
                residuals(model.with_vector(vector), windows, initial_states), posinf=1e3
            ).ravel()

        start = np.concatenate(
            [found.train_model.vector[free] * 1.05 / scale, windows.initial_guess.ravel()]
        )
        began = time.process_time()
        if seconds < 600.0:
            least_squares(mismatch, start, method="trf", max_nfev=8)
            theirs, note = time.process_time() - began, ""
        # one Jacobian asks for one flight of all windows per unknown; three of them is a short fit
        else:
            mismatch(start)
            theirs, note = (time.process_time() - began) * (unknowns + 1) * 3, " (estimate)"
        ratio = f"{theirs / ours:.0f} x"
        rows.append(
            f"| {seconds:.0f} s | {len(free)} | {unknowns} | {ours:.1f} s "
            f"| {theirs:.0f} s{note} | {ratio} |"
        )
    show(capsys, *rows)


def test_accuracy_beside_the_papers_loss(capsys: pytest.CaptureFixture[str]) -> None:
    """Eight ten-minute flights: error of the parameters by three losses."""
    losses: dict[str, list[Array]] = {
        "multiple shooting": [],
        "one step, smoothed": [],
        "one step, raw": [],
    }
    for truth, table in flights(8, 600.0, 2):
        losses["multiple shooting"].append(errors(identify([table]).model, truth))
        prepared = prepare(table).flights
        for name in ("smoothed", "raw"):
            fitted = fit_one_step(rates_model(), prepared, smoothed=name == "smoothed")
            losses[f"one step, {name}"].append(errors(fitted, truth))
    rows = ["| loss | median parameter error | 90 % of parameters within |", "|---|---|---|"]
    for name, found in losses.items():
        every = np.concatenate(found) * 100.0
        rows.append(f"| {name} | {np.median(every):.2g} % | {np.percentile(every, 90):.3g} % |")
    show(capsys, *rows)


def test_coverage_of_the_intervals(capsys: pytest.CaptureFixture[str]) -> None:
    """Fifty two-minute flights: how often the 95 % intervals hold the truth."""
    held, worst = [], []
    for truth, table in flights(50, 120.0, 3):
        found = identify([table])
        inside = [
            found.interval(n)[0] <= truth.values[n] <= found.interval(n)[1]
            for n in found.uncertainty.names
        ]
        held.append(np.mean(inside))
        worst.append(found.held_out.chi2 if found.held_out else np.nan)
    show(
        capsys,
        f"95 % intervals hold the truth in {100.0 * np.mean(held):.1f} % of cases "
        f"(50 flights; worst flight {100.0 * np.min(held):.0f} %); held-out chi2 per dof "
        f"at most {np.max(worst):.2f}",
    )


def test_calm_cases(capsys: pytest.CaptureFixture[str]) -> None:
    """The ten calm flights of the independent simulator: held-out chi2 per degree of freedom, both
    forms.
    """
    rows = ["| calm flight | 12-state model | 9-state model |", "|---|---|---|"]
    for case in CASES:
        chi2 = [
            identify([calm_flight(case)], model=m).held_out for m in (rates_model(), paper_model())
        ]
        rows.append(
            f"| {case} | {chi2[0].chi2:.2f} | {chi2[1].chi2:.0f} |"
            if all(chi2)
            else f"| {case} | - | - |"
        )
    show(capsys, *rows)
