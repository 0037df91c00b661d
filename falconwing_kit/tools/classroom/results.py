"""Results: the log of a simulated flight -> the same flight flown again, its verdict in one
sentence, the scores of who held the sticks, and the data that the player shows.

A simulated flight has no chance in it: the task, the seed, the effects and the logged commands
give the same states and the same verdict again, bit by bit on one machine. A log whose states
disagree with its own commands was changed, and is not judged.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit import __version__
from falconwing_kit.aircraft.airframe import Airframe
from falconwing_kit.aircraft.effect import Effect
from falconwing_kit.aircraft.effects import CATALOGUE, EFFECT_NAMES
from falconwing_kit.aircraft.model import Model
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.control.guidance import Hall
from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.files import short_name
from falconwing_kit.core.flight_log import FlightLog, read_flight_log
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.core.frames import wrap_angle
from falconwing_kit.core.messages import CONTROL_PERIOD_S, Command, Event, State
from falconwing_kit.flight.judges import FollowEvaluator
from falconwing_kit.flight.loop import LoopStep
from falconwing_kit.flight.sources import TIME_ROUNDING, fpv_camera
from falconwing_kit.flight.tasks import TASKS, FlightTask, TrialSetup
from falconwing_kit.flight.world import Contact

Numbers = dict[str, tuple[float, str]]  # label -> value and unit

NOBODY, AUTOPILOT, STUDENT, SAFE = range(4)  # who holds the sticks
HOLDERS = {"nobody": NOBODY, "autopilot": AUTOPILOT, "student": STUDENT, "safe": SAFE}
SAME_FLIGHT = 1e-3  # a logged pose or velocity this near is reproduced [m, rad, m/s]
COMPARED = 9  # states: position, attitude and velocity; rates follow from them
ROWS_MM, ROWS_RAD = 3, 4  # digits of positions [m] and angles [rad] in the player's data
LOCK_SHOWN_S = 0.1  # a shorter lock on the leader is no score
MAX_STEPS = 40_000  # of a flight that is flown again: 33 minutes


@dataclass(frozen=True)
class FlightRecord:
    """A flight of the classroom and where its log is."""

    number: int
    log: Path  # MCAP
    task: str
    manoeuvre: str  # of the leader; empty for a task without one
    scene: str
    seed: int  # of the trial
    autopilot: str  # its name
    holders: tuple[str, ...]  # who flew
    effects: tuple[str, ...]  # active at the start


@dataclass(frozen=True)
class Score:
    """What one person reached in a flight, for the board."""

    name: str
    task: str
    value: float
    unit: str
    second: tuple[float, str] | None = None  # a further number and its unit: the sink rate


@dataclass(frozen=True)
class Verdict:
    """The judgement of a flight."""

    sentence: str
    success: bool | None  # None: not judged
    numbers: Numbers
    scores: tuple[Score, ...] = ()  # none where no person flew the decisive part
    reproduced: bool = True  # False: flown again, the log's commands give other states


@dataclass(frozen=True, eq=False)
class Reflight:
    """A log flown again, n steps."""

    task: str
    manoeuvre: str
    t: Array  # (n,) [s]
    states: Array  # (n, 12) the true ones in the order of STATE_NAMES, SI
    leader: Array | None  # (n, 12) of the leader
    commands: Array  # (n, 4) in the order of COMMAND_NAMES
    holder: NDArray[np.int64]  # (n,) NOBODY, AUTOPILOT, STUDENT or SAFE
    names: tuple[str, ...]  # n, who held the sticks
    locked: NDArray[np.bool_] | None  # (n,) the leader in the camera's view
    measures: Mapping[str, Any]  # of the task's own judge
    contact: Contact | None
    difference: float  # largest, of logged and reproduced states [m, rad, m/s]; nan: none logged
    differs_at: float  # the first time at which they differ [s]; nan where they agree
    refused: str  # why the log is not judged; empty where it is
    pad: LandingPad | None
    airframe: Airframe | None
    events: tuple[Event, ...] = ()
    metadata: Mapping[str, str] = field(default_factory=dict)

    @property
    def table(self) -> FlightTable:
        """True poses, velocities and rates with the commands, for prediction errors."""
        x = self.states
        names = ("vx", "vy", "vz", "p", "q", "r")
        # Columns that are zero everywhere were not measured.
        extra = {name: x[:, 6 + i] for i, name in enumerate(names) if np.nansum(x[:, 6 + i] ** 2)}
        attitude = wrap_angle(x[:, [5, 3, 4]])
        return FlightTable("the flight", self.t, x[:, :3], attitude, self.commands, extra)


def record_of_log(path: str | Path, number: int = 1) -> FlightRecord:
    """The record of a log from what the log says about itself.

    Args:
        path: an MCAP log of the kit.
        number: of the flight, shown in titles.

    Raises:
        FileNotFoundError: there is no log.
        InputError: it is no log of the kit.
    """
    log = read_flight_log(path)
    task, manoeuvre = _task_names(log.metadata)
    says = log.metadata.get
    seed = says("seed", "0")
    people = [str(event.details.get("name", "")) for event in log.events if event.name == "hands"]
    pilot = says("pilot", "autopilot")
    return FlightRecord(
        number, Path(path), task, manoeuvre, says("scene", ""), int(seed) if seed.isdigit() else 0,
        pilot, tuple(dict.fromkeys(name for name in people if name)) or (pilot,), (),
    )  # fmt: skip


def judge(record: FlightRecord) -> Verdict:
    """Fly the log again through the task's own judge.

    Returns:
        The verdict; `success` is None where the flight cannot be judged, and the sentence says why.

    Raises:
        FileNotFoundError: there is no log.
        InputError: it is no log of the kit.
    """
    flight = refly(record)
    if flight.refused:
        return Verdict(flight.refused, None, _flown_numbers(flight), (), False)
    why = next(
        (str(e.details.get("reason", "")) for e in flight.events if e.name == "handed back"), ""
    )
    return _with_hand_back(_judged(flight), why)


def _judged(flight: Reflight) -> Verdict:
    """The verdict of the task's own judge."""
    seconds = _duration(flight)
    if flight.task == "landing":
        pad, height = flight.pad or LandingPad(), float(flight.states[-1, 2])
        verdict = _landing_verdict(flight.contact, flight.measures, pad, seconds, height)
        return replace(verdict, scores=_landing_scores(flight))
    if flight.task == "follow":
        verdict = _follow_verdict(flight.contact, flight.measures, seconds)
        lock = CONTROL_PERIOD_S * longest_run(np.asarray(flight.locked, bool))
        numbers = {**verdict.numbers, "longest lock": (lock, "s")}
        return replace(verdict, numbers=numbers, scores=_follow_scores(flight))
    return Verdict(f"flew for {seconds:.1f} s", None, _flown_numbers(flight))


