"""Watching: delay to the alarm, right names and false alarms per hour, on simulated flights.

    python -m pytest -m benchmark -s tests/benchmarks/bench_watch.py
    python -m tests.benchmarks.bench_watch --aircraft 5 --seed 70 --curves

Per aircraft: identification on a baseline flight of 120 s, then calm flights on other days, and
flights in which an effect sets in after 30 s. Two sources of flights, both simulated:

    kit      the kit's own aircraft; force, wind and command effects that begin in flight
    jsbsim   JSBSim's flight dynamics; the log is changed exactly from the onset on (throttle,
             aileron, trim and delay of the commands, tilt of the camera)

The constant DAY_MARGIN of gap/watch.py was chosen on seeds 70, 71 and 170; the test uses others.
Measured on seeds 270 and 271 (24 calm flights, 24 onsets): no false alarm in 0.60 h, 24 detected,
median delay 0.85 s, nine of ten within 1.9 s. On ALFA no alarm: the largest value after the engine
failure is 0.69 of the threshold, before it 0.33; the model's own error is too large there.
"""

import argparse
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.core.checks import Array
from falconwing_kit.core.flight_table import FlightTable, read_flight_table, slice_time
from falconwing_kit.data import data_path
from falconwing_kit.gap import watch
from falconwing_kit.gap.baseline import calibrate_nominal_model, identify_baseline
from falconwing_kit.gap.close import ONSET, with_onset
from falconwing_kit.gap.innovations import FilterStep, filter_rows, table_rows
from falconwing_kit.gap.watch import ChangeTests, Monitor, Watch, build_monitor, watch_rows
from falconwing_kit.sysid.forecast import hold_throttle
from falconwing_kit.sysid.identify import identify
from falconwing_kit.tools.demo.alfa import (
    SETTLING_S,
    WHITE_NOISE,
    alfa_initial_model,
    applicable_effects,
    nominal_prior,
    read_alfa_metadata,
)
from falconwing_kit.tools.trials.hidden import hidden_flights
from tests.hidden_flights import make_case

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(3600)]

ONSET_S, FLIGHT_S, WATCHED_S = 30.0, 60.0, 50.0  # flights with an effect are watched so far
CALM_FLIGHTS, EFFECTS = 8, 8  # per aircraft of the kit
JSBSIM_CALM, JSBSIM_EFFECTS = 4, 4  # JSBSim's calm flight is cut into so many
SCALES = (0.6, 0.8, 1.0, 1.25, 1.5, 2.0, 3.0)  # of both thresholds
WINDOWS_S = (2.0, 4.0, 6.0, 10.0)
KIT = ("wind", "thrust_loss", "trim_bias", "aileron_loss", "extra_drag", "mass_change", "flap",
       "propeller_torque", "adverse_yaw", "cg_shift")  # fmt: skip
LOGGED = ("thrust_loss", "aileron_loss", "trim_bias", "control_delay", "camera_tilt")


@dataclass(frozen=True)
class Watched:
    """One flight and both statistics over it."""

    source: str
    effect: str  # "none" for a calm flight
    noise: str
    seconds: float
    t: Array
    step: Array  # over its threshold
    spread: Array
    ms_per_row: float
    named: tuple[str, ...] = ()  # verdict and effects, where a name was asked for

    def alarm(self, scale: float = 1.0, since: float = 0.0) -> float | None:
        """Time of the first alarm with both thresholds times a scale [s]."""
        over = (np.maximum(self.step, self.spread) > scale) & (self.t >= since)
        return float(self.t[np.argmax(over)]) if over.any() else None

    def false_alarms(self, scale: float = 1.0) -> int:
        """Alarms before the onset, or in all of a calm flight, ten seconds apart at least."""
        end = np.inf if self.effect == "none" else ONSET_S
        times = self.t[(np.maximum(self.step, self.spread) > scale) & (self.t < end)]
        return int(len(times) and 1 + np.count_nonzero(np.diff(times) > 10.0))


def late_effects() -> tuple[Effect, ...]:
    """Effects of the catalogue that set in at ONSET_S, with their own draw of a size."""
    late = []
    for effect in CATALOGUE:
        if effect.name in KIT and effect.draw and effect.sizes:

            def draw(rng: Any, size: float, own: Any = effect.draw) -> dict[str, float]:
                return {**own(rng, size), ONSET: ONSET_S}

            late.append(replace(with_onset(effect, ONSET_S, ONSET_S), draw=draw))
    return tuple(late)


