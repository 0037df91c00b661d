"""Trials: a task and a pilot -> simulated flights from frozen starts, their records and statistics.

A folder keeps the flights in `trials.jsonl`, so that an interrupted study can be continued.
"""

import hashlib
import json
import math
import os
import platform
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.control.loops import LINK_DELAY_S
from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.files import atomic_write, short_name
from falconwing_kit.core.flight_log import FlightLogWriter
from falconwing_kit.flight.loop import (
    ImageSource,
    Loop,
    LoopStep,
    PacedClock,
    Pilot,
    SimulatedClock,
    StepSupervisor,
)
from falconwing_kit.flight.metadata import flight_metadata
from falconwing_kit.flight.sources import MeasuredStates, RenderedView, fpv_camera
from falconwing_kit.flight.supervisor import Supervisor
from falconwing_kit.flight.trial import FlightTask, TrialSetup, trial_seed
from falconwing_kit.flight.world import PoseNoise, SimulatedWorld
from falconwing_kit.scene.analog import AnalogVideo
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.tools.bridge.open_port import simulated_board
from falconwing_kit.tools.bridge.through_port import PortWorld
from falconwing_kit.tools.trials.statistics import (
    bootstrap_mean_interval,
    clopper_pearson_interval,
    mcnemar_p_value,
)

Record = dict[str, Any]
TRIALS = "trials.jsonl"
NO_IMAGES = "no images"
PATHS = ("path_m", "leader_path_m")
DIGITS = 16  # of a digest
# In the head of a study with a leader, and in its records; earlier versions wrote none.
LEADER = "leader_digest"
DIGESTS = {  # key of a head -> what differs where it differs
    LEADER: "another leader's path",
    "task_digest": "another duration, spread, noise, delay, model or airframe",
    "scene_digest": "another scene",
}
# Averaged over the trials that have it: key -> over successes only.
MEANS = {
    "ald_m": True,
    "sink_rate_m_s": True,
    "bank_abs_deg": True,
    "past_threshold_m": True,
    "ate_m": False,
    "ate_d_m": False,
    "ate_path_m": False,
    "locked_share": False,
}


@dataclass(frozen=True)
class TrialSettings:
    """Images, clock, hooks and port of trials."""

    scene: GaussianScene | None = None  # rendered for the pilot; None: no images
    camera: PinholeCamera = field(default_factory=fpv_camera)
    clock: type[SimulatedClock] | type[PacedClock] = SimulatedClock  # one instance per flight
    hooks: Sequence[Callable[[LoopStep], None]] = ()
    # a simulated board that every command goes through, one of `open_port.PORTS`; "" for none
    port: str = ""
    # the analog link of the scene's images; each trial's seed draws its noise; None: a direct view
    link: AnalogVideo | None = None
    # source of images and trial's seed -> the source that the pilot gets, such as a late one
    degrade: Callable[[ImageSource, int], ImageSource] | None = None
    scene_name: str = ""  # of the hall flown in, for the log: a name that ships, or a file
    R_body_mount: Array | None = None  # (3, 3) of a camera whose mount is off
    # whether the pilot flies by images -> a supervisor; None: one that acts where there is a port
    supervisor: Callable[[bool], StepSupervisor] | None = None

    @property
    def record(self) -> Record:
        """Everything that must be the same for flights to be comparable."""
        lens = self.camera
        record: Record = {
            "rendered": self.scene is not None,
            "size_px": [lens.width, lens.height],
            "focal_px": [lens.fx, lens.fy],
            "centre_px": [lens.cx, lens.cy],
            "clock": self.clock.__name__,
        }
        record |= {"port": self.port} if self.port else {}
        record |= {"degrade": repr(self.degrade)} if self.degrade else {}
        digest = None if self.scene is None else _scene_digest(self.scene, self.link)
        return record | {"scene_digest": digest}


