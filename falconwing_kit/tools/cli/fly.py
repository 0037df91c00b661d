"""falconwing fly: fly a task in simulation, live or as trials, or a real aircraft."""

import hashlib
import math
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from falconwing_kit.control.manoeuvres import MANOEUVRES
from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.flight.pilots import PILOTS, load_pilot, require_pilot
from falconwing_kit.flight.tasks import TASKS, TRIAL_SEEDS, LandingTask
from falconwing_kit.tools.cli.show import next_line, print_json, print_table

if TYPE_CHECKING:
    from falconwing_kit.aircraft.model import Model
    from falconwing_kit.core.messages import State
    from falconwing_kit.flight.loop import Pilot
    from falconwing_kit.flight.tasks import FlightTask
    from falconwing_kit.flight.trial import TrialSetup
    from falconwing_kit.scene.gaussians import GaussianScene
    from falconwing_kit.tools.devices.calibration import BenchCalibration
    from falconwing_kit.tools.trials.trials import TrialSettings

    TaskName = str
else:
    TaskName = Literal[tuple(TASKS)]  # as the command line offers them

TASK_HELP = "; ".join(f"{task.name}: {task.summary}" for task in TASKS.values())
MANOEUVRE_HELP = "what the leader flies ({}); {}".format(
    ", ".join(
        f"{task.manoeuvre} where --task {task.name} names none"
        for task in TASKS.values()
        if task.manoeuvre
    ),
    "; ".join(f"{manoeuvre.name}: {manoeuvre.summary}" for manoeuvre in MANOEUVRES.values()),
)
OFFERED = {name: pilot for name, pilot in PILOTS.items() if name != "manual"}  # no sticks here
PILOT_HELP = "; ".join(
    f"{name} ({', '.join(pilot.tasks)}): {pilot.summary}" for name, pilot in OFFERED.items()
)
STRETCH_SAID = 1.05  # real time over that of the flight, from which on it is said
BROWSER_S = 8.0  # a browser's time to show the page before the flight begins
UNITS = {  # rows of the summary: label and factor to its unit
    "ald_m": ("ALD of landings [cm]", 100.0),
    "sink_rate_m_s": ("sink rate at touchdown [m/s]", 1.0),
    "bank_abs_deg": ("bank at touchdown [deg]", 1.0),
    "past_threshold_m": ("touchdown past threshold [m]", 1.0),
    "ate_m": ("ATE until loss [cm]", 100.0),
    "ate_m_of_successes": ("ATE of successes [cm]", 100.0),
    "ate_d_m": ("ATE_d until loss, distance alone [cm]", 100.0),
    "ate_path_m": ("ATE_path until loss, along the path [cm]", 100.0),
    "locked_share": ("frames locked [%]", 100.0),
}


