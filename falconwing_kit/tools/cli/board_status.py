"""Board status: an open trainer port -> one line on the terminal, or a record for a table."""

import math
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import COMMAND_NAMES, Command
from falconwing_kit.tools.bridge.open_port import open_port
from falconwing_kit.tools.cli.calibrate import choose_calibration
from falconwing_kit.trainer_port.port import TrainerPort

if TYPE_CHECKING:
    from falconwing_kit.tools.bridge.recording import Recording

POLL_S = 0.005  # between two polls of the port
SHOW_S = 0.25  # between two updates of the line
PILOT_TIMEOUT_S = 0.5  # the pilot's radio sends 45 frames a second
MAX_S = 1e5  # of --seconds, more than a day


@dataclass
class StatusLine:
    """One line on the terminal with the board's status, overwritten; none without a terminal."""

    port: TrainerPort
    seconds: float  # duration; 0 is unlimited
    moves: bool = True  # move the sticks of a simulated board's pilot, to have something to show
    _start: float = math.nan  # on the port's clock: virtual time for a simulated flight
    _shown: float = -math.inf

    def is_over(self, recording: "Recording | None" = None) -> bool:
        """Update the line if it is due; True when the time is up."""
        now = self.port.now()
        self._start = now if math.isnan(self._start) else self._start
        t = now - self._start
        if t - self._shown >= SHOW_S:
            self._shown = t
            if self.moves:
                move_sticks(self.port, t)
            if sys.stderr.isatty():
                self._print(recording)
        return 0.0 < self.seconds <= t

    def _print(self, recording: "Recording | None") -> None:
        text = status_text(self.port)
        if recording is not None:
            text += f"  log {recording.counts.commands}/{recording.counts.images}"
        width = shutil.get_terminal_size().columns - 1  # a wrapped line cannot be overwritten
        print(f"\r{text[:width]}\x1b[K", end="", file=sys.stderr, flush=True)

    def alert(self, sentence: str) -> None:
        """Print an alert on a line of its own, with the terminal's bell."""
        alert(sentence)

    def end(self) -> None:
        """Leave the line."""
        if sys.stderr.isatty():
            print(file=sys.stderr)


def alert(sentence: str) -> None:
    """Print an alert on a line of its own, with the terminal's bell."""
    print(f"\n\aALERT: {sentence}", file=sys.stderr, flush=True)


@contextmanager
def open_ready_port(name: str, calibration: Path | None, radio: str = "") -> Iterator[TrainerPort]:
    """An open port whose board answers; on every exit control returns to the pilot.

    Args:
        name: of the port.
        calibration: its file; None takes what `choose_calibration` finds.
        radio: the radio that the calibration must be of; "" accepts any.

    Raises:
        InputError: the port cannot be opened, no board answers, or the calibration is stale or does
            not fit.
    """
    with open_port(name, choose_calibration(name, calibration, radio)) as port:
        note = "" if port.simulation else "; if it restarts, it answers after two seconds"
        print(f"{port.what}{note}", file=sys.stderr, flush=True)
        port.wait_ready()
        yield port


def status_text(port: TrainerPort) -> str:
    """The board's status in one line."""
    status, counters = port.status, port.counters
    if status is None or port.state != "open":
        return f"port {port.state}"
    fault = "" if status.fault == "none" else f" {status.fault}"
    channels = " ".join(map(str, status.channels_us))
    sticks = " ".join(f"{position:+.2f}" for position in pilot_sticks(port)) or "none"
    taken = " TAKEN by the pilot" if status.pilot_took_over else ""
    blind = " ENGAGES WITHOUT PILOT" if status.engages_without_pilot else ""
    waits = port.mismatch() if port.engagement in ("asking", "engaging") else ""
    waits = f"  not engaged: {waits}" if waits else ""
    return (
        f"{status.state}{fault}{taken}{blind}  {channels} us{waits}  pilot {sticks}  "
        f"boots {status.boot_count}  frames {status.ppm_frames}  "
        f"round trip {1e3 * port.clock.round_trip:.1f} ms  "
        f"sent {counters.sent} dropped {counters.dropped} bad {counters.bad + status.bad_frames}"
    )


def pilot_sticks(port: TrainerPort) -> list[float]:
    """The pilot's throttle, aileron, elevator and rudder; empty if unknown or out of date."""
    pilot = port.pilot
    if pilot is None or port.now() - port.to_host_time(pilot.device_time_us) > PILOT_TIMEOUT_S:
        return []
    with suppress(InputError):
        sticks = port.calibration.command(pilot.channels_us).vector.tolist()
        return [round(position, 3) for position in sticks]
    return []


def port_record(port: TrainerPort) -> dict[str, Any]:
    """State, counters, clock and pilot's sticks of a port, as they go to the table and to JSON."""
    status = port.status
    record: dict[str, Any] = {"board": port.what, "port": port.state, "engagement": port.engagement}
    record |= asdict(port.counters)
    record["engaged"] = sum(event.name == "engaged" for event in port.events)
    if status is None:
        return record
    record |= {"state": status.state, "fault": status.fault, "boot_count": status.boot_count}
    record |= {"reset_causes": list(status.reset_causes), "channels_us": list(status.channels_us)}
    for name in ("bad_frames", "bad_sequence", "out_of_range", "ppm_frames"):
        record[f"board_{name}"] = getattr(status, name)
    for name in ("engages_without_pilot", "has_pilot", "pilot_took_over"):
        record[name] = getattr(status, name)
    record["status_age_ms"] = 1e3 * port.status_age
    record["round_trip_ms"] = 1e3 * port.clock.round_trip
    record["clock_error_ms"] = 1e3 * port.clock.error_bound(status.device_time_us)
    record["clock_drift_ppm"] = port.clock.drift_ppm
    # strict=False: without the pilot's radio there are no sticks to add
    record |= zip((f"pilot_{name}" for name in COMMAND_NAMES), pilot_sticks(port), strict=False)
    if port.pilot is not None:
        record["pilot_frames_rejected"] = port.pilot.rejected
    return record


def move_sticks(port: TrainerPort, t: float) -> None:
    """Circle the sticks of a SIMULATED board's pilot; a real pilot's are left alone."""
    if port.simulation is None:
        return
    side, up = 0.8 * math.sin(t), 0.8 * math.cos(t)
    with port.simulation.pause() as board:
        board.set_pilot(port.calibration.channels_us(Command(0.5 + 0.5 * up, side, up, -side)))
