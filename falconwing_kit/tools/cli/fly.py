"""falconwing fly: a task and a pilot -> simulated flights by the 20 Hz loop, watched live or many
at once.
"""

import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from falconwing_kit.control.manoeuvres import MANOEUVRES
from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.flight.tasks import TASKS, TRIAL_SEEDS
from falconwing_kit.tools.cli.show import next_line, print_json, print_table

if TYPE_CHECKING:
    from falconwing_kit.flight.tasks import FlightTask
    from falconwing_kit.scene.gaussians import GaussianScene
    from falconwing_kit.tools.trials.trials import TrialSettings

    TaskName = str
else:
    TaskName = Literal[tuple(TASKS)]  # as the command line offers them

PILOTS = ("expert",)  # those that this version of the kit has
UNAVAILABLE_PILOTS = ("rgb", "mask", "rgb_mask", "student", "manual")
TASK_HELP = "; ".join(f"{task.name}: {task.summary}" for task in TASKS.values())
MANOEUVRE_HELP = "what the leader flies ({}); {}".format(
    ", ".join(
        f"{task.manoeuvre} where --task {task.name} names none"
        for task in TASKS.values()
        if task.manoeuvre
    ),
    "; ".join(f"{manoeuvre.name}: {manoeuvre.summary}" for manoeuvre in MANOEUVRES.values()),
)
BROWSER_S = 8.0  # what a browser may take to show the page before the flight begins
UNITS = {  # of the summary: what a row is called, and the factor to its unit
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
    """Fly a task by the kit's 20 Hz loop, in simulation.

    Without --headless a page in the browser shows the flight in real time; with it the flights go
    as fast as they can. Exit code 0 when every trial succeeded, 1 when one failed.
    """

    task: Annotated[TaskName, tyro.conf.arg(help=TASK_HELP)] = "landing"
    pilot: Literal["expert", "rgb", "mask", "rgb_mask", "student", "manual"] = "expert"
    """who flies; the expert knows the state"""
    trials: int = 1
    """how many, each from its own start of the frozen list"""
    manoeuvre: Annotated[str, tyro.conf.arg(help=MANOEUVRE_HELP)] = ""
    seed: int = 0
    """which list of starts and noise; the same for two pilots makes pairs"""
    headless: bool = False
    """no page, as fast as it can"""
    no_render: bool = False
    """without images; the expert needs none"""
    scene: str = "arena"
    """the hall: arena, hall, hall_analog (seen through an analog link), or a scene file in the
    kit's world
    """
    size: str = "320x240"
    """of the camera's image [px]"""
    source: Literal["sim", "camera"] = "sim"
    """where images come from"""
    port: str = ""
    """the trainer port that every command goes through: sim (the firmware in a simulated chip) or
    sim-python (plain Python); none where it is left out
    """
    out: Path | None = None
    """folder for log, table and figures; an interrupted study goes on there"""
    logs: bool = False
    """write a flight log of every trial; a single trial always has one in --out"""
    against: Path | None = None
    """folder of another pilot's trials from the same starts, to compare with"""
    json: bool = False
    """print JSON instead of tables"""

    def run(self) -> int:
        """Fly.

        Returns:
            0 where every trial succeeded, else 1.

        Raises:
            InputError: a part of the kit that is not there yet is asked for, or an option is wrong.
        """
        self._refuse_what_is_not_there()
        hall = hall_loader(self.scene)
        task, setting = self._task(), self._setting()
        other = self._look_into_folders(task, setting)
        from falconwing_kit.tools.trials.trials import compare_pilots, summarise_trials

        records = self._fly(task, setting, hall)
        found = summarise_trials(records)
        if other is not None:
            found["against"] = compare_pilots(records, other)
        self._show(task.name, records, found)
        return 0 if found["successes"] == found["trials"] else 1

    def _refuse_what_is_not_there(self) -> None:
        if self.pilot not in PILOTS:
            raise InputError(
                f"--pilot {self.pilot}: this version of the kit has no such pilot yet; take {' or '.join(PILOTS)}"
            )
        if self.source != "sim":
            raise InputError(
                f"--source {self.source}: this version of the kit has no pilot for the real aircraft yet;"
                " fly --source sim"
            )
        if self.port:
            from falconwing_kit.tools.bridge.open_port import PORTS

            if self.port not in PORTS:
                raise InputError(
                    f"--port {self.port}: this version of the kit has no pilot for the real aircraft yet; take"
                    f" {' or '.join(PORTS)}, or look at a real board with `falconwing bridge --port {self.port}`"
                )

    def _task(self) -> "FlightTask":
        """What is flown; numbers and manoeuvre are checked."""
        require_range("--trials", self.trials, low=1, high=TRIAL_SEEDS)
        require_range("--seed", self.seed, low=0, high=TRIAL_SEEDS - 1)
        if self.task not in TASKS:
            raise InputError(f"--task {self.task}: expected one of {', '.join(TASKS)}")
        entry = TASKS[self.task]
        if entry.manoeuvre:
            return entry.make(self.manoeuvre or entry.manoeuvre)
        if self.manoeuvre:
            with_leader = " or ".join(task.name for task in TASKS.values() if task.manoeuvre)
            raise InputError(
                f"--manoeuvre {self.manoeuvre}: expected it with --task {with_leader} only, got --task {self.task}"
            )
        return entry.make()

    def _setting(self) -> "TrialSettings":
        """How it is flown, before there is a page and a scene."""
        from falconwing_kit.flight.loop import SimulatedClock, WallClock
        from falconwing_kit.flight.sources import fpv_camera
        from falconwing_kit.tools.trials.trials import TrialSettings

        clock = SimulatedClock if self.headless else WallClock
        return TrialSettings(camera=fpv_camera(*_size(self.size)), clock=clock, port=self.port)

    def _look_into_folders(
        self, task: "FlightTask", setting: "TrialSettings"
    ) -> list[dict[str, Any]] | None:
        """Refuse what does not fit in --out and --against before anything is flown; the trials of
        --against.
        """
        from falconwing_kit.tools.trials.trials import (
            read_flown_trials,
            read_paired_trials,
            study_head,
        )

        head = study_head(task, self.pilot, self.seed)
        if self.out is not None:
            if self.out.exists() and not self.out.is_dir():
                raise InputError(
                    f"--out {self.out}: expected a folder, got a file; choose another name"
                )
            how = {**setting.record, "rendered": not self.no_render}
            del how["scene_digest"]  # the hall is loaded when the page is open
            read_flown_trials(self.out, head | how)
        return None if self.against is None else read_paired_trials(self.against, head)

    def _fly(
        self, task: "FlightTask", setting: "TrialSettings", hall: "Callable[[], GaussianScene]"
    ) -> list[dict[str, Any]]:
        from falconwing_kit.tools.cli.scene import open_link
        from falconwing_kit.tools.trials.trials import fly_trials

        with (
            _page(hall, self.headless, not self.no_render) as (scene, hooks),
            self._progress() as progress,
        ):
            setting = replace(
                setting,
                scene=None if self.no_render else scene,
                link=open_link(self.scene),
                hooks=hooks,
            )
            return fly_trials(
                task, task.expert, self.trials, pilot=self.pilot, seed=self.seed, setting=setting,
                out=self.out, logs=self.logs or self.trials == 1, progress=progress,
            )  # fmt: skip

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

            files = write_results(records, found, self.out, f"{name} by {self.pilot}")
        if self.json:
            print_json(
                {"task": name, "pilot": self.pilot, "scene": self.scene, "simulated": True, **found}
            )
            return
        print_trials(f"SIMULATED: {name} by {self.pilot}", records, found)
        if self.out is None:
            scene = "" if self.scene == "arena" else f" --scene {self.scene}"
            next_line(
                f"falconwing fly --task {self.task}{scene} --trials 10 --headless --out trials"
            )
        else:
            next_line(f"look at {files['paths']} and {files['results']}")


def print_trials(title: str, records: Sequence[dict[str, Any]], found: dict[str, Any]) -> None:
    """Print the rates and means of trials.

    Args:
        title: a line above.
        records: of `flight.trials.fly_trials`.
        found: of `flight.trials.summary`.
    """
    low, high = 100.0 * found["success_low95"], 100.0 * found["success_high95"]
    print(
        f"{title}\nsuccess: {found['successes']} of {found['trials']} (95 % between {low:.1f} and {high:.1f} %)"
    )
    rows = []
    for key, (label, factor) in UNITS.items():
        if key in found:
            numbers = (
                found[key][name] for name in ("mean", "low95", "high95", "median", "largest")
            )
            rows.append((label, *(factor * number for number in numbers)))
    print_table(("measure", "mean", "low 95 %", "high 95 %", "median", "largest"), rows)
    if "locked_share" in found and "no images" in found["images"]:
        print("occlusion not judged: no images")
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
            f"through the trainer port ({ports[0]['board']}): {sent} commands, {dropped} dropped; {frames} PPM frames"
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
            f"warning: the pilot failed in {found['faults']} steps; first: {faulty['first_fault']['error']}"
        )
    if found["skipped"]:
        print(
            f"warning: {found['skipped']} steps came too late and were skipped; a smaller --size or --headless helps"
        )
    if "against" in found:
        pair = found["against"]
        print(
            f"pairs: {pair['pairs']}; only this pilot succeeded in {pair['only_first']}, only the other in"
            f" {pair['only_second']}; McNemar p = {pair['p_value']:.3g}"
        )


