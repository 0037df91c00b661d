"""Evaluation: pilots and worlds -> trials on several processes, their records and summaries.

The records are lines of JSON in a folder, appended as they come, so that a run that was ended goes
on where it was. A pilot is only its name here: `load_pilot` makes it, and its entry in the table of
pilots decides whether it is given a state.
"""

import hashlib
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from falconwing_kit import __version__
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.messages import Command, Image, Observation, State
from falconwing_kit.flight.pilots import load_pilot, require_pilot
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.flight.supervisor import Supervisor
from falconwing_kit.flight.tasks import FollowTask, LandingTask
from falconwing_kit.flight.trial import TrialSetup, trial_seed
from falconwing_kit.scene.arena import load_scene
from falconwing_kit.scene.edit import Appearance, add, apply_appearance, delete, relight
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.tools.jobs.run import WorkerLostError, parallel_map
from falconwing_kit.tools.trials.image_faults import ImageFaults
from falconwing_kit.tools.trials.statistics import bootstrap_mean_interval, wilson_interval
from falconwing_kit.tools.trials.trial_figures import replace_nonfinite
from falconwing_kit.tools.trials.trials import Record, TrialSettings, fly_trial
from falconwing_kit.tools.trials.worlds import UNSEEN, World, WorldTask, mount_rotation
from falconwing_kit.vision.monitor import FrameMonitor

RECORDS = "trials.jsonl"
SCENES = ("hall", "arena")
TURN_BACK = 3.0  # along the runway, of a flight that goes around [m]
PATH_STEP = 4  # every fourth point of a path is kept
KEPT = (  # of a trial's record
    "seed", "success", "reason", "steps", "faults", "first_fault", "ald_m", "lateral_offset_m",
    "past_threshold_m", "sink_rate_m_s", "bank_deg", "ate_m", "ate_d_m", "ate_path_m",
    "locked_share", "lost_at_s", "images", "machine",
)  # fmt: skip


@dataclass(frozen=True)
class Cell:
    """Trials of one pilot in one world."""

    pilot: str
    task: str  # "landing" or "follow"
    world: World
    size: tuple[int, int] = (320, 240)  # of the camera's image [px]
    seed: int = 0  # number of the list of trials
    scene: str = "hall"  # or "arena"
    weights: str = ""  # a policy's file in place of those that ship
    weights_digest: str = ""  # of that file

    @property
    def key(self) -> str:
        """What makes two trials of one number the same trial."""
        fields = asdict(self)
        del fields["weights"]  # where the file lies does not matter
        text = json.dumps(fields)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


class TimedPilot:
    """A pilot, with the processor time of each of its steps [ms]."""

    def __init__(self, pilot: Any, reads_state: bool) -> None:
        """reads_state: as the table of pilots has it; without it the trial has no states at all."""
        self._pilot, self.reads_state = pilot, reads_state
        self.cpu_ms: list[float] = []

    @property
    def mode(self) -> str:
        """The pilot's."""
        return str(self._pilot.mode)

    def act(self, observation: Observation) -> Command:
        """The pilot's command."""
        begin = time.process_time()
        command: Command = self._pilot.act(observation)
        self.cpu_ms.append(1e3 * (time.process_time() - begin))
        return command


class SilentSupervisor:
    """The supervisor of a real flight, which here only notes when it would have handed back.

    The pilot's run time is not judged: it is that of a machine with many trials at once.
    """

    def __init__(self, by_images: bool) -> None:
        """by_images: whether the pilot flies by images, which are then required."""
        monitor = FrameMonitor() if by_images else None
        self._supervisor, self._t = Supervisor(by_images=by_images, monitor=monitor), math.nan

    @property
    def record(self) -> Record:
        """Why and when it would have acted; reason empty and time None if never."""
        reason = self._supervisor.reason
        return {"reason": reason, "t_s": round(self._t, 3) if reason else None}

    def see(self, image: Image, t: float) -> None:
        """Take note of a new image."""
        self._supervisor.see(image, t)

    def check(self, t: float, command: Command | None, state: State | None, pilot_s: float) -> str:
        """Judge a command; the answer is always to go on."""
        had_reason = bool(self._supervisor.reason)
        if self._supervisor.check(t, command, state) and not had_reason:
            self._t = t
        return ""


