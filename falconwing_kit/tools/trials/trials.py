"""Trials: a task and a pilot -> many simulated flights from frozen starts, their record, and rates
with intervals.

A folder keeps the flights one by one in `trials.jsonl`, so that an interrupted study goes on where
it stopped.
"""

import hashlib
import json
import math
import os
import platform
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit.control.loops import LINK_DELAY_S
from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.files import atomic_write, short_name
from falconwing_kit.core.flight_log import FlightLogWriter
from falconwing_kit.flight.loop import Loop, LoopStep, Pilot, SimulatedClock, WallClock
from falconwing_kit.flight.sources import MeasuredStates, RenderedView, fpv_camera
from falconwing_kit.flight.trial import FlightTask, TrialSetup, trial_seed
from falconwing_kit.flight.world import PoseNoise, SimulatedWorld
from falconwing_kit.scene.analog import AnalogVideo
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.tools.bridge.through_port import PortWorld, simulated_board
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
LEADER = (
    "leader_digest"  # in the head of a study with a leader; earlier versions of the kit wrote none
)
DIGESTS = {  # key of a head -> what differs where it differs
    LEADER: "another leader's path",
    "task_digest": "another duration, spread, noise, delay, model or airframe",
    "scene_digest": "another scene",
}
# What is averaged over trials, for those records that have it: key -> over successes only.
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
    """How trials are flown, apart from task, pilot and seed."""

    scene: GaussianScene | None = None  # rendered for the pilot; None gives it no images
    camera: PinholeCamera = field(default_factory=fpv_camera)
    clock: type[SimulatedClock] | type[WallClock] = SimulatedClock  # a new one for every flight
    hooks: Sequence[Callable[[LoopStep], None]] = ()
    # a simulated board that every command goes through, one of `through_port.PORTS`; "" for none
    port: str = ""
    # the analog link of the scene's images; each trial's seed draws its noise; None: a direct view
    link: AnalogVideo | None = None

    @property
    def record(self) -> Record:
        """What has to be the same for flights to be comparable."""
        lens = self.camera
        how = {"rendered": self.scene is not None, "size_px": [lens.width, lens.height]}
        how |= {
            "focal_px": [lens.fx, lens.fy],
            "centre_px": [lens.cx, lens.cy],
            "clock": self.clock.__name__,
        }
        how |= {"port": self.port} if self.port else {}
        digest = None if self.scene is None else _scene_digest(self.scene, self.link)
        return {**how, "scene_digest": digest}


def fly_trial(
    task: FlightTask,
    make_pilot: Callable[[TrialSetup], Pilot],
    number: int,
    seed: int = 0,
    setting: TrialSettings | None = None,
    log: str | Path | None = None,
) -> Record:
    """Fly one trial.

    Args:
        task: what is to be done.
        make_pilot: a new pilot for a trial.
        number: of the trial in the frozen list, from 0.
        seed: which list.
        setting: images, clock and hooks; None flies without images, as fast as it can.
        log: an MCAP file to write; None for none.

    Returns:
        Numbers and the path: of the loop (reason, steps, skipped, faults), of the pilot's run time
            (art_ms of every
        step, with median and 95th percentile, the machine and the images it was measured with) and
        of the judge.

    Raises:
        KeyboardInterrupt: Ctrl-C; the log is whole, and the trial does not count.
        InputError: a number is out of its range, or the log cannot be written.
    """
    setting = setting or TrialSettings()
    trial = task.trial(trial_seed(number, seed))
    pilot = make_pilot(trial)
    with ExitStack() as stack:
        writer = stack.enter_context(FlightLogWriter(log)) if log is not None else None
        world = (
            _behind_port(stack, trial.world, setting.port, writer) if setting.port else trial.world
        )
        view = None
        if setting.scene is not None:
            link = None if setting.link is None else replace(setting.link, seed=trial.seed)
            view = RenderedView(
                world, setting.scene, setting.camera, task.airframe.p_body_camera, link=link
            )
        judge = task.judge(trial, setting.camera, view)
        states, hooks = MeasuredStates(world), setting.hooks
        loop = Loop(pilot, world, view, states, trial.leader, setting.clock(), writer, hooks)
        if writer is not None:
            writer.metadata(
                {"simulated": "yes", "task": task.name, "seed": trial.seed, "port": setting.port}
            )
        flight = loop.run(trial.duration, judge.watch)
        through = {"port": world.record} if isinstance(world, PortWorld) else {}
    if flight.reason == "interrupted":
        raise KeyboardInterrupt
    median, high = flight.milliseconds("pilot")
    art = {"art_median_ms": median, "art_p95_ms": high, "machine": describe_machine()}
    art |= {"art_ms": np.round(1e3 * flight.seconds["pilot"], 3).tolist(), "images": NO_IMAGES}
    art |= (
        {"images": f"{view.camera.width}x{view.camera.height} images by {view.backend!r}"}
        if view
        else {}
    )
    how = {
        "reason": flight.reason,
        "steps": len(flight.t),
        "skipped": flight.skipped,
        "faults": flight.faults,
    }
    first_fault = next(
        (dict(event.details) for event in flight.events if event.name == "pilot failed"), None
    )
    how |= {"first_fault": first_fault} if first_fault else {}
    return {"trial": number, "seed": trial.seed, **how, **art, **through, **judge.result()}