@dataclass(frozen=True)
class Fly:
    """Fly a task in simulation with the kit's 20 Hz loop.

    Without --headless a page in the browser shows the flight in real time; with it the flights run
    as fast as possible. Exit code 0 if every trial succeeded, 1 if one failed.

    --source camera and the --port of a trainer bridge fly a real aircraft by images, under the
    supervisor, after falconwing doctor --bench was passed with that radio.
    """

    task: Annotated[TaskName, tyro.conf.arg(help=TASK_HELP)] = "landing"
    # Not a Literal: a name of a later version is refused by one sentence.
    pilot: Annotated[
        str,
        tyro.conf.arg(metavar="{" + ",".join(OFFERED) + "}", help=f"the controller; {PILOT_HELP}"),
    ] = "expert"
    model: Path | None = None
    """model file of identify or gap (model.toml, model_with_effect.toml) on which the pilot is
    designed, with its effects: wind, delay, trim bias, camera tilt and so on; the simulated
    aircraft stays the kit's own
    """
    weights: Path | None = None
    """weights of train for student, rgb, mask or rgb_mask, in place of those that ship"""
    trials: int = 1
    """number of flights, each from its own initial state of the fixed list"""
    manoeuvre: Annotated[str, tyro.conf.arg(help=MANOEUVRE_HELP)] = ""
    seed: int = 0
    """selects initial states and noise; use the same for paired comparisons of two pilots"""
    start: str = ""
    """first pose of every flight in place of the drawn ones: x,y,z,roll,pitch,yaw in metres and
    degrees, such as --start=-18,-2,1.5,0,4,0; a flight log (.mcap), flown again from where its
    pilot was first engaged; or a flight table (.csv), whose first pose is taken
    """
    workers: int = 1
    """processes that share the trials; with --headless only"""
    cluster: str = ""
    """address of a scheduler of `distributed` whose workers fly instead, such as
    tcp://10.0.0.5:8786; with --headless only; files of --model and --scene must have the same path
    there
    """
    headless: bool = False
    """no page, as fast as possible"""
    no_render: bool = False
    """no images; a pilot by the state needs none"""
    scene: str = ""
    """the arena: arena, hall, hall_analog (images through an analog video link), or a scene file in
    the kit's world frame; hall if not given where the pilot flies by the camera, else arena
    """
    size: str = "320x240"
    """of the camera's image [px]"""
    camera_at: str = ""
    """place of the camera on the aircraft, x,y,z in body axes (nose, right, down) in metres;
    0.036,0,-0.075 is that of the builder's aircraft, above the wing, and the default with --source
    camera; in simulation that of the kit's recordings, 0.20,0,0
    """
    source: Literal["sim", "camera"] = "sim"
    """source of images; camera with the --port of a real aircraft"""
    port: str = ""
    """the trainer port that commands go through: sim (the firmware in a simulated chip) or
    sim-python (plain Python), none if not given; with --source camera a serial port
    """
    bench: Path | None = None
    """file of falconwing bench: the simulator takes its lens and delays; a real camera's images are
    undistorted by it
    """
    camera: str = "0"
    """with --source camera: number or path of the camera, or a video file"""
    calibration: Path | None = None
    """with --source camera: file of falconwing calibrate; without it ./trainer_port.toml"""
    radio: str = ""
    """with --source camera: refuse a calibration of another radio"""
    checklists: Path = Path("records")
    """with --source camera: folder of the records of falconwing doctor --bench --out"""
    hand_over: Literal["enter", "now"] = "enter"
    """with --source camera: when the board is asked to follow: each time that Enter is pressed,
    while the person flies until then and after taking over; or at once and only once
    """
    seconds: float = 600.0
    """with --source camera: the flight ends after so long, the person's part included"""
    max_image_age: float = 0.4
    """with --source camera: maximum age of the image behind a command [s]"""
    battery_s: float = math.inf
    """with --source camera: so long after the program's start, the person's part included, control
    is handed back, and Enter refused [s]
    """
    out: Path | None = None
    """folder for log, table and figures; the same folder continues an interrupted study"""
    logs: bool = False
    """write a flight log of every trial; a single trial always has one in --out"""
    against: Path | None = None
    """folder of another pilot's trials from the same initial states, for comparison"""
    json: bool = False
    """print JSON instead of tables"""

    def run(self) -> int:
        """Fly the trials and print their summary.

        Returns:
            0 if every trial succeeded, else 1.

        Raises:
            InputError: an option is wrong or needs a part that this version does not have.
        """
        self._refuse_unavailable()
        if self._is_hardware:
            from falconwing_kit.tools.cli.fly_aircraft import fly_aircraft

            return fly_aircraft(self)
        hall = hall_loader(self._scene)
        task, setting = self._task(), self._setting()
        from falconwing_kit.tools.trials.trials import (
            compare_pilots,
            study_head,
            summarise_trials,
        )

        model = self._model(task)
        head = study_head(task, self._pilot_name, self.seed)
        head["start"] = None if task.start is None else task.start.vector.tolist()
        other = self._read_folders(head, setting)
        pilot = make_pilot(self, task, model)  # refuses its camera before a page opens
        records = self._fly(task, pilot, setting, hall, head)
        found = summarise_trials(records)
        if other is not None:
            found["against"] = compare_pilots(records, other)
        self._show(task.name, records, found)
        return 0 if found["successes"] == found["trials"] else 1

    def _refuse_unavailable(self) -> None:
        task = self.task if self.task in TASKS else LandingTask.name  # refused later
        try:
            pilot = require_pilot(self.pilot, task, _trained_scene(self._scene))
        except InputError as error:
            sentence = str(error).removeprefix("pilot: ")
            raise InputError(f"--pilot {self.pilot}: {sentence}") from None
        if self.pilot == "manual":
            raise InputError(
                "--pilot manual: expected a pilot that flies by itself, got sticks, which nobody"
                " holds here; use `falconwing class`"
            )
        if self.no_render and not pilot.reads_state:
            raise InputError(
                f"--no-render: expected it with a pilot by the state, got --pilot {self.pilot},"
                " which flies by images; leave it out"
            )

    @property
    def _is_hardware(self) -> bool:
        """Whether camera or board are real."""
        from falconwing_kit.tools.bridge.open_port import PORTS

        return self.source == "camera" or self.port not in ("", *PORTS)

    @property
    def _measured(self) -> "BenchCalibration | None":
        """The file of --bench."""
        if self.bench is None:
            return None
        from falconwing_kit.tools.devices.calibration import read_bench

        return read_bench(self.bench)

    @property
    def _scene(self) -> str:
        """--scene, or the default of the pilot."""
        by_camera = self.pilot in PILOTS and not PILOTS[self.pilot].reads_state
        return self.scene or ("hall" if by_camera else "arena")

    def _task(self) -> "FlightTask":
        """What is flown; numbers, start and manoeuvre are checked."""
        require_range("--trials", self.trials, low=1, high=TRIAL_SEEDS)
        require_range("--seed", self.seed, low=0, high=TRIAL_SEEDS - 1)
        require_range("--workers", self.workers, low=1, high=256)
        if self.workers > 1 and not self.headless:
            raise InputError(
                f"--workers {self.workers}: expected it with --headless, for a page shows one"
                " flight; add --headless"
            )
        if self.cluster and not self.headless:
            raise InputError(
                f"--cluster {self.cluster}: expected it with --headless, for a page shows one"
                " flight; add --headless"
            )
        if self.cluster and self.logs:
            raise InputError(
                "--logs: expected it without --cluster, whose workers have disks of their own; "
                "leave one of them out"
            )
        task = self._drawn_task()
        if self.camera_at:
            from falconwing_kit.tools.cli.scene_input import parse_place

            place = parse_place("--camera-at", self.camera_at)
            task = replace(task, airframe=replace(task.airframe, p_body_camera=place))
        if (bench := self._measured) is not None:
            task = replace(task, model=bench.with_delay(task.model))
        return replace(task, start=_start(self.start, task)) if self.start else task

    def _drawn_task(self) -> Any:
        if self.task not in TASKS:
            raise InputError(f"--task {self.task}: expected one of {', '.join(TASKS)}")
        entry = TASKS[self.task]
        if entry.manoeuvre:
            return entry.make(self.manoeuvre or entry.manoeuvre)
        if self.manoeuvre:
            with_leader = " or ".join(task.name for task in TASKS.values() if task.manoeuvre)
            raise InputError(
                f"--manoeuvre {self.manoeuvre}: expected it with --task {with_leader} only, "
                f"got --task {self.task}"
            )
        return entry.make()

    def _model(self, task: "FlightTask") -> "Model | None":
        """The model that the pilot is designed on; refused here if it cannot fly the task."""
        if self.model is None:
            return None
        from falconwing_kit.flight.trial import trial_seed
        from falconwing_kit.sysid.model_file import read_model

        model = read_model(self.model).model
        try:
            make_pilot(self, task, model)(task.trial(trial_seed(0, self.seed)))
        except InputError as error:
            raise InputError(f"--model {self.model.name}: {error}") from None
        return model

    @property
    def _pilot_name(self) -> str:
        """The pilot, and the model file that it is designed on, with the file's digest."""
        if self.model is None:
            return self.pilot
        digest = hashlib.sha256(self.model.read_bytes()).hexdigest()[:8]
        return f"{self.pilot} on {self.model.name} {digest}"

    def _setting(self) -> "TrialSettings":
        """Camera, clock and port of the trials; page and scene follow later."""
        from falconwing_kit.flight.loop import PacedClock, SimulatedClock
        from falconwing_kit.flight.sources import fpv_camera
        from falconwing_kit.tools.trials.trials import TrialSettings

        clock = SimulatedClock if self.headless else PacedClock
        size, bench = _size(self.size), self._measured
        if bench is None or bench.lens is None:
            camera = fpv_camera(*size)
        else:
            camera = bench.lens.lens.camera(*size)
        return TrialSettings(camera=camera, clock=clock, port=self.port, scene_name=self._scene)

    def _read_folders(
        self, head: dict[str, Any], setting: "TrialSettings"
    ) -> list[dict[str, Any]] | None:
        """Check --out and --against before the first flight; the trials of --against."""
        from falconwing_kit.tools.trials.trials import read_flown_trials, read_paired_trials

        if self.out is not None:
            if self.out.exists() and not self.out.is_dir():
                raise InputError(
                    f"--out {self.out}: expected a folder, got a file; choose another name"
                )
            how = {**setting.record, "rendered": not self.no_render}
            del how["scene_digest"]  # the scene is loaded after the page is open
            read_flown_trials(self.out, head | how)
        return None if self.against is None else read_paired_trials(self.against, head)

    def _fly(
        self,
        task: "FlightTask",
        pilot: "Callable[[TrialSetup], Pilot]",
        setting: "TrialSettings",
        hall: "Callable[[], GaussianScene]",
        head: dict[str, Any],
    ) -> list[dict[str, Any]]:
        from falconwing_kit.tools.cli.scene_input import open_link
        from falconwing_kit.tools.trials.trials import fly_trials

        with (
            _page(self, hall) as (scene, hooks, keep),
            self._progress() as progress,
        ):
            setting = replace(
                setting,
                scene=None if self.no_render else scene,
                link=open_link(self._scene),
                hooks=hooks,
            )
            records = fly_trials(
                task, pilot, self.trials, pilot=head["pilot"], seed=self.seed,
                setting=setting, out=self.out, head=head, logs=self._has_logs, progress=progress,
                fly=partial(fly_in_processes, self) if self.workers > 1 or self.cluster else None,
            )  # fmt: skip

            keep(records)
            return records

    @property
    def _has_logs(self) -> bool:
        return self.logs or (self.trials == 1 and not self.cluster)

    @contextmanager
    def _progress(self) -> Iterator[Callable[[str], None]]:
        from tqdm import tqdm

        quiet = True if self.json or self.trials == 1 else None
        with tqdm(total=self.trials, unit="trial", leave=False, disable=quiet) as bar:

            def flown(text: str) -> None:
                bar.n = int(text.split()[-1])
                bar.set_postfix_str(f"{text} succeeded")

            yield flown

    def _show(self, name: str, records: Sequence[dict[str, Any]], found: dict[str, Any]) -> None:
        if self.out is not None:
            from falconwing_kit.tools.trials.trial_figures import write_results

            files = write_results(records, found, self.out, f"{name} by {self._pilot_name}")
        if self.json:
            print_json(
                {
                    "task": name,
                    "pilot": self._pilot_name,
                    "scene": self._scene,
                    "simulated": True,
                    **found,
                }
            )
            return
        print_trials(f"SIMULATED: {name} by {self._pilot_name}", records, found)
        if self.out is None:
            scene = f" --scene {self.scene}" if self.scene else ""
            pilot = "" if self.pilot == "expert" else f" --pilot {self.pilot}"
            next_line(
                f"falconwing fly --task {self.task}{pilot}{scene} --trials 10 --headless"
                " --out trials"
            )
        else:
            next_line(f"look at {files['paths']} and {files['results']}")