def change_log(table: FlightTable, effect: str, rng: np.random.Generator) -> FlightTable:
    """The same flight as a log that an effect since ONSET_S would have given; exact."""
    since, commands = table.t >= ONSET_S, table.commands.copy()
    attitude = table.attitude.copy()
    sign = rng.choice([-1.0, 1.0])
    if effect == "thrust_loss":
        commands[since, 0] = np.minimum(commands[since, 0] / 0.7, 1.0)
    elif effect == "aileron_loss":
        commands[since, 1] = np.clip(commands[since, 1] / 0.6, -1.0, 1.0)
    elif effect == "trim_bias":
        commands[since, 1:3] = np.clip(commands[since, 1:3] + 0.12 * sign, -1.0, 1.0)
    elif effect == "control_delay":  # the log states each command a row and more too early
        commands[since] = table.commands[np.minimum(np.flatnonzero(since) + 2, len(since) - 1)]
    elif effect == "camera_tilt":
        attitude[since, 1] += np.radians(3.0) * sign
    return replace(table, commands=commands, attitude=attitude)


def run(monitor: Monitor, table: FlightTable) -> tuple[list[FilterStep], float]:
    """The filter's steps over a flight, and milliseconds a row with both tests."""
    began = time.process_time()
    model = monitor.base.result.model
    steps = filter_rows(model, monitor.noise, table_rows(table), monitor.base.prior)
    statistics(monitor, steps)
    return steps, 1e3 * (time.process_time() - began) / len(table.t)


def statistics(
    monitor: Monitor, steps: list[FilterStep], window: float = watch.ONSET_WINDOW_S
) -> tuple[Array, Array, Array]:
    """Times and both statistics, over their thresholds."""
    usual = watch.ONSET_WINDOW_S
    try:
        watch.ONSET_WINDOW_S = window
        tests = ChangeTests(monitor.base.result.model.n_states)
        values = [value for value in map(tests.update, steps) if value is not None]
    finally:
        watch.ONSET_WINDOW_S = usual
    t, step, spread = np.array([(v.t, v.step, v.spread) for v in values]).T
    return t, step / monitor.step_threshold, spread / monitor.spread_threshold


def flights(
    source: str, seed: int, noise: Any
) -> tuple[FlightTable, list[tuple[str, FlightTable]]]:
    """A baseline flight; calm flights of other days and flights with an onset."""
    if source == "kit":
        chosen = [
            str(n) for n in np.random.default_rng([seed, 5]).choice(KIT, EFFECTS, replace=False)
        ]
        effects = ["none"] * CALM_FLIGHTS + chosen
        cases = hidden_flights(
            seed, effects, noise=noise, flight_seconds=FLIGHT_S, catalogue=late_effects()
        )
        return cases[0].calm, [
            (name, case.flight) for name, case in zip(effects, cases, strict=True)
        ]
    case = make_case(seed, "none", noise, flight_seconds=JSBSIM_CALM * FLIGHT_S)
    parts = [
        shift_time(slice_time(case.flight, FLIGHT_S * k, FLIGHT_S * (k + 1)), -FLIGHT_S * k)
        for k in range(JSBSIM_CALM)
    ]
    rng = np.random.default_rng([seed, 6])
    chosen = [str(effect) for effect in rng.permutation(LOGGED)[:JSBSIM_EFFECTS]]
    changed = [
        (effect, change_log(part, effect, rng)) for effect, part in zip(chosen, parts, strict=True)
    ]
    return case.calm, [*(("none", part) for part in parts), *changed]


def shift_time(table: FlightTable, by: float) -> FlightTable:
    """The same flight on another clock."""
    return replace(table, t=table.t + by)