def _behind_port(
    stack: ExitStack, world: SimulatedWorld, name: str, log: FlightLogWriter | None
) -> PortWorld:
    """The world behind a simulated board; what happens at the port goes to the log."""

    def note(t: float, what: str, details: Mapping[str, Any]) -> None:
        if log is not None:
            with suppress(
                InputError
            ):  # a full disk ends no flight, and the loop, which writes here too, says so
                log.event(t, what, details)

    board = simulated_board(name)
    stack.callback(board.close)
    return stack.enter_context(PortWorld(world, board, on_event=note))


def fly_trials(
    task: FlightTask,
    make_pilot: Callable[[TrialSetup], Pilot],
    count: int,
    *,
    pilot: str,
    seed: int = 0,
    setting: TrialSettings | None = None,
    out: str | Path | None = None,
    logs: bool = False,
    progress: Callable[[str], None] = lambda text: None,
) -> list[Record]:
    """Fly trials 0 to count - 1 of the frozen list, or those of them that a folder does not hold
    yet.

    Args:
        task: what is to be done.
        make_pilot: a new pilot for each trial.
        count: how many.
        pilot: what the pilot is called.
        seed: which list of starts and noise; the same list for every pilot makes pairs.
        setting: images, clock and hooks.
        out: folder that keeps the flights; made where it is missing. None keeps nothing. Of a task
            it keeps name and digest, see `study_head`.
        logs: write a flight log of each trial too, into `out`.
        progress: told after each flight how it stands.

    Returns:
        A record of each trial, as `fly_trial` makes them.

    Raises:
        InputError: the folder holds trials that were flown otherwise, or an argument is out of its
            range.
        KeyboardInterrupt: Ctrl-C; finished flights are kept.
    """
    setting = setting or TrialSettings()
    require_range("trials", count, low=1, high=10_000)
    head, folder, records = {}, None if out is None else Path(out), []
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        head = study_head(task, pilot, seed) | setting.record
        records = read_flown_trials(folder, head)
    for number in range(len(records), count):
        log = _log_path(folder, number) if folder is not None and logs else None
        records.append(fly_trial(task, make_pilot, number, seed, setting, log))
        if folder is not None:
            _write_trials(folder, head, records)
        progress(f"{sum(record['success'] for record in records)} of {len(records)}")
    return records[:count]


def study_head(task: FlightTask, pilot: str, seed: int = 0) -> Record:
    """What is flown, by whom and from which starts, apart from images and clock.

    The digest tells tasks of one name apart by their repr, which of the kit's tasks, as of any
    dataclass, holds all fields; of another task it tells what its repr tells. The world's default
    noise and delay are in it too, and of a task with a leader the path that it flies in the first
    trial, which has a digest of its own so that a changed leader is named.

    Args:
        task: what is to be done.
        pilot: what the pilot is called.
        seed: which list of starts and noise.

    Returns:
        simulated, task, pilot, list, leader_digest where there is a leader, task_digest.
    """
    leader = task.leader(trial_seed(0, seed))
    shown = {} if leader is None else {LEADER: leader.digest[:DIGITS]}
    with np.printoptions(threshold=sys.maxsize, precision=17):
        representation = re.sub(r" at 0x[0-9a-fA-F]+", "", repr((task, PoseNoise(), LINK_DELAY_S)))
    digest = hashlib.sha256((representation + shown.get(LEADER, "")).encode()).hexdigest()[:DIGITS]
    return {
        "simulated": True,
        "task": task.name,
        "pilot": pilot,
        "list": seed,
        **shown,
        "task_digest": digest,
    }