def make_pilot(fly: Fly, task: Any, model: "Model | None") -> "Callable[[TrialSetup], Pilot]":
    """A function that makes the pilot for a trial, designed on a model; None: the aircraft's own.

    The expert is the task's own.
    """
    if fly.pilot == "expert" and fly.weights is None:
        return task.expert if model is None else partial(task.expert, model=model)
    pilot = load_pilot(
        fly.pilot, fly.task, _trained_scene(fly._scene), fly._setting().camera,
        task.airframe.p_body_camera, model=model or task.model, airframe=task.airframe,
        pad=getattr(task, "pad", None), weights=fly.weights,
    )  # fmt: skip

    def make(trial: "TrialSetup") -> "Pilot":
        pilot.reset()
        return pilot

    return make


def _trained_scene(name: str) -> str:
    """The scene whose networks fly in a scene; a file is taken as one of the hall."""
    return "arena" if name == "arena" else "hall"


def fly_in_processes(fly: Fly, numbers: Sequence[int]) -> Iterator[dict[str, Any]]:
    """Records of trials in their order, flown in several processes or on a cluster as `Fly` says.

    Raises:
        InputError: the cluster cannot be used.
        RuntimeError: a trial ended its process three times.
    """
    from falconwing_kit.tools.jobs.run import WorkerLostError, parallel_map

    waiting: dict[int, dict[str, Any]] = {}
    due = iter(numbers)
    number = next(due, None)
    files = {name: getattr(fly, name) for name in ("model", "bench")}
    there = replace(fly, **{name: path and path.resolve() for name, path in files.items()})
    for found, record in parallel_map(partial(_fly_one, there), numbers, fly.workers, fly.cluster):
        if isinstance(record, WorkerLostError):
            raise RuntimeError(f"trial {found}: {record}")
        waiting[found] = record
        while number in waiting:
            yield waiting.pop(number)
            number = next(due, None)