def refly(record: FlightRecord) -> Reflight:
    """Fly a log again: the world of its task and seed, its commands at their own times.

    An effect acts from the time of its event on. A log that cannot be flown again (no task, no
    commands, flown by a real aircraft or through the trainer port) is returned as it is, with its
    logged states and the reason in `refused`.

    Raises:
        FileNotFoundError: there is no log.
        InputError: it is no log of the kit.
    """
    stamp = record.log.stat() if record.log.is_file() else None
    return _refly(record, None if stamp is None else (stamp.st_mtime_ns, stamp.st_size))


@lru_cache(maxsize=8)
def _refly(record: FlightRecord, stamp: tuple[int, int] | None) -> Reflight:
    log = read_flight_log(record.log)
    refused = _refusal(record, log)
    if refused:
        return _as_logged(record, log, refused)
    steps = _steps(log)
    flown = _fly_again(record, log, steps, 0.0)
    if flown.refused and any(event.name == "effect" for event in log.events):
        # A switch that was noted at the end of its step acted one step earlier.
        earlier = _fly_again(record, log, steps, -CONTROL_PERIOD_S)
        flown = flown if earlier.refused else earlier
    return flown


def model_with_effects(base: Model, active: Mapping[str, Mapping[str, float]]) -> Model:
    """A model with effects of the catalogue; two of the same dynamics count once.

    Args:
        base: the aircraft without them.
        active: names of effects with the values of their parameters, in the order of adding.

    Raises:
        InputError: an effect or a parameter is not of the catalogue, or a value is not finite.
    """
    model = base
    for name, given in active.items():
        values = {key: require_range(key, value) for key, value in given.items()}
        effect = _form_of_effect(name, values)
        if effect not in model.effects:
            model = model.with_effect(effect)
        model = model.with_values(values)
    return model