def read_flown_trials(folder: Path, head: Mapping[str, Any]) -> list[Record]:
    """Trials that a folder keeps, if they were flown in the same way.

    Args:
        folder: of `fly_trials`; it may be empty or missing.
        head: what has to be the same, of `study_head` and `TrialSettings.record`.

    Returns:
        Their records.

    Raises:
        InputError: they were flown otherwise, or the file is damaged.
    """
    if not (folder / TRIALS).exists():
        return []
    before, records = read_trials(folder)
    if different := _difference(before, head):
        raise InputError(
            f"--out {folder}: expected an empty folder or one of the same study, got trials with {different};"
            " choose another folder"
        )
    return records


def read_paired_trials(folder: str | Path, head: Mapping[str, Any]) -> list[Record]:
    """Trials of another pilot, if they are of the same task from the same list of starts.

    Args:
        folder: of `fly_trials`.
        head: of `study_head`; its pilot does not matter.

    Returns:
        Their records, at least one.

    Raises:
        FileNotFoundError: there are no trials.
        InputError: they are of another task or from other starts, or the file is damaged.
    """
    before, records = read_trials(folder)
    different = _difference(before, {key: value for key, value in head.items() if key != "pilot"})
    if different or not records:
        raise InputError(
            f"--against {folder}: expected trials of the same task from the same starts, got"
            f" {f'trials with {different}' if different else 'none'}; choose another folder, or its task and --seed"
        )
    return records