def fly_cell_trial(item: tuple[Cell, int]) -> Record:
    """The record of one trial of a cell.

    A flight that leaves the simulation's range, such as one whose numbers overflow, is a failure
    with the error as its reason.

    Args:
        item: cell, and number of the trial from 0.

    Raises:
        InputError: there is no such pilot, or it does not fly this task.
    """
    cell, number = item
    task, seed = make_task(cell, number), trial_seed(number, cell.seed)
    setting, flown = make_setting(cell, seed), list[TimedPilot]()

    def make(trial: TrialSetup) -> TimedPilot:
        flown.append(make_pilot(cell, task, trial))
        return flown[0]

    try:
        record = fly_trial(task, make, number, cell.seed, setting)
    except (ValueError, ArithmeticError) as error:
        if not flown:
            raise
        record = {"seed": seed, "success": False, "reason": f"simulation ended: {error}",
                  "faults": 0, "supervisor": {"reason": "", "t_s": None}, "path_m": []}  # fmt: skip
    cpu_ms = np.percentile(flown[0].cpu_ms or [0.0], (50.0, 95.0))
    path: Any = record["path_m"]
    kept: Record = {"key": cell.key, "pilot": cell.pilot, "task": cell.task}
    kept |= {"world": cell.world.name, "trial": number, "manoeuvre": _manoeuvre(cell, number)}
    kept |= {key: record[key] for key in KEPT if _has_value(record.get(key))}
    kept |= {"cpu_ms_median": round(float(cpu_ms[0]), 3), "cpu_ms_p95": round(float(cpu_ms[1]), 3)}
    kept |= {"supervisor": record["supervisor"]}
    if cell.task == "landing":
        kept["go_arounds"] = count_go_arounds(np.array(path).reshape(-1, 3)[:, 0])
    kept["path_m"] = replace_nonfinite(np.round(path[::PATH_STEP], 2).tolist())
    return kept


def _has_value(value: Any) -> bool:
    """Whether a measure is there, and finite where it is a number."""
    return value is not None and not (isinstance(value, float) and not math.isfinite(value))


def make_task(cell: Cell, number: int) -> WorldTask:
    """The task of a trial in its world."""
    base: LandingTask | FollowTask = LandingTask()
    if cell.task == "follow":
        base = FollowTask(_manoeuvre(cell, number))
    return WorldTask(base, cell.world)


def _manoeuvre(cell: Cell, number: int) -> str:
    """What the leader flies: the world's, or one of the unseen ones in turn."""
    if cell.task != "follow":
        return ""
    return cell.world.manoeuvre or UNSEEN[number % len(UNSEEN)]


def make_pilot(cell: Cell, task: WorldTask, trial: TrialSetup) -> TimedPilot:
    """The pilot of a cell, ready for a trial; it is designed on the nominal aircraft."""
    entry = require_pilot(cell.pilot, cell.task, cell.scene)
    if entry.reads_state:
        pilot: Any = load_pilot(
            cell.pilot, cell.task, cell.scene, fpv_camera(*cell.size),
            task.airframe.p_body_camera, leader=trial.leader,
        )  # fmt: skip
    else:
        pilot = pilot_by_images(cell)
        pilot.reset()
    return TimedPilot(pilot, entry.reads_state)


def pilot_by_images(cell: Cell) -> Any:
    """The pilot of a cell, loaded once in every process; InputError for weights not its own."""
    return _load(cell.pilot, cell.task, cell.scene, cell.size, cell.weights)


@lru_cache(maxsize=4)
def _load(name: str, task: str, scene: str, size: tuple[int, int], weights: str) -> Any:
    p_body_camera = LandingTask().airframe.p_body_camera
    more: Any = {"weights": weights} if weights else {}
    return load_pilot(name, task, scene, fpv_camera(*size), p_body_camera, **more)


