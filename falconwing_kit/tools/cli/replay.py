"""falconwing replay: replay a flight log live in the browser, or draw its figures."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from falconwing_kit.core.checks import InputError, require_file, require_range
from falconwing_kit.core.flight_log import read_flight_log
from falconwing_kit.core.messages import CONTROL_PERIOD_S, Command
from falconwing_kit.tools.cli.show import next_line, print_table

if TYPE_CHECKING:
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
    """Replay a flight log in the browser, repeatedly until Ctrl-C, or draw its figures."""

    log: Annotated[Path, tyro.conf.Positional]
    """the flight log (MCAP)"""
    out: Path = Path("replay")
    """folder for the figures of --headless"""
    headless: bool = False
    """write the figures instead of showing the page"""
    once: bool = False
    """end after the flight instead of starting again"""
    speed: float = 1.0
    """speed of replay; 0.25 is slow motion"""
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
        from falconwing_kit.flight.sources import RecordedPilot

        require_range("speed", self.speed, low=0.01, high=100.0)
        self._show(RecordedPilot(self.log))
        return 0

    def _draw(self) -> int:
        from falconwing_kit.tools.demo.approach import draw_flight

        self.out.mkdir(parents=True, exist_ok=True)
        paths = draw_flight(self.log, self.out)
        rows = [(path, FIGURES[path.stem.removeprefix("flight_")]) for path in paths]
        print_table(("figure", "shows"), rows)
        next_line(f"falconwing export {self.log} --out flight.csv")
        return 0

    def _show(self, pilot: "RecordedPilot") -> None:
        """Run the recorded commands through the kit's own loop, shown on the page only."""
        from falconwing_kit.flight.loop import Loop, PacedClock
        from falconwing_kit.flight.sources import RecordedImages, RecordedStates
        from falconwing_kit.scene.arena import load_scene
        from falconwing_kit.tools.demo.approach import is_simulated, mode_at
        from falconwing_kit.tools.demo.live_page import LivePage

        log = read_flight_log(self.log)
        title = "REPLAY of a SIMULATION" if is_simulated(log) else "REPLAY"
        page = LivePage(None, self.port, title)
        print(f"live page: {page.url}   (Ctrl-C ends it)", flush=True)
        try:
            opened = page.open()
            page.set_scene(load_scene("arena"))
            if opened:
                page.wait_for_viewer(BROWSER_S)
            reason = ""
            while reason != "interrupted":
                loop = Loop(
                    pilot,
                    _NullSink(),
                    RecordedImages(self.log),
                    RecordedStates(self.log),
                    clock=PacedClock(self.speed),
                    hooks=(
                        lambda step: page.show(
                            replace(step, mode=mode_at(log, step.t) or step.mode)
                        ),
                    ),
                )
                reason = loop.run(pilot.duration + CONTROL_PERIOD_S).reason
                if self.once:
                    break
        finally:
            page.close()


class _NullSink:
    """Sink that discards the commands of a replay."""

    def send(self, t: float, command: Command) -> None:
        """Discard a command."""