def _form_of_effect(name: str, values: Mapping[str, float]) -> Effect:
    """The form of an effect, or of the one with its dynamics, that has these parameters."""
    if name not in EFFECT_NAMES:
        raise InputError(f"effect: expected one of {', '.join(EFFECT_NAMES)}, got {name!r}")
    names = {name, *(effect.same_as for effect in CATALOGUE if effect.name == name)}
    forms = [effect for effect in CATALOGUE if effect.name in names and effect.parameters]
    having = (e for e in forms if set(values) <= {p.name for p in e.parameters})
    return next(having, forms[0])


def flight_data(record: FlightRecord, model: Model | None = None, name: str = "") -> dict[str, Any]:
    """What the player shows of a flight, as JSON holds it.

    Args:
        record: the flight.
        model: of the ghost; None for the kit's nominal model.
        name: of that model.

    Raises:
        FileNotFoundError: there is no log.
        InputError: it is no log of the kit, or holds neither states nor commands.
    """
    from falconwing_kit.tools.classroom.ghost import ghost_data

    flight, verdict = refly(record), judge(record)
    if len(flight.t) == 0:
        raise InputError(f"{short_name(record.log)}: expected a log with states to show, got none")
    simulated = flight.metadata.get("simulated", "yes") != "no"
    what = f"{flight.task} {flight.manoeuvre}".strip() or "flight"
    hall, pad, lens = Hall(), flight.pad or LandingPad(), fpv_camera()
    mount = (0.0, 0.0, 0.0) if flight.airframe is None else flight.airframe.p_body_camera
    fov = math.degrees(2.0 * math.atan(0.5 * lens.width / lens.fx))
    return {
        "version": 1,
        "number": record.number,
        "simulated": simulated,
        "task": flight.task,
        "scene": record.scene or flight.metadata.get("scene", ""),
        "manoeuvre": flight.manoeuvre,
        "seed": record.seed,
        "kit": flight.metadata.get("kit_version", __version__),
        "title": f"Flight {record.number}: {what.replace('_', ' ')}",
        "sentence": verdict.sentence,
        "success": verdict.success,
        "numbers": {
            label: [round(value, 4), unit]
            for label, (value, unit) in verdict.numbers.items()
            if math.isfinite(value)
        },
        "holders": list(record.holders),
        "period": CONTROL_PERIOD_S,
        "t": np.round(flight.t, 3).tolist(),
        "pose": pose_rows(flight.states),
        "speed": _numbers(np.linalg.norm(flight.states[:, 6:9], axis=1), ROWS_MM),
        "command": [[round(float(u), 4) for u in row] for row in flight.commands],
        "holder": flight.holder.tolist(),
        "leader": None if flight.leader is None else pose_rows(flight.leader),
        "events": [
            {"t": round(event.t, 3), "text": text, **_who(event)}
            for event in flight.events
            if (text := event_text(event))
        ],
        "effects": sorted({*record.effects, *_switched(flight.events)}),
        "ghost": ghost_data(flight, model, name),
        "pad": {
            "x0": pad.x_start,
            "x1": pad.x_start + pad.length,
            "y0": pad.y_centre - 0.5 * pad.width,
            "y1": pad.y_centre + 0.5 * pad.width,
            "z": pad.height,
        },
        "hall": {"x": list(hall.x), "y": list(hall.y), "z": [0.0, hall.height]},
        "camera": {
            "p_body_camera": [float(p) for p in mount],
            "fov_deg": round(fov, 3),
            "pitch_deg": 0.0,
        },
    }


def name_missing(
    record: FlightRecord, reference: Path | None = None, progress: Any = None
) -> dict[str, Any]:
    """What a flight's model lacks: `missing.name_missing`, the record of `gap` and a sentence.

    Args:
        record: the flight, at least 20 s long.
        reference: log or table of a calm flight; None: one is simulated.
        progress: called with the name of each stage.
    """
    from falconwing_kit.tools.classroom import missing

    return missing.name_missing(record, reference, progress)


def pose_rows(states: Array) -> list[list[float | None]]:
    """States (n, 6 or more) as rows x y z roll pitch yaw [m, rad]; None for what is not finite."""
    order = states[:, [0, 1, 2, 5, 3, 4]].copy()
    order[:, 3:] = wrap_angle(order[:, 3:])
    digits = (ROWS_MM,) * 3 + (ROWS_RAD,) * 3
    return [[_number(x, d) for x, d in zip(row, digits, strict=True)] for row in order.tolist()]