def fly_trial(
    task: FlightTask,
    make_pilot: Callable[[TrialSetup], Pilot],
    number: int,
    seed: int = 0,
    setting: TrialSettings | None = None,
    log: str | Path | None = None,
    pilot_name: str = "",
) -> Record:
    """Fly one trial.

    Args:
        task: the task.
        make_pilot: returns a new pilot for a trial.
        number: of the trial in the frozen list, from 0.
        seed: number of the list.
        setting: images, clock and hooks; None: no images, simulated clock.
        log: an MCAP file to write; None for none.
        pilot_name: for the log's metadata; the pilot's type if empty.

    Returns:
        reason, steps, skipped and faults of the loop; art_ms, the pilot's run time in every step,
        with median, 95th percentile, machine and images; the measures of the task's evaluator.

    Raises:
        KeyboardInterrupt: Ctrl-C; the log is complete, the trial does not count.
        InputError: a number is out of its range, or the log cannot be written.
    """
    setting = setting or TrialSettings()
    trial = task.trial(trial_seed(number, seed))
    pilot = make_pilot(trial)
    with ExitStack() as stack:
        writer = stack.enter_context(FlightLogWriter(log)) if log is not None else None
        world: SimulatedWorld | PortWorld = trial.world
        if setting.port:
            world = _behind_port(stack, trial.world, setting.port, writer)
        view = None
        if setting.scene is not None:
            link = None if setting.link is None else replace(setting.link, seed=trial.seed)
            view = RenderedView(
                world, setting.scene, setting.camera, task.airframe.p_body_camera, link=link,
                R_body_mount=setting.R_body_mount,
            )  # fmt: skip
        judge = task.judge(trial, setting.camera, view)
        # A pilot that flies by images gets none, so that none of its success can be due to one.
        states = MeasuredStates(world) if getattr(pilot, "reads_state", True) else None
        images: ImageSource | None = view
        if view is not None and setting.degrade is not None:
            images = setting.degrade(view, trial.seed)
        elif states is None and view is None:
            raise InputError(
                "scene: expected one to render for a pilot that flies by images, got none; choose a"
                " scene"
            )
        # Through a board it is the path of a real flight, which is never without a supervisor.
        supervisor: StepSupervisor | None = None
        if setting.supervisor is not None:
            supervisor = setting.supervisor(states is None)
        elif setting.port:
            supervisor = Supervisor(by_images=states is None)
        loop = Loop(
            pilot, world, images, states, trial.leader, setting.clock(), writer, setting.hooks,
            supervisor,
        )  # fmt: skip
        if writer is not None:
            writer.metadata(
                flight_metadata(
                    task,
                    trial,
                    scene=setting.scene_name,
                    pilot=pilot_name or type(pilot).__name__,
                    port=setting.port,
                )
            )
        flight = loop.run(trial.duration, judge.watch)
        port: Record = {"port": world.record} if isinstance(world, PortWorld) else {}
        port |= {"supervisor": dict(supervisor.record)} if supervisor is not None else {}
    if flight.reason == "interrupted":
        raise KeyboardInterrupt
    record: Record = {"trial": number, "seed": trial.seed, "reason": flight.reason}
    record |= {"steps": len(flight.t), "skipped": flight.skipped, "faults": flight.faults}
    faults = [dict(event.details) for event in flight.events if event.name == "pilot failed"]
    record |= {"first_fault": faults[0]} if faults else {}
    record |= {} if trial.leader is None else {LEADER: trial.leader.digest[:DIGITS]}
    median, high = flight.milliseconds("pilot")
    record |= {"art_median_ms": median, "art_p95_ms": high, "machine": describe_machine()}
    record["art_ms"] = np.round(1e3 * flight.seconds["pilot"], 3).tolist()
    record["images"] = NO_IMAGES
    if view is not None:
        record["images"] = f"{view.camera.width}x{view.camera.height} images by {view.backend!r}"
    return record | port | judge.result()


def _behind_port(
    stack: ExitStack, world: SimulatedWorld, name: str, log: FlightLogWriter | None
) -> PortWorld:
    """The world behind a simulated board; events at the port go to the log."""

    def log_event(t: float, what: str, details: Mapping[str, Any]) -> None:
        if log is not None:
            # A full disk does not end the flight; the loop, which writes here too, reports it.
            with suppress(InputError):
                log.event(t, what, details)

    board = simulated_board(name)
    stack.callback(board.close)
    return stack.enter_context(PortWorld(world, board, on_event=log_event))


