"""What is missing: a flight of the class and a calm one -> the answer of `gap`, in one sentence.

The study runs in a process of its own with a low priority, so that what flies meanwhile keeps its
20 Hz; it reports its progress and ends at a time limit.
"""

import math
import multiprocessing
import os
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.aircraft.airframe import load_airframe
from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.aircraft.trim import trim
from falconwing_kit.control.expert import WaypointExpert
from falconwing_kit.control.loops import SPEED
from falconwing_kit.control.manoeuvres import MANOEUVRES
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.files import cache_folder
from falconwing_kit.core.flight_log import read_flight_log, to_flight_table
from falconwing_kit.core.flight_table import FlightTable, read_flight_table, write_flight_table
from falconwing_kit.core.messages import CONTROL_PERIOD_S, Command, Observation, State
from falconwing_kit.flight.world import SimulatedWorld
from falconwing_kit.gap.advice import headline, next_flight
from falconwing_kit.gap.study import SHORTEST_S, require_pair
from falconwing_kit.sysid.diagnose import require_sound_table
from falconwing_kit.tools.classroom.results import FlightRecord, model_with_effects

CALM_S, CALM_SEED = 60.0, 2026  # of the calm flight that is simulated
CALM_VERSION = 1  # of the simulated calm flight; a new one is flown after a change
ANSWER_S = 30.0  # after it the first answer is given, if there is one
LIMIT_S = 110.0  # of a study without any answer; who asked waits a little longer
# Amplitudes of the sines added to the calm autopilot's sticks: without them a steady flight hides
# what the sticks do. Throttle, aileron, elevator, rudder.
EXCITATION = np.array([0.035, 0.07, 0.06, 0.08])
FREQUENCIES_HZ = (0.15, 1.6)
SINES = 6
LAP_M = 112.0  # length of one figure eight
FLY_THIS = (
    "fly laps to the left and to the right for a minute, with sticks that move, and switch the"
    " effect on before or during them"
)

Progress = Callable[[str], None]


def name_missing(
    record: FlightRecord, reference: Path | None, progress: Progress | None = None,
    limit_s: float = LIMIT_S, answer_s: float = ANSWER_S,
) -> dict[str, Any]:  # fmt: skip
    """Compare a flight with a calm one and name the effect that the model lacks.

    Args:
        record: the flight, at least 20 s long.
        reference: log (.mcap) or table (.csv) of a calm flight of the same aircraft; None: one is
            simulated, once for all flights.
        progress: called with the name of each stage.
        limit_s: after this time the study is ended [s].
        answer_s: after this time it is ended too if the effect has a name already: the answer then
            has no sizes, and its sentence says that it is the first one [s].

    Returns:
        `verdict`, `effects`, `parameters`, `headline` and `next_flight` as report.json has them,
        and `sentence`. Where the flight is too short or the study did not end, `verdict` is "too
        short" or "failed" and the sentence says what to do.

    Raises:
        FileNotFoundError: there is no log or no reference.
        InputError: a file is no flight.
    """
    tell: Progress = progress or (lambda text: None)
    log = read_flight_log(record.log)
    if not log.commands or not log.states:
        return _no_answer("failed", "The log of this flight holds no states: nothing to compare.")
    flight = replace(to_flight_table(log), name=f"flight {record.number}")
    if flight.duration < SHORTEST_S:
        return _no_answer(
            "too short",
            f"This flight lasted {flight.duration:.1f} s, and naming needs {SHORTEST_S:.0f} s or"
            f" more: {FLY_THIS}; then ask again.",
        )
    tell("the calm flight")
    calm = calm_flight() if reference is None else read_reference(reference)
    return _study_in_process(calm, flight, tell, limit_s, answer_s)


def read_reference(path: Path) -> FlightTable:
    """A calm flight's table from its log or table.

    Raises:
        FileNotFoundError: there is no file.
        InputError: it is no flight.
    """
    if Path(path).suffix.lower() == ".csv":
        return read_flight_table(path)
    return to_flight_table(read_flight_log(path))


def calm_flight(seconds: float = CALM_S, seed: int = CALM_SEED) -> FlightTable:
    """The calm aircraft's flight, simulated once and then kept in the cache folder."""
    path = cache_folder() / "classroom" / f"calm_v{CALM_VERSION}_{seconds:g}s_{seed}.csv"
    with suppress(FileNotFoundError, InputError):
        return read_flight_table(path)
    table = simulate_laps(seconds, seed)
    with suppress(OSError, InputError):  # a folder that may not be written: flown again next time
        path.parent.mkdir(parents=True, exist_ok=True)
        write_flight_table(path, table)
    return table