def read_trials(folder: str | Path) -> tuple[Record, list[Record]]:
    """What a folder keeps: how its trials were flown, and their records.

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
        head, *records = (
            json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()
        )
        wrong = _header_error(head) or next(
            filter(None, map(_record_error, range(len(records)), records)), ""
        )
    except (ValueError, RecursionError):
        wrong = "other lines"
    if wrong:
        raise InputError(
            f"{short_name(path)}: expected a head and then trials from 0 on, got {wrong}; choose a new folder"
        )
    return head, records


def summarise_trials(records: Sequence[Mapping[str, Any]]) -> Record:
    """Rates and means over trials, with 95 % intervals.

    Args:
        records: of `fly_trials`, at least one.

    Returns:
        trials, successes, success_rate with success_low95 and success_high95 (exact), and for every
        measure its mean with low95 and high95 (bootstrap), median and largest: ALD, sink rate and
        bank of successes, ATE of all trials until the lock was lost and once more of successes.
        art_median_ms and art_p95_ms are the median and the 95th percentile over the art_steps steps
        of all trials, on which machine and with which images they say themselves.

    Raises:
        InputError: there are no records.
    """
    successes = [record for record in records if record["success"]]
    low, high = clopper_pearson_interval(len(successes), len(records))
    found: Record = {
        "trials": len(records),
        "successes": len(successes),
        "success_rate": len(successes) / len(records),
    }
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
    return found | {
        key: "; ".join(dict.fromkeys(record[key] for record in records))
        for key in ("images", "machine")
    }


def compare_pilots(
    first: Sequence[Mapping[str, Any]], second: Sequence[Mapping[str, Any]]
) -> Record:
    """Two pilots on the same starts: trials that only one of them won, and McNemar's p-value.

    Args:
        first: records of one pilot.
        second: records of the other; only trials with the same seeds count.

    Returns:
        pairs, only_first, only_second, p_value.

    Raises:
        InputError: they have no seed in common.
    """
    other = {record["seed"]: record for record in second}
    pairs = [
        (bool(a["success"]), bool(other[a["seed"]]["success"])) for a in first if a["seed"] in other
    ]
    if not pairs:
        raise InputError(
            "pairs: expected trials of both pilots from the same starts, got none; use the same --seed"
        )
    wins = {
        "only_first": sum(a and not b for a, b in pairs),
        "only_second": sum(b and not a for a, b in pairs),
    }
    return {
        "pairs": len(pairs),
        **wins,
        "p_value": mcnemar_p_value([a for a, _ in pairs], [b for _, b in pairs]),
    }


def describe_machine() -> str:
    """What run times were measured on."""
    threads = os.environ.get("OMP_NUM_THREADS", "all")
    return f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}, OMP_NUM_THREADS {threads}"


def _value(record: Mapping[str, Any], key: str) -> float | None:
    """A number of a record; the bank without its side."""
    if key == "bank_abs_deg":
        bank = record.get("bank_deg")
        return None if bank is None else abs(bank)
    return record.get(key)


def _mean(records: Sequence[Mapping[str, Any]], key: str) -> Record:
    values = [value for value in (_value(record, key) for record in records) if value is not None]
    low, high = bootstrap_mean_interval(values)
    if not values:
        return {
            "mean": math.nan,
            "low95": low,
            "high95": high,
            "median": math.nan,
            "largest": math.nan,
            "of": 0,
        }
    middle = {
        "median": float(np.median(values)),
        "largest": float(np.max(values)),
        "of": len(values),
    }
    return {"mean": float(np.mean(values)), "low95": low, "high95": high, **middle}


def _difference(before: Mapping[str, Any], head: Mapping[str, Any]) -> str:
    """The first thing of a head that was otherwise before; empty where all is the same."""
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
    """What is wrong with a line that should be a head; empty where nothing is."""
    fair = (
        isinstance(head, dict)
        and isinstance(head.get("task"), str)
        and _is_number(head.get("list"), whole=True)
    )
    return "" if fair else "a first line without task and list"


def _record_error(number: int, record: Any) -> str:
    """What is wrong with a line that should be the record of a trial; empty where nothing is."""
    if (
        not isinstance(record, dict)
        or not _is_number(record.get("trial"), whole=True)
        or record["trial"] != number
    ):
        return f"another line in place of trial {number}"
    key = next((key for key, fits in NEEDED.items() if not fits(record.get(key))), None)
    key = key or next((key for key, value in record.items() if not _is_valid(key, value)), None)
    if key is None and record["faults"] and not isinstance(_first_error(record), str):
        key = "first_fault"
    return "" if key is None else f"trial {number} with {key} {json.dumps(record.get(key))[:40]}"


def _is_valid(key: str, value: Any) -> bool:
    """Whether a measure is what its name promises: a path of points, or a number or None for one
    with a unit.
    """
    if key in PATHS:
        return isinstance(value, list) and all(
            isinstance(point, list) and len(point) == 3 and all(map(_is_number, point))
            for point in value
        )
    measured = key in MEANS or key.endswith(("_m", "_m_s", "_s", "_deg"))
    return not measured or value is None or _is_number(value)


def _first_error(record: Record) -> Any:
    first_fault = record.get("first_fault")
    return first_fault.get("error") if isinstance(first_fault, dict) else None


def _is_number(value: Any, *, whole: bool = False) -> bool:
    """Whether a value is a finite number; JSON as Python reads it has nan and infinity too."""
    return (
        isinstance(value, int if whole else int | float)
        and not isinstance(value, bool)
        and abs(value) < 1e300
    )


def _is_list(value: Any) -> bool:
    return isinstance(value, list) and len(value) > 0 and all(map(_is_number, value))


# What every record has, and how to tell; measures of the judge come on top.
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
    """All lines anew after every flight: a few hundred short ones, and never a line cut in half."""
    with atomic_write(folder / TRIALS, text=True) as file:
        file.writelines(json.dumps(line, allow_nan=False) + "\n" for line in (head, *records))


def _log_path(folder: Path, number: int) -> Path:
    """A name that is free: the log of an interrupted flight stays."""
    names = (
        f"trial_{number:03d}{'' if take == 1 else f'_take{take}'}.mcap" for take in range(1, 1000)
    )
    return next(folder / name for name in names if not (folder / name).exists())