def fly_trials(
    task: FlightTask,
    make_pilot: Callable[[TrialSetup], Pilot],
    count: int,
    *,
    pilot: str,
    seed: int = 0,
    setting: TrialSettings | None = None,
    out: str | Path | None = None,
    head: Record | None = None,
    logs: bool = False,
    progress: Callable[[str], None] = lambda text: None,
    fly: Callable[[Sequence[int]], Iterable[Record]] | None = None,
) -> list[Record]:
    """Fly trials 0 to count - 1 of the frozen list, without those that a folder already holds.

    Args:
        task: the task.
        make_pilot: returns a new pilot for each trial.
        count: number of trials.
        pilot: the pilot's name.
        seed: number of the list of starts and noise; pilots on the same list make pairs.
        setting: images, clock and hooks.
        out: folder for the records, created if missing; None keeps none.
        head: of `study_head` if already computed.
        logs: write a flight log of each trial too, into `out`.
        progress: called after each flight with "successes of trials".
        fly: numbers of trials -> their records in the same order, for flights in other processes;
            None flies them here, one after the other.

    Returns:
        The records of `fly_trial`.

    Raises:
        InputError: the folder holds trials of another study, or an argument is out of its range.
        KeyboardInterrupt: Ctrl-C; finished flights are kept.
    """
    setting = setting or TrialSettings()
    require_range("trials", count, low=1, high=10_000)
    folder: Path | None = None
    records: list[Record] = []
    if out is not None:
        folder = Path(out)
        folder.mkdir(parents=True, exist_ok=True)
        head = (head or study_head(task, pilot, seed)) | setting.record
        records = read_flown_trials(folder, head)

    def fly_here(numbers: Sequence[int]) -> Iterator[Record]:
        for number in numbers:
            log = log_path(folder, number) if folder is not None and logs else None
            yield fly_trial(task, make_pilot, number, seed, setting, log, pilot)

    for record in (fly or fly_here)(range(len(records), count)):
        records.append(record)
        if folder is not None and head is not None:
            _write_trials(folder, head, records)
        progress(f"{sum(record['success'] for record in records)} of {len(records)}")
    return records[:count]


def study_head(task: FlightTask, pilot: str, seed: int = 0) -> Record:
    """Task, pilot and list of starts of a study, without images and clock.

    The digest separates tasks of one name by their repr, which for a dataclass holds all fields.
    It includes the world's default noise and delay and the leader's path in the first trial, which
    also has a digest of its own; those of the other trials are in their records.

    Args:
        task: the task.
        pilot: the pilot's name.
        seed: number of the list of starts and noise.

    Returns:
        simulated, task, pilot, list, leader_digest where there is a leader, task_digest.
    """
    leader = task.leader(trial_seed(0, seed))
    leader_digest = "" if leader is None else leader.digest[:DIGITS]
    with np.printoptions(threshold=sys.maxsize, precision=17):
        representation = re.sub(r" at 0x[0-9a-fA-F]+", "", repr((task, PoseNoise(), LINK_DELAY_S)))
    digest = hashlib.sha256((representation + leader_digest).encode()).hexdigest()[:DIGITS]
    head: Record = {"simulated": True, "task": task.name, "pilot": pilot, "list": seed}
    head |= {LEADER: leader_digest} if leader_digest else {}
    return head | {"task_digest": digest}


def read_flown_trials(folder: Path, head: Mapping[str, Any]) -> list[Record]:
    """Records of a folder, none if it is empty or missing.

    Args:
        folder: of `fly_trials`.
        head: of `study_head` and `TrialSettings.record`.

    Raises:
        InputError: they are of another study, or the file is damaged.
    """
    if not (folder / TRIALS).exists():
        return []
    before, records = read_trials(folder)
    if different := _difference(before, head):
        raise InputError(
            f"--out {folder}: expected an empty folder or one of the same study, got trials with"
            f" {different}; choose another folder"
        )
    return records


def read_paired_trials(folder: str | Path, head: Mapping[str, Any]) -> list[Record]:
    """Records of another pilot for the same task and the same list of starts, at least one.

    Args:
        folder: of `fly_trials`.
        head: of `study_head`; its pilot does not matter.

    Raises:
        FileNotFoundError: there are no trials.
        InputError: they are of another task or from other starts, or the file is damaged.
    """
    before, records = read_trials(folder)
    different = _difference(before, {key: value for key, value in head.items() if key != "pilot"})
    if different or not records:
        raise InputError(
            f"--against {folder}: expected trials of the same task from the same starts, got"
            f" {f'trials with {different}' if different else 'none'}; choose another folder, or its"
            " task and --seed"
        )
    return records