def _fly_one(fly: Fly, number: int) -> dict[str, Any]:
    """One trial, in a process of its own."""
    from falconwing_kit.tools.trials.trials import fly_trial, log_path

    task, model, setting = _prepare(fly)
    log = log_path(fly.out, number) if fly.out is not None and fly._has_logs else None
    pilot = make_pilot(fly, task, model)
    return fly_trial(task, pilot, number, fly.seed, setting, log, fly._pilot_name)


@cache
def _prepare(fly: Fly) -> tuple["FlightTask", "Model | None", "TrialSettings"]:
    """Task, model and setting of the trials, once in every process."""
    from falconwing_kit.tools.cli.scene_input import open_link

    task = fly._task()
    scene = None if fly.no_render else hall_loader(fly._scene)()
    setting = replace(fly._setting(), scene=scene, link=open_link(fly._scene))
    return task, fly._model(task), setting


def _start(text: str, task: Any) -> "State":
    """The state of --start: a pose as text, a log's engagement, or the first pose of a table."""
    import numpy as np

    from falconwing_kit.control.expert import landing_speed
    from falconwing_kit.core.flight_table import read_flight_table
    from falconwing_kit.flight.trial import state_at_pose
    from falconwing_kit.tools.cli.scene_input import parse_pose
    from falconwing_kit.tools.trials.engagement import state_at_engagement

    ending = Path(text).suffix.lower()
    if ending == ".mcap":
        return state_at_engagement(text, task.model, task.airframe.p_body_camera)
    if ending == ".csv":
        table = read_flight_table(text)
        rows = np.flatnonzero(table.has_pose)
        if len(rows) == 0:
            raise InputError(
                f"--start {text}: expected a table with poses, got none; use x,y,z,roll,pitch,yaw"
            )
        pose = table.p_world[rows[0]], table.attitude[rows[0]]
    else:
        pose = parse_pose("--start", text)
    return state_at_pose(task.model, *pose, speed=landing_speed(task.model))