def hall_loader(name: str) -> "Callable[[], GaussianScene]":
    """How to get the hall to fly in; a wrong name and a bad file are refused at once, before a page
    is opened.

    Args:
        name: a scene file, or the name of a scene that ships; a file of that name goes first.

    Returns:
        A function that gives the hall. One that ships may have to be built first, which takes a
        while.

    Raises:
        FileNotFoundError: there is no file at a path.
        InputError: the file is no scene, no scene of that name ships, or it is an aircraft alone.
    """
    from falconwing_kit.scene.arena import SCENES, load_scene
    from falconwing_kit.tools.cli.scene import open_scene

    if name == "leader" and not Path(name).exists():
        halls = ", ".join(scene for scene in SCENES if scene != name)
        raise InputError(
            f"--scene {name}: expected a hall to fly in, got an aircraft; take {halls} or a file"
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
    hall: "Callable[[], GaussianScene]", headless: bool, render: bool
) -> Iterator[tuple[Any, tuple[Callable[..., None], ...]]]:
    """The hall where somebody looks at it, and the page as a hook."""
    if headless and not render:
        yield None, ()
        return
    if headless:
        yield hall(), ()
        return
    from falconwing_kit.tools.demo.live_page import LivePage

    with LivePage() as page:
        print(f"live page: {page.url}", file=sys.stderr, flush=True)
        opened = page.open()
        scene = hall()
        page.set_scene(scene)
        if opened:
            page.wait_for_viewer(BROWSER_S)
        yield scene, (page.show,)


def _size(text: str) -> tuple[int, int]:
    """Width and height of "320x240"."""
    fits = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if fits is None or not all(16 <= int(side) <= 4096 for side in fits.groups()):
        raise InputError(
            f"--size: expected WIDTHxHEIGHT of 16 to 4096 px such as 320x240, got {text!r}"
        )
    return int(fits[1]), int(fits[2])