def read_trials(folder: str | Path) -> tuple[Record, list[Record]]:
    """Head and records of a folder.

    Raises:
        FileNotFoundError: there are no trials.
        InputError: the file is damaged.
    """
    path = Path(folder) / TRIALS
    if not path.is_file():
        raise FileNotFoundError(
            f"{path}: expected trials that `falconwing fly --out` wrote, found none there"
        )
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        head, *records = (json.loads(line) for line in lines)
        errors = (_record_error(number, record) for number, record in enumerate(records))
        wrong = _header_error(head) or next(filter(None, errors), "")
    except (ValueError, RecursionError):
        wrong = "other lines"
    if wrong:
        raise InputError(
            f"{short_name(path)}: expected a head and then trials from 0 on, got {wrong}; choose a"
            " new folder"
        )
    return head, records


def summarise_trials(records: Sequence[Mapping[str, Any]]) -> Record:
    """Rates and means over trials, with 95 % intervals.

    Args:
        records: of `fly_trials`, at least one.

    Returns:
        trials, successes, success_rate with success_low95 and success_high95 (exact), and for every
        measure its mean with low95 and high95 (bootstrap), median and largest: ALD, sink rate and
        bank of successes, ATE of all trials until the lock was lost and again of successes only.
        art_median_ms and art_p95_ms are over the art_steps steps of all trials.

    Raises:
        InputError: there are no records.
    """
    successes = [record for record in records if record["success"]]
    low, high = clopper_pearson_interval(len(successes), len(records))
    found: Record = {"trials": len(records), "successes": len(successes)}
    found["success_rate"] = len(successes) / len(records)
    found |= {"success_low95": low, "success_high95": high}
    for key, of_successes in MEANS.items():
        if any(_value(record, key) is not None for record in records):
            found[key] = _mean(successes if of_successes else records, key)
    if "ate_m" in found:
        found["ate_m_of_successes"] = _mean(successes, "ate_m")
    for key in ("faults", "skipped"):
        found[key] = sum(record[key] for record in records)
    steps_ms = np.concatenate([record["art_ms"] for record in records])
    median, high = np.percentile(steps_ms, (50.0, 95.0))
    found |= {"art_steps": len(steps_ms), "art_median_ms": float(median), "art_p95_ms": float(high)}
    for key in ("images", "machine"):
        found[key] = "; ".join(dict.fromkeys(record[key] for record in records))
    return found


def compare_pilots(
    first: Sequence[Mapping[str, Any]], second: Sequence[Mapping[str, Any]]
) -> Record:
    """Compare two pilots on the same starts: trials that only one of them won, McNemar's p-value.

    Args:
        first: records of one pilot.
        second: records of the other; only trials with the same seeds count.

    Returns:
        pairs, only_first, only_second, p_value.

    Raises:
        InputError: they have no seed in common, or followed different leaders in one of them.
    """
    other = {record["seed"]: record for record in second}
    pairs = [(a, other[a["seed"]]) for a in first if a["seed"] in other]
    if not pairs:
        raise InputError(
            "pairs: expected trials of both pilots from the same starts, got none; use the same"
            " --seed"
        )
    for a, b in pairs:
        if LEADER in a and LEADER in b and a[LEADER] != b[LEADER]:
            raise InputError(
                "pairs: expected the same leader's path for both pilots, got different ones at seed"
                f" {a['seed']}; fly both with the same version of the kit"
            )
    wins_first = [bool(a["success"]) for a, _ in pairs]
    wins_second = [bool(b["success"]) for _, b in pairs]
    outcomes = list(zip(wins_first, wins_second, strict=True))
    return {
        "pairs": len(pairs),
        "only_first": outcomes.count((True, False)),
        "only_second": outcomes.count((False, True)),
        "p_value": mcnemar_p_value(wins_first, wins_second),
    }


def describe_machine() -> str:
    """The machine of the measured run times."""
    threads = os.environ.get("OMP_NUM_THREADS", "all")
    cores = f"{os.cpu_count()} cores"
    return f"{platform.machine()}, {cores}, {platform.system()}, OMP_NUM_THREADS {threads}"


def _value(record: Mapping[str, Any], key: str) -> float | None:
    """A number of a record; of the bank its absolute value."""
    if key == "bank_abs_deg":
        bank = record.get("bank_deg")
        return None if bank is None else abs(bank)
    return record.get(key)