def make_setting(cell: Cell, seed: int) -> TrialSettings:
    """Scene, camera and link of a trial.

    A pilot by the state sees nothing, so its landings need no images; following does, for the lock.
    """
    camera, world = fpv_camera(*cell.size), cell.world
    entry = require_pilot(cell.pilot, cell.task, cell.scene)
    if entry.reads_state and cell.task == "landing":
        return TrialSettings(camera=camera, supervisor=SilentSupervisor)
    return TrialSettings(
        scene=make_scene(cell, seed), camera=camera, degrade=ImageFaults(world),
        scene_name=cell.scene, R_body_mount=mount_rotation(world, seed),
        supervisor=SilentSupervisor,
    )  # fmt: skip


def make_scene(cell: Cell, seed: int) -> GaussianScene:
    """The hall or arena, for following with the leader in the world's look."""
    world, hall = cell.world, _scene(cell.scene)
    look = Appearance(world.leader_scale, 1.0, world.leader_salt_pepper, seed)
    nominal = look == Appearance(seed=seed) and world.leader_gain == World("", "").leader_gain
    if cell.task != "follow" or nominal:
        return hall
    leader = _scene("leader")
    whole = np.ones(len(leader), bool)
    leader = relight(leader, whole, gain=world.leader_gain)
    leader = apply_appearance(leader, whole, look, np.zeros(3))
    bare = delete(hall, hall.labelled("leader")) if "leader" in hall.label_names else hall
    return add(bare, leader)


_scene = lru_cache(maxsize=2)(load_scene)


def count_go_arounds(x: Array) -> int:
    """How often a path (n,) [m] along the runway turned back and came again."""
    count, forward, extreme = 0, True, -math.inf
    for position in x.tolist():
        sign = 1.0 if forward else -1.0
        extreme = max(extreme, sign * position)
        if sign * position < extreme - TURN_BACK:
            count += forward
            forward, extreme = not forward, -sign * position
    return count


def fly_cells(
    cells: Sequence[Cell],
    trials: int,
    out: Path,
    *,
    workers: int = 1,
    minutes: float = math.inf,
    progress: Callable[[int, int, Record | None], None] = lambda done, of, record: None,
) -> list[Record]:
    """Fly the trials that a folder does not hold yet, and append their records to it.

    Args:
        cells: what to fly.
        trials: number in each cell.
        out: folder, created if missing.
        workers: processes.
        minutes: no trial begins later than this.
        progress: called at the start and after each trial with the trials done, their number and
            the record.

    Returns:
        All records of these cells and trials, in their order; fewer where the time was up.

    Raises:
        InputError: the folder holds records of other weights or of another version of the kit, or
            there is no such pilot.
        RuntimeError: a trial ended its process three times.
        KeyboardInterrupt: Ctrl-C; finished trials are kept.
    """
    for cell in cells:
        require_pilot(cell.pilot, cell.task, cell.scene)
    out.mkdir(parents=True, exist_ok=True)
    items = [(cell, number) for number in range(trials) for cell in cells]
    wanted = {(cell.key, number) for cell, number in items}
    found = {key: r for r in read_records(out) if (key := (r["key"], r["trial"])) in wanted}
    waiting = [item for item in items if (item[0].key, item[1]) not in found]
    progress(len(found), len(items), None)
    end = time.monotonic() + 60.0 * minutes
    with (out / RECORDS).open("a", encoding="utf-8") as file:
        for record in _until(end, parallel_map(fly_cell_trial, waiting, workers)):
            file.write(json.dumps(record, allow_nan=False) + "\n")
            file.flush()
            found[record["key"], record["trial"]] = record
            progress(len(found), len(items), record)
    keys = [(cell.key, number) for cell in cells for number in range(trials)]
    return [found[key] for key in keys if key in found]


def _until(
    end: float, results: Iterator[tuple[tuple[Cell, int], Record | WorkerLostError]]
) -> Iterator[Record]:
    """Results until a time of `time.monotonic` [s]."""
    for (cell, number), record in results:
        if isinstance(record, WorkerLostError):
            raise RuntimeError(f"trial {number} of {cell.pilot} in {cell.world.name}: {record}")
        yield record
        if time.monotonic() > end:
            return


