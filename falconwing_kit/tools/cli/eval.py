"""falconwing eval: fly pilots in many worlds, and write tables beside the paper's figures."""

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from falconwing_kit.core.checks import InputError, require_file, require_range
from falconwing_kit.flight.pilots import PILOTS, require_pilot
from falconwing_kit.flight.trial import TRIAL_SEEDS
from falconwing_kit.tools.cli.scene_input import parse_size
from falconwing_kit.tools.cli.show import next_line, print_json, print_table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from falconwing_kit.tools.trials.evaluation import Cell
    from falconwing_kit.tools.trials.worlds import World

OFFERED = tuple(name for name in PILOTS if name != "manual")  # no sticks here
QUICK_TRIALS = 3
MIN_SIDE_PX = 16


@dataclass(frozen=True)
class Eval:
    """Fly each pilot in each world from the same frozen starts, and write the paper's tables.

    Writes into --out: trials.jsonl (a line a trial; the same command goes on where it was ended),
    index.html, tables.md, summary.jsonl and the curves of the sweeps. Everything is simulated.

    Exit code 0 when all trials were flown, 1 if --minutes ended them before.
    """

    pilots: str = "expert"
    """names separated by commas; see falconwing fly --help"""
    task: Literal["landing", "follow", "both"] = "both"
    """pilots that do not fly one of both are left out there"""
    worlds: str = "tables"
    """tables (landings from three kinds of starts; training and unseen manoeuvres; spread aircraft;
    reality), sweeps, all; or names of groups and worlds, separated by commas
    """
    trials: int = 100
    """in each world"""
    weights: Path | None = None
    """a policy's file of falconwing train, for the pilots by images, in place of those that ship"""
    seed: int = 0
    """number of the frozen list of starts, the same for all pilots"""
    scene: str = "hall"
    """hall or arena"""
    size: Annotated[str, tyro.conf.arg(metavar="WxH")] = "320x240"
    """of the camera's image [px]"""
    workers: int = 1
    """processes that share the trials"""
    minutes: float = math.inf
    """no trial begins later"""
    quick: bool = False
    """three trials in each world, and of each sweep only the two ends"""
    show: bool = False
    """print the worlds and stop"""
    out: Path = Path("eval")
    """folder for records, page and figures"""
    json: bool = False
    """print JSON instead of tables"""

    def run(self) -> int:
        """Fly and write.

        Returns:
            0 if all trials were flown, else 1.

        Raises:
            InputError: an option is wrong, or the folder holds other trials.
        """
        if self.show:
            return _list_worlds(self.json)
        from falconwing_kit.tools.trials.evaluation import fly_cells, group_records
        from falconwing_kit.tools.trials.evaluation_page import evaluation_tables, write_evaluation

        cells, trials = self._cells(), QUICK_TRIALS if self.quick else self.trials
        if self.out.exists() and not self.out.is_dir():
            raise InputError(
                f"--out {self.out}: expected a folder, got a file; choose another name"
            )
        with _Progress(self.json) as progress:
            records = fly_cells(
                cells, trials, self.out, workers=self.workers, minutes=self.minutes,
                progress=progress,
            )  # fmt: skip
        grouped = group_records(cells, records)
        if not grouped:
            raise InputError(
                f"--minutes {self.minutes:g}: expected time for a trial, got none; allow more"
            )
        files = write_evaluation(grouped, self.out)
        is_complete = len(records) == len(cells) * trials
        tables = evaluation_tables(grouped)
        if self.json:
            print_json({
                "simulated": True, "trials_flown": len(records), "of": len(cells) * trials,
                "tables": {
                    part.title: [dict(zip(part.headers, row, strict=True)) for row in part.rows]
                    for part in tables
                },
            })  # fmt: skip
        else:
            for part in tables:
                print_table(part.headers, part.rows, title=f"SIMULATED: {part.title.lower()}")
                print()
            flown = f"{len(records)} of {len(cells) * trials} trials flown"
            page = f"open {files['page']}"
            next_line(page if is_complete else f"{flown}; the same command goes on")
        return 0 if is_complete else 1

    def _cells(self) -> "list[Cell]":
        """What is flown; all options are checked."""
        from falconwing_kit.tools.trials.evaluation import SCENES, Cell, pilot_by_images
        from falconwing_kit.tools.trials.worlds import TASKS, select_worlds

        if self.scene not in SCENES:
            raise InputError(f"--scene {self.scene}: expected {' or '.join(SCENES)}")
        require_range("--trials", self.trials, low=1, high=TRIAL_SEEDS)
        require_range("--seed", self.seed, low=0, high=TRIAL_SEEDS - 1)
        require_range("--workers", self.workers, low=1, high=256)
        if not self.minutes > 0.0:
            raise InputError(f"--minutes: expected more than 0, got {self.minutes:g}")
        size = parse_size(self.size)
        for side in size:
            require_range("--size", side, low=MIN_SIDE_PX, high=4096)
        tasks = TASKS if self.task == "both" else (self.task,)
        cells = []
        for pilot in dict.fromkeys(name.strip() for name in self.pilots.split(",")):
            flown = [task for task in tasks if pilot in PILOTS and task in PILOTS[pilot].tasks]
            if pilot == "manual":
                raise InputError(
                    "--pilots manual: expected pilots that fly by themselves, got sticks; use"
                    " `falconwing class`"
                )
            for task in flown or tasks[:1]:
                require_pilot(pilot, task, self.scene)
                worlds = _ends(select_worlds(self.worlds, task), self.quick)
                weights = () if PILOTS[pilot].reads_state else self._weights()
                cells += [
                    Cell(pilot, task, world, size, self.seed, self.scene, *weights)
                    for world in worlds
                ]
                if weights:
                    pilot_by_images(cells[-1])  # refuses other weights before the first trial
        return cells

    def _weights(self) -> tuple[str, ...]:
        """File and digest of --weights; empty without."""
        if self.weights is None:
            return ()
        path = require_file(self.weights).resolve()
        return str(path), hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def _ends(worlds: "Sequence[World]", quick: bool) -> "Sequence[World]":
    """The worlds, for a quick look without the levels between the ends of a sweep."""
    if not quick:
        return worlds
    levels: dict[str, list[float]] = {}
    for world in worlds:
        if world.level is not None:
            levels.setdefault(world.group, []).append(world.level)
    ends = {group: (min(values), max(values)) for group, values in levels.items()}
    return [w for w in worlds if w.level is None or w.level in ends[w.group]]


def _list_worlds(as_json: bool) -> int:
    """Print the worlds by group."""
    from falconwing_kit.tools.trials.worlds import GROUPS, WORLDS

    rows = [
        (group, ", ".join(name for name, world in WORLDS.items() if world.group == group))
        for group in GROUPS
    ]
    if as_json:
        print_json({group: names.split(", ") for group, names in rows})
    else:
        print_table(("group", "worlds"), rows)
        next_line("falconwing eval --pilots expert --worlds landing --trials 10")
    return 0


class _Progress:
    """A bar of trials on standard error."""

    def __init__(self, quiet: bool) -> None:
        from tqdm import tqdm

        self._bar: Any = tqdm(unit="trial", disable=True if quiet else None, leave=False)
        self._failed = 0

    def __enter__(self) -> "_Progress":
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.close()

    def __call__(self, done: int, of: int, record: "dict[str, Any] | None") -> None:
        self._bar.total = of
        self._failed += record is not None and not record["success"]
        self._bar.set_postfix_str(f"{self._failed} failed", refresh=False)
        self._bar.update(done - self._bar.n)