def event_text(event: Event) -> str:
    """An event as one plain sentence; empty for one that is not shown."""
    says = event.details.get
    reason = str(says("reason", ""))
    if event.name == "hands":
        who = str(says("name", "") or says("holder", ""))
        if says("holder") == "safe":
            who = "SAFE: sticks neutral"
        elif says("holder") == "autopilot":
            who = "autopilot flies"
        elif says("holder") == "student":
            who = f"{who} flies"
        return f"{who} ({reason})" if reason else who
    if event.name == "effect":
        return f"{str(says('name', '')).replace('_', ' ')} {'on' if says('on') else 'off'}"
    texts = {
        "mode": str(says("mode", "")),
        "ended": f"end: {reason}" if reason else "end",
        "pilot failed": "the pilot failed: sticks neutral, motor idle",
        "handed back": f"the supervisor handed back: {reason}",
        "interrupted": "stopped",
        "pause": "paused" if says("on", True) else "goes on",
        "speed": f"time runs {says('value', 1.0)} times",
        "restart": "begun again",
    }
    return texts.get(event.name, "")


def _who(event: Event) -> dict[str, str]:
    """The name of the person who takes the sticks in an event."""
    is_person = event.name == "hands" and event.details.get("holder") == "student"
    return {"who": str(event.details.get("name", ""))} if is_person else {}


# Flying again


@dataclass(frozen=True, eq=False)
class _Steps:
    """The steps of a log: their times, commands and logged states."""

    t: Array  # (n,)
    commands: Array  # (n, 4)
    logged: Array  # (n, 12), nan where no state was logged


def _refusal(record: FlightRecord, log: FlightLog) -> str:
    """Why a log cannot be flown again; empty where it can."""
    task, manoeuvre = _task_names(log.metadata)
    if log.metadata.get("simulated", "yes") == "no":
        return "not judged: flown by a real aircraft, so nobody measured the touchdown"
    if log.metadata.get("port"):
        return "not judged: flown through the trainer port, whose pulses the log does not hold"
    if not record.task:
        return "not judged: the log does not say which task was flown"
    if record.task not in TASKS:
        return f"not judged: the kit has no task {record.task!r}"
    if task and (task, manoeuvre) != (record.task, record.manoeuvre):
        return f"not judged: the log says task {task} {manoeuvre}".rstrip() + (
            f", the flight was {record.task} {record.manoeuvre}".rstrip()
        )
    if log.metadata.get("seed", str(record.seed)) != str(record.seed):
        return f"not judged: the log says seed {log.metadata['seed']}, the flight had {record.seed}"
    if not log.commands:
        return "not judged: the log holds no commands"
    if len(log.commands) > MAX_STEPS:
        return f"not judged: expected at most {MAX_STEPS} steps, got {len(log.commands)}"
    return ""


def _task_names(metadata: Mapping[str, str]) -> tuple[str, str]:
    """Task and manoeuvre of a log; `fly` writes both into one text."""
    task, _, rest = metadata.get("task", "").partition(" ")
    return task, metadata.get("manoeuvre", "") or rest


def _steps(log: FlightLog) -> _Steps:
    """Steps, their commands and states: a step logs its command and then its state."""
    vectors = np.array([command.vector for command in log.commands])
    states = np.array([state.vector for state in log.states]).reshape(-1, 12)
    n = len(states)
    if n and n in (len(vectors), len(vectors) - 1):  # the last command alone is the safe one
        return _Steps(log.state_times, vectors[:n], states)
    # Without a state in every step: the step whose deadline is not after the command.
    t = CONTROL_PERIOD_S * np.floor(log.command_times / CONTROL_PERIOD_S + TIME_ROUNDING)
    t, last = np.unique(t[::-1], return_index=True)
    logged = np.full((len(t), 12), np.nan)
    if n:
        row = np.searchsorted(t, log.state_times - TIME_ROUNDING)
        inside = row < len(t)
        near = np.abs(t[np.minimum(row, len(t) - 1)] - log.state_times) < TIME_ROUNDING
        logged[row[inside & near]] = states[inside & near]
    return _Steps(t, vectors[::-1][last], logged)


