"""`falconwing export` and `falconwing replay`: a flight log in; a table, a ROS bag, a page or
figures out.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from falconwing_kit.core.checks import InputError, require_file, require_range
from falconwing_kit.core.flight_log import read_flight_log, recover, to_flight_table
from falconwing_kit.core.flight_table import write_flight_table
from falconwing_kit.core.messages import CONTROL_PERIOD_S, Command
from falconwing_kit.tools.cli.show import next_line, print_json, print_table

BROWSER_S = 8.0  # a browser gets so long to show the page before a replay begins


@dataclass(frozen=True)
class Export:
    """Turn a flight log into a flight table or a ROS bag, or an interrupted log into a whole one."""

    log: Annotated[Path, tyro.conf.Positional]
    """the flight log (MCAP), also one whose writing was cut short"""
    out: Path
    """the file to write, or a folder to write it into"""
    to: Literal["csv", "mcap", "bag"] = "csv"
    """csv: one row per image with pose and command; mcap: all that can be read, indexed and
    compressed; bag: ROS 1
    """
    json: bool = False
    """print the result as JSON"""

    def run(self) -> int:
        """Write the file and say what is in it.

        Returns:
            0: the file is written.

        Raises:
            FileNotFoundError: there is no log, or no folder for the file.
            InputError: the log cannot be used, or the file cannot be written or is the log itself.
        """
        target = self.out / f"{self.log.stem}.{self.to}" if self.out.is_dir() else self.out
        if target.resolve() == self.log.resolve():
            raise InputError(
                f"{target}: expected another name than the log's own, so that the log is kept"
            )
        write, use = {
            "csv": (self._to_table, f"falconwing identify {target}"),
            "mcap": (self._to_log, f"falconwing export {target} --to csv"),
            "bag": (self._to_bag, f"rosbag info {target}"),
        }[self.to]
        counts, warnings = write(target)
        if self.json:
            print_json({"file": str(target), **counts, "warnings": list(warnings)})
            return 0
        print_table(["what", "count"], list(counts.items()), title=str(target))
        for sentence in warnings:
            print(f"warning: {sentence}")
        next_line(use)
        return 0

    def _to_table(self, target: Path) -> tuple[dict[str, int], tuple[str, ...]]:
        table = to_flight_table(read_flight_log(self.log))
        write_flight_table(target, table)
        return {"rows": len(table.t), "rows with a pose": int(table.has_pose.sum())}, table.warnings

    def _to_log(self, target: Path) -> tuple[dict[str, int], tuple[str, ...]]:
        saved = recover(self.log, target)
        return {topic.strip("/"): count for topic, count in saved.counts.items()}, saved.warnings

    def _to_bag(self, target: Path) -> tuple[dict[str, int], tuple[str, ...]]:
        from falconwing_kit.tools.bridge.bag import write_bag

        log = read_flight_log(self.log)
        return write_bag(target, log), log.warnings


@dataclass(frozen=True)
class Replay:
    """Show a flight log again in the browser, over and over until Ctrl-C, or draw its figures."""

    log: Annotated[Path, tyro.conf.Positional]
    """the flight log (MCAP)"""
    out: Path = Path("replay")
    """folder for the figures of --headless"""
    headless: bool = False
    """write the figures instead of showing the page"""
    once: bool = False
    """end after the flight instead of beginning again"""
    speed: float = 1.0
    """how fast time runs; 0.25 is slow motion"""
    port: int = 8080
    """where to serve the page; the next free one where it is taken"""

    def run(self) -> int:
        """Show or draw the flight.

        Returns:
            0: it was shown, or the figures are written.

        Raises:
            FileNotFoundError: there is no log.
            InputError: the log cannot be used, a figure cannot be written, or an option is out of
                its range.
        """
        require_file(self.log)
        if self.headless:
            if self.out.exists() and not self.out.is_dir():
                raise InputError(
                    f"--out {self.out}: expected a folder, got a file; choose another name"
                )
            return self._draw()
        from falconwing_kit.flight.sources import RecordedPilot

        require_range("speed", self.speed, low=0.01, high=100.0)
        self._show(RecordedPilot(self.log))
        return 0

    def _draw(self) -> int:
        from falconwing_kit.tools.demo.approach import draw_flight

        self.out.mkdir(parents=True, exist_ok=True)
        shown = {
            "fpv": "view from the nose",
            "path": "path",
            "sticks": "sticks, height and speed",
            "film": "all of it",
        }
        paths = draw_flight(self.log, self.out)
        print_table(
            ("figure", "shows"),
            [(path, shown[path.stem.removeprefix("flight_")]) for path in paths],
        )
        next_line(f"falconwing export {self.log} --out flight.csv")
        return 0

    def _show(self, pilot: Any) -> None:
        """Fly the recorded commands by the kit's own loop, into nothing but the page."""
        from falconwing_kit.flight.loop import Loop
        from falconwing_kit.flight.sources import RecordedImages, RecordedStates
        from falconwing_kit.scene.arena import load_scene
        from falconwing_kit.tools.demo.approach import PacedClock, is_simulated, mode_at
        from falconwing_kit.tools.demo.live_page import LivePage

        log = read_flight_log(self.log)
        page = LivePage(
            None, self.port, "REPLAY of a SIMULATION" if is_simulated(log) else "REPLAY"
        )
        print(f"live page: {page.url}   (Ctrl-C ends it)", flush=True)
        try:
            opened = page.open()
            page.set_scene(load_scene("arena"))
            if opened:
                page.wait_for_viewer(BROWSER_S)
            reason = ""
            while reason != "interrupted":
                loop = Loop(
                    pilot, _NullSink(), RecordedImages(self.log), RecordedStates(self.log), clock=PacedClock(self.speed),
                    hooks=(lambda step: page.show(replace(step, mode=mode_at(log, step.t) or step.mode)),),
                )  # fmt: skip
                reason = loop.run(pilot.duration + CONTROL_PERIOD_S).reason
                if self.once:
                    break
        finally:
            page.close()


class _NullSink:
    """Commands of a replay go nowhere."""

    def send(self, t: float, command: Command) -> None:
        """Let it be."""