def print_trials(title: str, records: Sequence[dict[str, Any]], found: dict[str, Any]) -> None:
    """Print rates and statistics: records of `fly_trials`, summary of `summarise_trials`."""
    low, high = 100.0 * found["success_low95"], 100.0 * found["success_high95"]
    print(
        f"{title}\nsuccess: {found['successes']} of {found['trials']} "
        f"(95 % between {low:.1f} and {high:.1f} %)"
    )
    rows = []
    for key, (label, factor) in UNITS.items():
        if key in found:
            numbers = (
                found[key][name] for name in ("mean", "low95", "high95", "median", "largest")
            )
            rows.append((label, *(factor * number for number in numbers)))
    print_table(("measure", "mean", "low 95 %", "high 95 %", "median", "maximum"), rows)
    if "locked_share" in found and "no images" in found["images"]:
        print("occlusion not evaluated: no images")
    print(
        f"ART: median {found['art_median_ms']:.2g} ms, 95 % of {found['art_steps']} steps within"
        f" {found['art_p95_ms']:.2g} ms ({found['images']}; {found['machine']})"
    )
    if "port" in records[0]:
        ports = [record["port"] for record in records]
        sent, dropped, frames = (
            sum(p[key] for p in ports)
            for key in ("commands_sent", "commands_dropped", "ppm_frames")
        )
        print(
            f"through the trainer port ({ports[0]['board']}): {sent} commands, {dropped} dropped; "
            f"{frames} PPM frames"
        )
    for record in records:
        if not record["success"]:
            lost = record.get("lost_at_s")
            print(
                f"trial {record['trial']}: {record['reason']}"
                + ("" if lost is None else f", lock lost at {lost:.2f} s")
            )
    faulty = next((record for record in records if record["faults"]), None)
    if faulty is not None:
        print(
            f"warning: the pilot failed in {found['faults']} steps; "
            f"first: {faulty['first_fault']['error']}"
        )
    if found["skipped"]:
        print(
            f"warning: {found['skipped']} steps missed their deadline and were dropped; "
            "use a smaller --size or --headless"
        )
    if "against" in found:
        pair = found["against"]
        print(
            f"pairs: {pair['pairs']}; only this pilot succeeded in {pair['only_first']}, "
            f"only the other in {pair['only_second']}; McNemar p = {pair['p_value']:.3g}"
        )