def study(
    seed: int, aircraft: int, curves: bool = False, names: bool = False
) -> tuple[list[Watched], dict[float, list[Watched]]]:
    """Watch all flights of some aircraft of both sources; by window where curves are wanted."""
    found, by_window = list[Watched](), {window: list[Watched]() for window in WINDOWS_S}
    for number in range(aircraft):
        for source in ("kit", "jsbsim"):
            noise = ("marker", "hybrid", "marker", "net")[number % 4]
            calm, tables = flights(source, seed + number, noise)
            base = identify_baseline(calm)
            monitor = build_monitor(base, [calm])
            monitors = {window: monitor for window in WINDOWS_S}
            if curves:
                steps, _ = run(monitor, calm)
                monitors = {w: monitor_with_window(monitor, steps, w) for w in WINDOWS_S}
            for effect, table in tables:
                if effect != "none":
                    table = slice_time(table, 0.0, WATCHED_S)
                steps, ms = run(monitor, table)
                t, step, spread = statistics(monitor, steps)
                named = name(monitor, table) if names and effect != "none" else ()
                one = Watched(source, effect, noise, table.duration, t, step, spread, ms, named)
                found.append(one)
                before = t < ONSET_S if effect != "none" else t < np.inf
                alarm = one.alarm(since=0.0 if effect == "none" else ONSET_S)
                print(
                    f"{source:6} {seed + number} {noise:6} {effect:17} alarm {alarm} "
                    f"false {one.false_alarms()}; largest without effect {step[before].max():.2f} "
                    f"{spread[before].max():.2f}; {ms:.2f} ms/row {' '.join(named)}",
                    flush=True,
                )
                for window in WINDOWS_S if curves else ():
                    again = statistics(monitors[window], steps, window)
                    by_window[window].append(
                        Watched(source, effect, noise, table.duration, *again, ms)
                    )
    return found, by_window


def monitor_with_window(monitor: Monitor, baseline: list[FilterStep], window: float) -> Monitor:
    """The monitor with the step test's threshold for another window."""
    t, step, _ = statistics(replace(monitor, step_threshold=1.0), baseline, window)
    level = watch.DAY_MARGIN * watch.return_level(
        t, step, 2.0 * monitor.mean_time_between_false_alarms
    )
    return replace(monitor, step_threshold=level)


def name(monitor: Monitor, table: FlightTable) -> tuple[str, ...]:
    """What the verb would say after the alarm: the last verdict and its effects."""
    watching = Watch(monitor)
    list(watch_rows(watching, table_rows(table)))
    if watching.naming is None:
        return ()
    return (watching.naming.verdict, *(c.effect.name for c in watching.naming.chosen))


def table_of(found: list[Watched], scale: float = 1.0) -> str:
    """One line of the table: false alarms an hour, detected, median and 90 % delay."""
    hours = sum(w.seconds if w.effect == "none" else ONSET_S for w in found) / 3600.0
    late = [w for w in found if w.effect != "none"]
    alarms = [w.alarm(scale, ONSET_S) for w in late]
    delays = [a - ONSET_S for a in alarms if a is not None]
    middle, slow = np.quantile(delays, [0.5, 0.9]) if delays else (np.nan, np.nan)
    false = sum(w.false_alarms(scale) for w in found)
    return (
        f"{false:4d} in {hours:.2f} h | {false / hours:6.1f} | "
        f"{len(delays):3d} of {len(late):3d} | {middle:6.2f} | {slow:6.2f}"
    )


HEAD = "false alarms | per hour | detected | median delay [s] | 90 % [s]"


def report(found: list[Watched], by_window: dict[float, list[Watched]]) -> list[str]:
    """The tables as lines of text."""
    lines = [f"source | {HEAD}"]
    for source in ("kit", "jsbsim"):
        lines.append(f"{source:6} | {table_of([w for w in found if w.source == source])}")
    for noise in dict.fromkeys(w.noise for w in found):
        lines.append(f"{noise:6} | {table_of([w for w in found if w.noise == noise])}")
    lines += ["", f"thresholds times | {HEAD}"]
    lines += [f"{scale:5.2f} | {table_of(found, scale)}" for scale in SCALES]
    if any(by_window.values()):
        lines += ["", f"window of onsets [s] | {HEAD}"]
        lines += [f"{window:5.1f} | {table_of(part)}" for window, part in by_window.items()]
    lines += ["", "effect | detected | median delay [s]"]
    for effect in sorted({w.effect for w in found} - {"none"}):
        mine = [w.alarm(1.0, ONSET_S) for w in found if w.effect == effect]
        delays = [a - ONSET_S for a in mine if a is not None]
        lines.append(f"{effect:17} | {len(delays)} of {len(mine)} | "
                     f"{np.median(delays) if delays else np.nan:.2f}")  # fmt: skip
    ms = np.array([w.ms_per_row for w in found])
    lines += ["", f"{np.median(ms):.2f} ms of one core a row at 20 Hz, {50.0 / np.median(ms):.0f} "
              "times faster than real time"]  # fmt: skip
    return lines