def _fly_again(record: FlightRecord, log: FlightLog, steps: _Steps, earlier: float) -> Reflight:
    """Fly the steps of a log; `earlier` is added to the time of every switch of an effect [s]."""
    task: Any = TASKS[record.task].make(*((record.manoeuvre,) if record.manoeuvre else ()))
    start = _logged_start(log)
    if start is not None:
        task = replace(task, start=start)
    trial = task.trial(record.seed)
    world, judge = trial.world, task.judge(trial, fpv_camera())
    switches = [event for event in log.events if event.name == "effect"]
    active: dict[str, Mapping[str, float]] = {}
    states, measured, leaders, reached = [], [], [], 0
    try:
        for t, command in zip(steps.t, steps.commands, strict=True):
            while switches and switches[0].t + earlier < t - TIME_ROUNDING:
                # A switch after the last step acts on the whole way from there to this one.
                _switch(active, switches.pop(0))
                world.change_model(model_with_effects(task.model, active))
            world.advance(max(float(t), world.t))
            sent = Command.clip(*command.tolist())
            states.append(world.state.vector)
            measured.append(world.measured().vector)
            if trial.leader is not None:
                leaders.append(trial.leader.state_at(float(t)).vector)
            world.send(float(t), sent)
            reached += 1
            if judge.watch(LoopStep(float(t), None, world.measured(), sent, "", None)):
                break
    except InputError as error:
        return _as_logged(record, log, f"not judged: {error}")
    difference, differs_at = _difference(steps, np.array(measured))
    t = steps.t[:reached]
    holder, names = _holders(log.events, t, record.autopilot)
    refused = ""
    if math.isfinite(differs_at):
        refused = (
            f"not judged: flown again, the log's commands lead elsewhere from {differs_at:.2f} s"
            f" on (by {difference:.2g} m, rad or m/s): the log was changed, holds estimates in"
            " place of measured states, or is of another version of the kit"
        )
    elif reached < len(steps.t) - 1:
        refused = (
            f"not judged: flown again, the flight is over at {t[-1]:.2f} s, but the log goes on to"
            f" {steps.t[-1]:.2f} s: the log was changed"
        )
    elif not math.isfinite(difference):
        refused = "not judged: the log holds no measured states to compare with"
    return Reflight(
        record.task, record.manoeuvre, t, np.array(states),
        np.array(leaders) if leaders else None, steps.commands[:reached], holder, names,
        judge.locked if isinstance(judge, FollowEvaluator) else None,
        judge.result(), world.contact, difference, differs_at, refused,
        getattr(task, "pad", None), task.airframe, log.events, log.metadata,
    )  # fmt: skip


def _logged_start(log: FlightLog) -> State | None:
    """The start that a log names; None where it is that of the seed."""
    text = log.metadata.get("start", "")
    if not text or text == "None":
        return None
    try:
        return State.from_vector(np.array(json.loads(text), np.float64))
    except (ValueError, TypeError):
        raise InputError(
            f"{short_name(log.path)}: start: expected a list of 12 numbers, got {text[:60]!r}"
        ) from None


def _switch(active: dict[str, Mapping[str, float]], event: Event) -> None:
    """Switch one effect of a set on or off."""
    name = str(event.details.get("name", ""))
    if event.details.get("on"):
        parameters = event.details.get("parameters") or {}
        active[name] = dict(parameters) if isinstance(parameters, Mapping) else {}
    else:
        active.pop(name, None)


def _switched(events: Sequence[Event]) -> list[str]:
    """Names of the effects that were on at some time."""
    on = [event for event in events if event.name == "effect" and event.details.get("on")]
    return [str(event.details.get("name", "")) for event in on]


def _difference(steps: _Steps, measured: Array) -> tuple[float, float]:
    """Largest difference of logged and reproduced states, and when it first is too large [s]."""
    if len(measured) == 0:
        return math.nan, math.nan
    between = measured[:, :COMPARED] - steps.logged[: len(measured), :COMPARED]
    between[:, 3:6] = wrap_angle(between[:, 3:6])
    size = np.abs(between).max(axis=1)
    if not np.isfinite(size).any():
        return math.nan, math.nan
    too_large = np.flatnonzero(size > SAME_FLIGHT)
    first = float(steps.t[too_large[0]]) if len(too_large) else math.nan
    return float(np.nanmax(size)), first