def _mean(records: Sequence[Mapping[str, Any]], key: str) -> Record:
    values = [value for value in (_value(record, key) for record in records) if value is not None]
    low, high = bootstrap_mean_interval(values)
    found = {"mean": math.nan, "low95": low, "high95": high, "median": math.nan}
    if not values:
        return found | {"largest": math.nan, "of": 0}
    found |= {"mean": float(np.mean(values)), "median": float(np.median(values))}
    return found | {"largest": float(np.max(values)), "of": len(values)}


def _difference(before: Mapping[str, Any], head: Mapping[str, Any]) -> str:
    """The first difference of a head to an earlier one; empty where there is none."""
    for key, value in head.items():
        if key == LEADER and key not in before:
            return "no digest of the leader's path, as earlier versions of the kit wrote them"
        if before.get(key) != value:
            return DIGESTS.get(key) or f"{key} {before.get(key)!r} instead of {value!r}"
    return ""


def _scene_digest(scene: GaussianScene, link: AnalogVideo | None) -> str:
    arrays = (scene.means, scene.quaternions, scene.scales, scene.opacities, scene.sh, scene.labels)
    parts = [array.tobytes() for array in arrays]
    parts += [] if link is None else [repr(link).encode()]
    return hashlib.sha256(b"".join(parts)).hexdigest()[:DIGITS]


def _header_error(head: Any) -> str:
    """The fault of a head; empty for a good one."""
    is_head = (
        isinstance(head, dict)
        and isinstance(head.get("task"), str)
        and _is_number(head.get("list"), whole=True)
    )
    return "" if is_head else "a first line without task and list"


def _record_error(number: int, record: Any) -> str:
    """The fault of a trial's record; empty for a good one."""
    is_record = isinstance(record, dict) and _is_number(record.get("trial"), whole=True)
    if not is_record or record["trial"] != number:
        return f"another line in place of trial {number}"
    key = next((key for key, fits in NEEDED.items() if not fits(record.get(key))), None)
    key = key or next((key for key, value in record.items() if not _is_valid(key, value)), None)
    if key is None and record["faults"] and not isinstance(_first_error(record), str):
        key = "first_fault"
    return "" if key is None else f"trial {number} with {key} {json.dumps(record.get(key))[:40]}"


def _is_valid(key: str, value: Any) -> bool:
    """Whether a path is a list of points, and a measure with a unit a number or None."""
    if key in PATHS:
        return isinstance(value, list) and all(
            isinstance(point, list) and len(point) == 3 and all(map(_is_number, point))
            for point in value
        )
    is_measure = key in MEANS or key.endswith(("_m", "_m_s", "_s", "_deg"))
    return not is_measure or value is None or _is_number(value)


def _first_error(record: Record) -> Any:
    first_fault = record.get("first_fault")
    return first_fault.get("error") if isinstance(first_fault, dict) else None


def _is_number(value: Any, *, whole: bool = False) -> bool:
    """Whether a value is a finite number; Python's JSON reader accepts nan and infinity."""
    return (
        isinstance(value, int if whole else int | float)
        and not isinstance(value, bool)
        and abs(value) < 1e300
    )


def _is_list(value: Any) -> bool:
    return isinstance(value, list) and len(value) > 0 and all(map(_is_number, value))


# Keys of every record and their check; the evaluator's measures are further ones.
NEEDED: dict[str, Callable[[Any], bool]] = {
    "success": lambda value: isinstance(value, bool),
    "reason": lambda value: isinstance(value, str),
    "images": lambda value: isinstance(value, str),
    "machine": lambda value: isinstance(value, str),
    "art_ms": _is_list,
    "art_median_ms": _is_number,
    "art_p95_ms": _is_number,
    **{
        key: lambda value: _is_number(value, whole=True) and value >= 0
        for key in ("seed", "steps", "skipped", "faults")
    },
}


def _write_trials(folder: Path, head: Record, records: Sequence[Record]) -> None:
    """Replace the whole file, so that no line is ever cut."""
    with atomic_write(folder / TRIALS, text=True) as file:
        file.writelines(json.dumps(line, allow_nan=False) + "\n" for line in (head, *records))


def log_path(folder: Path, number: int) -> Path:
    """A free file name; the log of an interrupted flight is kept."""
    takes = ("", *(f"_take{take}" for take in range(2, 1000)))
    paths = (folder / f"trial_{number:03d}{take}.mcap" for take in takes)
    return next(path for path in paths if not path.exists())