def test_delay_and_false_alarms(capsys: pytest.CaptureFixture[str]) -> None:
    """At least 20 calm flights and 20 onsets, on seeds that no constant was chosen on."""
    found, by_window = study(seed=270, aircraft=2)
    assert sum(w.effect == "none" for w in found) >= 20
    assert sum(w.effect != "none" for w in found) >= 20
    with capsys.disabled():
        print("\n" + "\n".join(report(found, by_window)))


def alfa_monitor(before: FlightTable) -> Monitor:
    """The nominal model of a nine-state aircraft in wind, and thresholds, from its healthy flight.

    As in tools/demo/alfa.py; noise and thresholds leave out the log's first 12 s, in which the
    autopilot's position and velocity differ.
    """
    start = alfa_initial_model(read_alfa_metadata())
    found = identify([before], model=start, prior=nominal_prior(start))
    base = calibrate_nominal_model(
        found, WHITE_NOISE, found.result, found.fitted_windows, applicable_effects(found.model)
    )
    # The covariance of the fit under its prior; without it two minutes leave much open.
    confidence = found.uncertainty
    prior = watch.another_day_prior(found.model, confidence.names, confidence.covariance)
    base = replace(base, prior=prior)
    return build_monitor(base, [slice_time(before, SETTLING_S, np.inf)])


def watch_alfa() -> list[str]:
    """ALFA's engine failure, with the throttle held as before the failure and as logged."""
    table = read_flight_table(data_path("alfa_engine_failure.csv"))
    failure = float(read_alfa_metadata()["failure_time"])
    monitor = alfa_monitor(slice_time(table, 0.0, failure))
    noise = monitor.noise
    lines = [
        f"disturbances {np.round(noise.disturbance, 3)}, {noise.disturbance_time:.2f} s; "
        f"velocity, rates, airspeed {np.round(noise.motion, 3)}; "
        f"thresholds {monitor.step_threshold:.1f} and {monitor.spread_threshold:.1f}"
    ]
    catalogue = applicable_effects(monitor.base.result.model)
    for label, flown in (("held", hold_throttle(table, failure)), ("logged", table)):
        flown = slice_time(flown, SETTLING_S, np.inf)
        steps, ms = run(monitor, flown)
        t, step, spread = statistics(monitor, steps)
        drift = np.sqrt(np.mean([one.drift**2 for one in steps], axis=0))
        lines.append(f"loads left open by the parameters: {np.round(drift, 3)}")
        for name_, values in (("step", step), ("spread", spread)):
            healthy, late = values[t < failure], (values > 1.0) & (t >= failure)
            first = f"{t[np.argmax(late)] - failure:.2f} s" if late.any() else "never"
            lines.append(
                f"throttle {label}, {name_}: largest before the failure {healthy.max():.2f} of the "
                f"threshold at {t[np.argmax(healthy)]:.1f} s, after it "
                f"{values[t >= failure].max():.2f}; alarm {first} after it; {ms:.2f} ms a row"
            )
        lines += [
            f"throttle {label}: {event.t:.2f} s ({event.t - failure:+.2f}) {event.kind}: "
            f"{event.text}"
            for event in watch_rows(Watch(monitor, catalogue), table_rows(flown))
        ]
    return lines


def test_engine_failure_of_a_real_flight(capsys: pytest.CaptureFixture[str]) -> None:
    """ALFA, all constants fixed on simulated flights."""
    with capsys.disabled():
        print("\n" + "\n".join(watch_alfa()))


def main() -> None:
    """Run a study from the command line."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--seed", type=int, default=70)
    parser.add_argument("--aircraft", type=int, default=4)
    parser.add_argument("--curves", action="store_true")
    parser.add_argument("--names", action="store_true")
    parser.add_argument("--alfa", action="store_true", help="only the real flight")
    asked = parser.parse_args()
    if asked.alfa:
        print("\n".join(watch_alfa()))
        return
    print("\n".join(report(*study(asked.seed, asked.aircraft, asked.curves, asked.names))))


if __name__ == "__main__":
    main()