def read_records(folder: Path) -> list[Record]:
    """Records of a folder, none if it is new; a head is written there on the first call.

    A last line that was cut when a run was ended is removed.

    Raises:
        InputError: they are of other weights or of another version of the kit, or damaged.
    """
    path, head = folder / RECORDS, {"kit": __version__, "weights": weights_digest()}
    if not path.exists() or not path.read_text(encoding="utf-8").strip():
        path.write_text(json.dumps(head) + "\n", encoding="utf-8")
        return []
    text = path.read_text(encoding="utf-8")
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        path.write_text(whole, encoding="utf-8")
    try:
        before, *records = (json.loads(line) for line in whole.splitlines())
        damaged = not all({"key", "trial", "success", "cpu_ms_median"} <= set(r) for r in records)
    except (ValueError, TypeError):
        before, records, damaged = {}, [], True
    if damaged or before != head:
        other = "damaged records" if damaged else f"records of {before} instead of {head}"
        raise InputError(
            f"--out {folder}: expected a new folder or one of this version and its weights, got"
            f" {other}; choose another folder"
        )
    return records


def weights_digest() -> str:
    """Digest of all networks that ship, so that trials of different ones are not mixed."""
    digest = hashlib.sha256()
    data = sorted(files("falconwing_kit.data").iterdir(), key=lambda file: file.name)
    for file in data:
        if file.name.endswith(".safetensors"):
            digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()[:16]


def summarise_cell(records: Sequence[Mapping[str, Any]]) -> Record:
    """Rates and means of trials, with 95 % intervals: Wilson for rates, bootstrap for means.

    Args:
        records: of one or more cells, at least one.

    Returns:
        trials, successes, success with low95 and high95, each 0..1; ald_m, past_threshold_m,
        sink_rate_m_s, bank_deg (absolute) over landings, ate_m over all trials until the lock was
        lost and ate_m_of_successes, each with mean, low95, high95, smallest and largest, None
        without a value; cpu_ms, the median over trials of their medians, and cpu_ms_p95 of their
        95th percentiles; supervised, the share that the supervisor would have ended, with interval
        and reasons; go_arounds, faults.
    """
    successes = [record for record in records if record["success"]]
    found: Record = {"trials": len(records), "successes": len(successes)}
    found["success"] = _rate(len(successes), len(records))
    for key in ("ald_m", "past_threshold_m", "sink_rate_m_s", "bank_deg"):
        found[key] = _mean(abs(r[key]) if key == "bank_deg" else r[key]
                           for r in successes if key in r)  # fmt: skip
    found["ate_m"] = _mean(record["ate_m"] for record in records if "ate_m" in record)
    found["ate_m_of_successes"] = _mean(r["ate_m"] for r in successes if "ate_m" in r)
    for key in ("cpu_ms_median", "cpu_ms_p95"):
        found[key] = float(np.median([record[key] for record in records]))
    reasons = [r["supervisor"]["reason"] for r in records if r["supervisor"]["reason"]]
    found["supervised"] = _rate(len(reasons), len(records)) | {"reasons": _kinds(reasons)}
    for key in ("go_arounds", "faults"):
        found[key] = sum(record.get(key, 0) for record in records)
    return found


def _rate(count: int, trials: int) -> Record:
    low, high = wilson_interval(count, trials)
    return {"rate": count / trials, "low95": low, "high95": high}


def _mean(values: Iterable[float]) -> Record | None:
    x = list(values)
    if not x:
        return None
    low, high = bootstrap_mean_interval(x)
    return {"mean": float(np.mean(x)), "low95": None if math.isnan(low) else low,
            "high95": None if math.isnan(high) else high,
            "smallest": min(x), "largest": max(x), "of": len(x)}  # fmt: skip


def _kinds(reasons: Sequence[str]) -> dict[str, int]:
    """Reasons without their numbers, and how often each was given."""
    kinds = ["".join("#" if c.isdigit() else c for c in reason) for reason in reasons]
    return {kind: kinds.count(kind) for kind in dict.fromkeys(kinds)}


def group_records(cells: Sequence[Cell], records: Sequence[Record]) -> dict[Cell, list[Record]]:
    """The records of each cell that has some."""
    by_key: dict[str, list[Record]] = {}
    for record in records:
        by_key.setdefault(record["key"], []).append(record)
    return {cell: by_key[cell.key] for cell in cells if cell.key in by_key}