def hall_loader(name: str) -> "Callable[[], GaussianScene]":
    """A function that loads the hall; a wrong name or file is refused here, before a page opens.

    Args:
        name: a scene file, or a name of `load_scene`; a file of that name has precedence.

    Returns:
        The function; a shipped scene may have to be built first, which takes some time.

    Raises:
        FileNotFoundError: there is no file at a path.
        InputError: the file is not a scene, the kit has no scene of that name, or it is an aircraft
            alone.
    """
    from falconwing_kit.scene.arena import SCENES, load_scene
    from falconwing_kit.tools.cli.scene_input import open_scene

    if name == "leader" and not Path(name).exists():
        halls = ", ".join(scene for scene in SCENES if scene != name)
        raise InputError(
            f"--scene {name}: expected a hall to fly in, got an aircraft; use {halls} or a file"
        )
    if name in SCENES and not Path(name).exists():
        return lambda: load_scene(name)
    scene = open_scene(name)
    if "leader" in scene.label_names and scene.labelled("leader").all():
        raise InputError(
            f"--scene {name}: expected a hall to fly in, got an aircraft alone; add it to a hall"
        )
    return lambda: scene


@contextmanager
def _page(
    fly: Fly, hall: "Callable[[], GaussianScene]"
) -> Iterator[tuple[Any, tuple[Callable[..., None], ...], Callable[[Sequence[Any]], None]]]:
    """The hall, None if nothing is rendered; the page as a hook, unless headless; and what keeps
    the page open with the verdict on the records.
    """
    if fly.headless:
        yield None if fly.no_render else hall(), (), lambda records: None
        return
    from falconwing_kit.tools.classroom.flight_page import FlightPage
    from falconwing_kit.tools.trials.trials import log_path

    log = log_path(fly.out, 0) if fly.out is not None and fly.trials == 1 else None
    with FlightPage(fly._scene, task=fly.task) as page:
        print(f"live page: {page.url}", file=sys.stderr, flush=True)
        opened = page.open()
        scene = hall()
        page.set_scene(scene)
        watched = opened and page.wait_for_viewer(BROWSER_S)
        pace = _Pace()

        def keep(records: Sequence[Any]) -> None:
            if pace.stretch > STRETCH_SAID:
                print(
                    f"time was stretched: a second of the flight took {pace.stretch:.2f} s, for"
                    " this machine is busy or slow; use a smaller --size or --headless",
                    file=sys.stderr,
                )
            if watched:
                verdict = _verdict(records)
                print(f"{verdict}; the page stays until Ctrl-C", file=sys.stderr, flush=True)
                if log is not None and log.exists():
                    page.add_log(log)
                page.keep(verdict, all(record["success"] for record in records))

        yield None if fly.no_render else scene, (pace, page.show), keep


class _Pace:
    """A hook that compares the time of flights with real time."""

    def __init__(self) -> None:
        self._last: tuple[float, float] | None = None  # time of the flight, real time [s]
        self._flown, self._spent = 0.0, 0.0

    def __call__(self, step: Any) -> None:
        now = time.perf_counter()
        if self._last is not None and step.t > self._last[0]:
            self._flown += step.t - self._last[0]
            self._spent += now - self._last[1]
        self._last = step.t, now

    @property
    def stretch(self) -> float:
        """Real time over that of the flights; 1 before the second step."""
        return self._spent / self._flown if self._flown else 1.0


def _verdict(records: Sequence[dict[str, Any]]) -> str:
    """What the page says of flights that are over."""
    if len(records) > 1:
        return f"success in {sum(record['success'] for record in records)} of {len(records)}"
    record = records[0]
    if not record["success"]:
        return f"failed: {record['reason']}"
    if record.get("ald_m") is not None:
        return f"landed {100.0 * record['ald_m']:.0f} cm from the centre line"
    return "success"


def _size(text: str) -> tuple[int, int]:
    """Width and height of "320x240"."""
    fits = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if fits is None or not all(16 <= int(side) <= 4096 for side in fits.groups()):
        raise InputError(
            f"--size: expected WIDTHxHEIGHT of 16 to 4096 px such as 320x240, got {text!r}"
        )
    return int(fits[1]), int(fits[2])