def simulate_laps(
    seconds: float, seed: int, effects: dict[str, dict[str, float]] | None = None,
    excitation: float = 1.0,
) -> FlightTable:  # fmt: skip
    """The autopilot's figure eights in the simulated hall, with sines on its sticks.

    Args:
        seconds: length [s].
        seed: of start, noise and sines.
        effects: names of the catalogue with the values of their parameters; None for none.
        excitation: factor of the sines; 0 for a flight by the autopilot alone.

    Raises:
        InputError: the aircraft left the hall.
    """
    rng, base, airframe = np.random.default_rng([seed, 3]), rates_model(), load_airframe()
    lap = MANOEUVRES["figure_eight"].waypoints(rng)
    laps = math.ceil(seconds * SPEED / LAP_M) + 1
    pilot = WaypointExpert(base, airframe, np.concatenate([lap, *[lap[1:]] * (laps - 1)]))
    model = model_with_effects(base, effects or {})
    world = SimulatedWorld(model, airframe, _start_on(pilot), seed=seed)
    frequency = 2.0 * math.pi * rng.uniform(*FREQUENCIES_HZ, (SINES, 4))
    phase = rng.uniform(0.0, 2.0 * math.pi, (SINES, 4))
    past, rows = np.zeros((30, 4)), []
    for k in range(round(seconds / CONTROL_PERIOD_S)):
        t = k * CONTROL_PERIOD_S
        world.advance(t)
        if world.contact is not None:
            raise InputError(
                f"laps: expected {seconds:g} s in the hall, got a contact with the"
                f" {world.contact.obstacle} after {t:.1f} s; take a smaller effect"
            )
        state = world.measured()
        asked = pilot.act(Observation(t, None, past, state)).vector
        added = excitation * EXCITATION * np.sin(frequency * t + phase).sum(axis=0)
        command = Command.clip(*(asked + added).tolist())
        world.send(t, command)
        past = np.vstack([past[1:], command.vector])
        pose = [*state.p_world, state.roll, state.pitch, state.yaw]
        rows.append([t, *pose, *command.vector])
    table = np.array(rows)
    return FlightTable("calm laps", table[:, 0], table[:, 1:4], table[:, 4:7], table[:, 7:11])


def _start_on(pilot: WaypointExpert) -> State:
    """The trimmed flight at the first point of a pilot's path, along it."""
    path = pilot.path
    x: Array = trim(rates_model(), pilot.speed, float(path.climb[0])).state.copy()
    along = np.array([math.cos(path.yaw[0]), -math.sin(path.yaw[0])])
    x[:3], x[4] = path.p_world[0], x[4] + path.yaw[0]
    x[6:8] = along * x[6]
    return State.from_vector(x)


def _study_in_process(
    calm: FlightTable, flight: FlightTable, progress: Progress, limit_s: float,
    answer_s: float,
) -> dict[str, Any]:  # fmt: skip
    """Run the study in another process until it answers or the time is over."""
    context, begin = multiprocessing.get_context("spawn"), time.monotonic()
    end, first = begin + limit_s, dict[str, Any]()
    pipe, child = context.Pipe()
    process = context.Process(target=_study, args=(child, calm, flight), daemon=True)
    process.start()
    child.close()  # so that the end of the process closes the pipe
    try:
        while True:
            if not pipe.poll(max(0.0, end - time.monotonic())):
                if first:
                    return {**first, "sentence": first_sentence(first, time.monotonic() - begin)}
                return _no_answer(
                    "failed",
                    f"Naming took longer than {limit_s:.0f} s on this computer and was ended: ask"
                    " again while nothing else runs.",
                )
            kind, content = pipe.recv()
            if kind == "progress":
                progress(str(content))
            elif kind == "first":
                first, end = dict(content), min(end, begin + answer_s)
            elif kind == "done":
                return {**content, "sentence": answer_sentence(content)}
            else:
                return _no_answer("failed", f"No answer: {content}")
    except (EOFError, OSError):
        return _no_answer("failed", "The process that compared the flights ended; ask again.")
    finally:
        pipe.close()
        process.kill()
        process.join()


def _study(pipe: "Connection[Any, Any]", calm: FlightTable, flight: FlightTable) -> None:
    """In the process: progress, the first answer and the whole one go into the pipe.

    The stages of `study_gap` that an answer needs: what only its report shows is left out.
    """
    from falconwing_kit.gap.baseline import identify_baseline
    from falconwing_kit.gap.close import close_gap, name_with_onset

    def tell(stage: str) -> None:
        pipe.send(("progress", stage))

    with suppress(AttributeError, OSError):  # not on Windows
        os.nice(10)
    with suppress(EOFError, OSError, KeyboardInterrupt):
        try:
            require_pair(calm, flight)
            for table in (calm, flight):
                require_sound_table(table)
            base = identify_baseline(calm, tell)
            naming, _ = name_with_onset(base, flight, progress=tell)
            answer: dict[str, Any] = {
                "verdict": naming.verdict, "effects": [c.effect.name for c in naming.chosen],
                "parameters": {}, "headline": headline(naming), "next_flight": "",
            }  # fmt: skip
            pipe.send(("first", answer))
            tell("closing the gap")
            sizes = {
                name: {"value": s.value, "low95": s.low95, "high95": s.high95, "unit": s.unit}
                for name, s in close_gap(base, naming).parameters.items()
            }
            following = next_flight(base, naming)
            pipe.send(("done", {**answer, "parameters": sizes, "next_flight": following}))
        except InputError as error:
            pipe.send(("failed", str(error)))


def first_sentence(answer: dict[str, Any], seconds: float) -> str:
    """The sentence of a study that was ended before the sizes were known."""
    return (
        f"Not finished after {seconds:.0f} s; the first answer, without sizes, is:"
        f" {str(answer['headline']).rstrip('.')}."
    )


def answer_sentence(report: dict[str, Any]) -> str:
    """The verdict of a report with the sizes of what is missing, and what to fly next."""
    sizes = [
        f"{name.replace('_', ' ')} {p['value']:.3g} {p['unit']}".strip()
        + f", 95 %: {p['low95']:.3g} to {p['high95']:.3g}"
        for name, p in report["parameters"].items()
    ]
    sentence = str(report["headline"]).rstrip(".")
    if sizes:
        sentence += f" ({'; '.join(sizes)})"
    if report["verdict"] in ("ambiguous", "outside") and report["next_flight"]:
        sentence += f". {str(report['next_flight']).rstrip('.')}"
    return sentence + "."


def _no_answer(verdict: str, sentence: str) -> dict[str, Any]:
    return {"verdict": verdict, "effects": [], "parameters": {}, "sentence": sentence}