def _as_logged(record: FlightRecord, log: FlightLog, refused: str) -> Reflight:
    """A log that is not flown again: its own states."""
    t = log.state_times
    states = np.array([state.vector for state in log.states]).reshape(-1, 12)
    commands = np.zeros((len(t), 4))
    if log.commands:
        row = np.searchsorted(log.command_times, t + TIME_ROUNDING, side="right") - 1
        commands = np.array([c.vector for c in log.commands])[np.maximum(row, 0)]
    holder, names = _holders(log.events, t, record.autopilot)
    entry = TASKS.get(record.task)
    task: Any = None
    if entry is not None:
        task = entry.make(*((record.manoeuvre,) if record.manoeuvre else ()))
    return Reflight(
        record.task, record.manoeuvre, t, states, None, commands, holder, names, None, {}, None,
        math.nan, math.nan, refused, getattr(task, "pad", None),
        None if task is None else task.airframe, log.events, log.metadata,
    )  # fmt: skip


def _holders(
    events: Sequence[Event], t: Array, autopilot: str
) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Who held the sticks in every step: its number and name."""
    hands = sorted((event for event in events if event.name == "hands"), key=lambda event: event.t)
    holder = np.full(len(t), AUTOPILOT if autopilot else NOBODY)
    names = np.full(len(t), autopilot or "nobody", dtype=object)
    for event in hands:
        after = t >= event.t - TIME_ROUNDING
        holder[after] = HOLDERS.get(str(event.details.get("holder", "")), NOBODY)
        names[after] = str(event.details.get("name", "") or event.details.get("holder", ""))
    return holder, tuple(str(name) for name in names)


# Verdicts


def live_verdict(
    task: FlightTask, trial: TrialSetup, result: Mapping[str, Any], reason: str = "",
    handed_back: str = "",
) -> Verdict:  # fmt: skip
    """The verdict right after a flight, in the words of `judge`.

    Args:
        task: that was flown.
        trial: its world, after the flight.
        result: of the task's judge.
        reason: why the loop ended; where it is "pilot failed" the sentence says so.
        handed_back: the supervisor's reason; empty where it found no fault.
    """
    return _with_hand_back(_live_verdict(task, trial, result, reason), handed_back)


def _with_hand_back(verdict: Verdict, why: str) -> Verdict:
    """A flight that the supervisor ended is no success, and the verdict says why."""
    if not why:
        return verdict
    sentence = f"{verdict.sentence}; the supervisor handed back: {why}"
    return replace(verdict, sentence=sentence, success=False)


def _live_verdict(
    task: FlightTask, trial: TrialSetup, result: Mapping[str, Any], reason: str
) -> Verdict:
    contact, seconds = trial.world.contact, trial.world.t + CONTROL_PERIOD_S
    if trial.leader is not None:
        return _follow_verdict(contact, result, contact.t if contact else seconds)
    pad, height = getattr(task, "pad", LandingPad()), float(trial.world.state.p_world[2])
    verdict = _landing_verdict(contact, result, pad, contact.t if contact else seconds, height)
    if contact is None and reason == "pilot failed":
        return replace(verdict, sentence="did not land: the pilot failed")
    return verdict


def _landing_verdict(
    contact: Contact | None, measures: Mapping[str, Any], pad: LandingPad, seconds: float,
    height: float,
) -> Verdict:  # fmt: skip
    """Where the wheels first touched, or what else was hit."""
    numbers: Numbers = {"flown": (seconds, "s")}
    if contact is None:
        sentence = f"did not land: the flight ended after {seconds:.1f} s, {height:.1f} m high"
        return Verdict(sentence, False, numbers)
    touchdown = contact.touchdown
    if touchdown is None:
        return Verdict(_collision_text(contact), False, numbers)
    offset = 100.0 * abs(touchdown.lateral_offset)
    numbers |= {
        "off the centre line": (offset, "cm"),
        "sink rate": (touchdown.sink_rate, "m/s"),
        "past the threshold": (touchdown.past_threshold, "m"),
        "speed": (touchdown.speed, "m/s"),
        "bank": (math.degrees(touchdown.bank), "deg"),
        "pitch": (math.degrees(touchdown.pitch), "deg"),
    }
    if not touchdown.on_pad:
        return Verdict(_miss_text(touchdown.p_world_wheel, touchdown.surface, pad), False, numbers)
    side = "left" if touchdown.lateral_offset > 0.0 else "right"
    where = "on the centre line" if offset < 0.5 else f"{offset:.0f} cm {side} of the centre line"
    sentence = f"on the pad, {where}, {touchdown.sink_rate:.2f} m/s down"
    return Verdict(sentence, bool(measures["success"]), numbers)


def _landing_scores(flight: Reflight) -> tuple[Score, ...]:
    """The score of who held the sticks when the wheels touched the pad."""
    touchdown = None if flight.contact is None else flight.contact.touchdown
    if touchdown is None or not touchdown.on_pad or flight.holder[-1] != STUDENT:
        return ()
    offset = round(100.0 * abs(touchdown.lateral_offset), 2)
    sink = (round(touchdown.sink_rate, 3), "m/s")
    return (Score(flight.names[-1], "landing", offset, "cm", sink),)


def _miss_text(p_world_wheel: Array, surface: str, pad: LandingPad) -> str:
    """Where the wheels touched that should have touched the pad."""
    x, y = float(p_world_wheel[0]), float(p_world_wheel[1])
    short, past = pad.x_start - x, x - pad.x_start - pad.length
    beside = abs(y - pad.y_centre) - 0.5 * pad.width
    if surface == "pad edge":
        return "hit the edge of the pad"
    if short > 0.0:
        return f"touched the floor {short:.1f} m short of the pad"
    if past > 0.0:
        return f"touched the floor {past:.1f} m past the pad"
    side = "left" if y > pad.y_centre else "right"
    return f"touched the floor {max(beside, 0.0):.1f} m {side} of the pad"


def _collision_text(contact: Contact) -> str:
    """What was hit, other than by a wheel."""
    return {
        "pad": "a wing tip, nose or tail touched the pad before a wheel did",
        "pad edge": "hit the edge of the pad",
        "floor": "a wing tip, nose or tail touched the floor before a wheel did",
        "wall": "flew into a wall",
        "ceiling": "flew into the ceiling",
        "leader": "flew into the leader",
    }[contact.obstacle]


def _follow_verdict(
    contact: Contact | None, measures: Mapping[str, Any], seconds: float
) -> Verdict:
    """How long the leader was in view."""
    share = float(measures["locked_share"])
    numbers: Numbers = {"flown": (seconds, "s"), "leader in view": (100.0 * share, "%")}
    for key, label in (("ate_path_m", "error along the path"), ("ate_d_m", "error of distance")):
        if measures.get(key) is not None:
            numbers[label] = (float(measures[key]), "m")
    sentence = f"in view of the camera {100.0 * share:.0f} % of {seconds:.0f} s"
    if contact is not None:
        landed = contact.touchdown is not None
        sentence += f", then {'touched the floor' if landed else _collision_text(contact)}"
    return Verdict(sentence, bool(measures["success"]), numbers)


def _follow_scores(flight: Reflight) -> tuple[Score, ...]:
    """The longest lock of everyone who held the sticks, while they did."""
    locked = np.zeros(len(flight.t), bool) if flight.locked is None else flight.locked
    names, scores = np.array(flight.names, object), []
    for name in dict.fromkeys(names[flight.holder == STUDENT]):
        own = locked & (flight.holder == STUDENT) & (names == name)
        lock = CONTROL_PERIOD_S * longest_run(own)
        if lock >= LOCK_SHOWN_S:
            scores.append(Score(str(name), "follow", round(lock, 2), "s"))
    return tuple(scores)


def longest_run(mask: NDArray[np.bool_]) -> int:
    """The number of neighbours in the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def _duration(flight: Reflight) -> float:
    """Time of the contact, else of the last step's end [s]."""
    if flight.contact is not None:
        return flight.contact.t
    return float(flight.t[-1]) + CONTROL_PERIOD_S if len(flight.t) else 0.0


def _flown_numbers(flight: Reflight) -> Numbers:
    """What every flight has."""
    return {"flown": (_duration(flight), "s")}


def _numbers(values: Array, digits: int) -> list[float | None]:
    return [_number(value, digits) for value in values.tolist()]


def _number(value: float, digits: int) -> float | None:
    """Rounded for JSON; None for what is not finite."""
    return round(value, digits) + 0.0 if math.isfinite(value) else None
