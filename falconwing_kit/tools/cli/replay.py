"""falconwing replay: play a flight log in the browser, or draw its figures."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from falconwing_kit.core.checks import InputError, require_file, require_range
from falconwing_kit.core.flight_log import read_flight_log
from falconwing_kit.core.messages import CONTROL_PERIOD_S, Command
from falconwing_kit.tools.cli.show import next_line, print_table

if TYPE_CHECKING:
    from collections.abc import Callable

    from falconwing_kit.flight.loop import LoopStep
    from falconwing_kit.flight.sources import RecordedPilot

BROWSER_S = 8.0  # a browser's time to show the page before a replay begins
FIGURES = {
    "fpv": "onboard camera view",
    "path": "path",
    "sticks": "commands, height and speed",
    "film": "all of it",
}


@dataclass(frozen=True)
class Replay:
    """Show a flight log in the browser until Ctrl-C, with a scrub bar, or draw its figures.

    The page is the classroom's: the flight in its hall, ghost, plots and verdict. A log without
    poses is shown again and again by its pictures and sticks.
    """

    log: Annotated[Path, tyro.conf.Positional]
    """the flight log (MCAP)"""
    scene: str = ""
    """the hall to show it in: a name that ships or a scene file; the one that the log names if not
    given
    """
    out: Path = Path("replay")
    """folder for the figures of --headless"""
    headless: bool = False
    """write the figures instead of showing the page"""
    speed: float = 1.0
    """speed of time at first, 0.1 to 4; 0.25 is slow motion"""
    port: int = 8080
    """TCP port of the page; the next free one if it is taken"""

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
        require_range("speed", self.speed, low=0.1, high=4.0)
        self._show()
        return 0

    def _hall(self, named: str) -> str:
        """--scene, else the scene of the log; the arena, and a sentence, where neither helps."""
        from falconwing_kit.tools.cli.fly import hall_loader

        if self.scene:
            hall_loader(self.scene)
            return self.scene
        try:
            if named:
                hall_loader(named)
                return named
            why = "the log does not say where it was flown"
        except (InputError, FileNotFoundError):
            why = f"the log's scene {named!r} is not here"
        print(f"{why}: shown in the arena; --scene NAME or FILE shows another hall", flush=True)
        return "arena"

    def _draw(self) -> int:
        from falconwing_kit.tools.demo.approach import draw_flight

        self.out.mkdir(parents=True, exist_ok=True)
        paths = draw_flight(self.log, self.out)
        rows = [(path, FIGURES[path.stem.removeprefix("flight_")]) for path in paths]
        print_table(("figure", "shows"), rows)
        next_line(f"falconwing export {self.log} --out flight.csv")
        return 0

    def _show(self) -> None:
        """Serve the player, or the wall where the log has pictures only, until Ctrl-C."""
        from falconwing_kit.flight.sources import RecordedPilot
        from falconwing_kit.tools.classroom.flight_page import PLAYER, WALL, FlightPage
        from falconwing_kit.tools.cli.fly import hall_loader
        from falconwing_kit.tools.demo.approach import is_simulated

        log = read_flight_log(self.log)
        has_poses = bool(len(log.states))
        pilot = None if has_poses else RecordedPilot(self.log)
        hall = self._hall(log.metadata.get("scene", ""))
        with FlightPage(
            hall, self.port, page=PLAYER if has_poses else WALL, task="replay",
            simulated=is_simulated(log), has_poses=has_poses,
        ) as page:  # fmt: skip
            if pilot is None:
                page.add_log(self.log)
                page.url += "" if self.speed == 1.0 else f"?speed={self.speed:g}"
            print(f"page: {page.url}   (Ctrl-C ends it)", flush=True)
            opened = page.open()
            page.set_scene(hall_loader(hall)())
            if pilot is None:
                page.wait()
                return
            if opened:
                page.wait_for_viewer(BROWSER_S)
            while self._play(pilot, page.show) != "interrupted":
                pass

    def _play(self, pilot: "RecordedPilot", show: "Callable[[LoopStep], None]") -> str:
        """Run the recorded commands through the kit's own loop, for the page only; why it ended."""
        from falconwing_kit.flight.loop import Loop, PacedClock
        from falconwing_kit.flight.sources import RecordedImages, RecordedLeader, RecordedStates

        loop = Loop(
            pilot, _NullSink(), RecordedImages(self.log), RecordedStates(self.log),
            RecordedLeader(self.log), clock=PacedClock(self.speed), hooks=(show,),
        )  # fmt: skip
        return loop.run(pilot.duration + CONTROL_PERIOD_S).reason


class _NullSink:
    """Sink that discards the commands of a replay."""

    def send(self, t: float, command: Command) -> None:
        """Discard a command."""
