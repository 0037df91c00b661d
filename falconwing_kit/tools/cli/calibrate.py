"""falconwing calibrate: calibrate the trainer port: channel order, end points and reversing.

A calibration is a small TOML file, ./trainer_port.toml in the current folder. The verbs that use a
port read it from there, or from --calibration.
"""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from statistics import median
from typing import Protocol
from warnings import warn

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.config import write_toml
from falconwing_kit.core.files import require_writable_path
from falconwing_kit.core.messages import COMMAND_NAMES, Command
from falconwing_kit.tools.bridge.open_port import open_port
from falconwing_kit.tools.cli.show import next_line, print_json, print_table
from falconwing_kit.trainer_port.port import TrainerPort, require_matching_calibration
from falconwing_kit.trainer_port.ppm import Calibration, Stick, load_calibration

DEFAULT = Path("trainer_port.toml")
SIMULATED_PORTS = ("sim", "sim-python")
MAX_AGE_DAYS = 180  # trims and plugs change; measure again every term
HOLD_S, HOLDS = 0.6, 5  # duration of a reading, and how often it is tried
STILL_US = 12  # maximum variation of a stick held still
MIN_TRAVEL_US = 250  # between a stick's ends
CLEAR = 3.0  # the moved channel must change by this factor more than any other
# name, instruction to the person, position of the sticks then
POSES: tuple[tuple[str, str, Command], ...] = (
    (
        "rest",
        "throttle all the way down, the other sticks in their centre",
        Command(0.0, 0.0, 0.0, 0.0),
    ),
    ("throttle +", "throttle all the way up", Command(1.0, 0.0, 0.0, 0.0)),
    (
        "aileron +",
        "throttle down again; aileron all the way right (right wing down)",
        Command(0.0, 1.0, 0.0, 0.0),
    ),
    ("aileron -", "aileron all the way left", Command(0.0, -1.0, 0.0, 0.0)),
    ("elevator +", "elevator pulled all the way back (nose up)", Command(0.0, 0.0, 1.0, 0.0)),
    ("elevator -", "elevator pushed all the way forward (nose down)", Command(0.0, 0.0, -1.0, 0.0)),
    ("rudder +", "rudder all the way right (nose right)", Command(0.0, 0.0, 0.0, 1.0)),
    ("rudder -", "rudder all the way left", Command(0.0, 0.0, 0.0, -1.0)),
)
# the SIMULATED radio: everything but the throttle's channel differs from the kit's default
SIMULATED_RADIO = Calibration(
    "SIMULATED radio", "", 4, 22000, 400, 1,
    throttle=Stick(1, 1080, 1490, 1900), aileron=Stick(4, 1105, 1512, 1910, reversed=True),
    elevator=Stick(2, 1090, 1487, 1895), rudder=Stick(3, 1110, 1520, 1920, reversed=True),
)  # fmt: skip


class Operator(Protocol):
    """The person who moves the sticks."""

    def hold(self, what: str, sticks: Command) -> None:
        """Move the sticks as instructed; return when they are held still there."""


class KeyboardOperator:
    """A person at the terminal, who confirms with Enter."""

    def hold(self, what: str, sticks: Command) -> None:
        """Print the instruction and wait for Enter."""
        print(f"  {what}; hold it and press Enter ", end="", file=sys.stderr, flush=True)
        if not sys.stdin.readline():
            raise InputError(
                "calibrate: expected Enter at the keyboard, got the end of the input; "
                "run it at a terminal"
            )


@dataclass(frozen=True)
class SimulatedOperator:
    """A SIMULATED person with a SIMULATED radio, for --port sim."""

    port: TrainerPort
    radio: Calibration = SIMULATED_RADIO

    def hold(self, what: str, sticks: Command) -> None:
        """Set the simulated radio's sticks."""
        print(f"  {what} (SIMULATED)", file=sys.stderr)
        if self.port.simulation is not None:
            with self.port.simulation.pause() as board:
                board.set_pilot(self.radio.channels_us(sticks))


@dataclass(frozen=True)
class Calibrate:
    """Calibrate the trainer port from the board's pilot input: channel order, end points and
    reversing of your radio's sticks.

    Propeller off. Move one stick after the other as instructed. --port sim is a dry run.
    """

    port: str
    """serial port of the trainer bridge, or sim"""
    radio: str = ""
    """your radio, such as "Spektrum NX8"; written to the file to identify it"""
    out: Path = DEFAULT
    """the file to write; other verbs read trainer_port.toml in the current folder"""
    replace: bool = False
    """overwrite an older file"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Instruct, measure and write the file.

        Returns:
            0: the file is written.

        Raises:
            InputError: the port does not answer, a stick was not moved as instructed, or the file
                cannot be written.
        """
        require_writable_path(self.out)
        if self.out.exists() and not self.replace:
            raise InputError(f"{self.out}: expected a new file, got one that exists; add --replace")
        if not self.radio and self.port not in SIMULATED_PORTS:
            raise InputError(
                '--radio: expected the name of your radio, such as "Spektrum NX8", got none'
            )
        with open_port(self.port) as port:
            print(
                f"{port.what}; the file will be {self.out.resolve()}", file=sys.stderr, flush=True
            )
            port.wait_ready(calibrated=False)
            operator: Operator = (
                KeyboardOperator() if port.simulation is None else SimulatedOperator(port)
            )
            calibration = measure_calibration(port, operator, self.radio or SIMULATED_RADIO.radio)
        write_toml(self.out, calibration)
        self._show(calibration)
        return 0

    def _show(self, calibration: Calibration) -> None:
        record = {
            name: stick for name, stick in zip(COMMAND_NAMES, calibration.sticks, strict=True)
        }
        if self.json:
            sticks = {name: vars(stick) for name, stick in record.items()}
            print_json(
                {"file": str(self.out.resolve()), "radio": calibration.radio, "sticks": sticks}
            )
            return
        rows = [
            (name, s.channel, s.low_us, s.centre_us, s.high_us, s.reversed)
            for name, s in record.items()
        ]
        head = ("stick", "channel", "low [us]", "centre [us]", "high [us]", "reversed")
        print_table(
            head, rows, title=f"{calibration.radio}, {calibration.measured}: {self.out.resolve()}"
        )
        next_line(f"falconwing bridge --port {self.port}, and check the direction of every stick")


def measure_calibration(
    port: TrainerPort, operator: Operator, radio: str, pause: Callable[[float], object] = time.sleep
) -> Calibration:
    """Read the sticks in every pose and compute the calibration.

    Args:
        port: ready; its pilot input is read.
        operator: moves the sticks.
        radio: its name, for the file.
        pause: waits [s].

    Returns:
        The calibration, dated today, with the PPM frame of the port's calibration.

    Raises:
        InputError: no pulses come, a stick is not held still or was not moved as instructed, or the
            board is configured for another order.
    """
    readings = {}
    for name, what, sticks in POSES:
        operator.hold(what, sticks)
        readings[name] = read_steady_channels(port, pause)
    found = assign_channels(readings)
    if port.status is None:
        raise InputError(
            "calibrate: expected a STATUS from the board, got none; call wait_ready first"
        )
    channels = len(port.status.channels_us)
    beyond = {name: stick.channel for name, stick in found.items() if stick.channel > channels}
    if beyond:
        raise InputError(
            f"calibrate: expected sticks in the board's channels 1 to {channels}, got {beyond}; "
            "change the radio's channel order"
        )
    calibration = replace(
        port.calibration,
        radio=radio,
        measured=date.today().isoformat(),
        channels=channels,
        throttle=found["throttle"],
        aileron=found["aileron"],
        elevator=found["elevator"],
        rudder=found["rudder"],
    )
    require_matching_calibration(calibration, port.status)
    return calibration


def read_steady_channels(
    port: TrainerPort, pause: Callable[[float], object] = time.sleep
) -> tuple[int, ...]:
    """The pulse widths of sticks held still: (n,) medians over HOLD_S [us].

    Raises:
        InputError: no pulses come, or the sticks are not held still.
    """
    frames: list[tuple[int, ...]] = []
    for _ in range(HOLDS):
        port.poll()
        port.pilots.clear()
        end = port.now() + HOLD_S
        while port.now() < end:
            pause(0.01)
            port.poll()
        frames = [pilot.channels_us for pilot in port.pilots]
        if len(frames) > 5 and len(set(map(len, frames))) == 1:
            # the first two may have begun before the sticks were in place
            channels = list(zip(*frames[2:], strict=True))
            if all(max(us) - min(us) <= STILL_US for us in channels):
                return tuple(round(median(us)) for us in channels)
    if not frames:
        raise InputError(
            "calibrate: expected the radio's pulses at the board's pilot input (pin 49), got none; "
            "switch the radio on, set its trainer port to output PPM, check the cable"
        )
    raise InputError(
        f"calibrate: expected sticks held still to {STILL_US} us, got more, {HOLDS} times; "
        "start again"
    )


def assign_channels(readings: Mapping[str, Sequence[int]]) -> dict[str, Stick]:
    """Channel, end points, centre and direction of each stick.

    Args:
        readings: (n,) [us] by the name of each of POSES.

    Returns:
        A stick for each of COMMAND_NAMES; half throttle is the mean of its end points.

    Raises:
        InputError: no channel moved enough, or more than one did.
    """
    found = {}
    for name in COMMAND_NAMES:
        up, rest = readings[f"{name} +"], readings["rest"]
        down = readings.get(f"{name} -", rest)
        travel = [abs(a - b) for a, b in zip(up, down, strict=True)]
        largest, *others = sorted(travel, reverse=True)
        channel = travel.index(largest)
        if largest < MIN_TRAVEL_US:
            raise InputError(
                f"{name}: expected {MIN_TRAVEL_US} us of travel, got {largest}; move it all the way"
            )
        if others and largest < CLEAR * others[0]:
            raise InputError(
                f"{name}: expected one channel to move, got two, by {largest} and {others[0]} us; "
                "move one stick only, and switch mixes, rates and flight modes off"
            )
        low, high = sorted((up[channel], down[channel]))
        centre = rest[channel] if f"{name} -" in readings else round((low + high) / 2)
        try:
            is_reversed = up[channel] < down[channel]
            found[name] = Stick(channel + 1, low, centre, high, reversed=is_reversed)
        except InputError as error:
            raise InputError(f"{name}: {error}") from None
    return found


def choose_calibration(
    port: str, path: Path | None = None, radio: str = "", today: date | None = None
) -> Calibration:
    """The calibration to use; a stale one is refused.

    Args:
        port: its name; a simulated radio's calibration is for simulated boards only.
        path: the file; None takes ./trainer_port.toml if it exists, else the kit's default with a
            warning, as for a file without a date.
        radio: the radio that it must be of; "" accepts any.
        today: None is the current date.

    Raises:
        FileNotFoundError: there is no file at the path.
        InputError: the file is not a calibration, or a stale one: of another radio, of another PPM
            frame than the firmware's, or older than MAX_AGE_DAYS.
    """
    shipped = load_calibration()
    if path is None and not DEFAULT.is_file():
        if radio:
            raise InputError(
                f"--radio {radio}: expected a calibration measured on it in ./{DEFAULT}, found"
                " none; run falconwing calibrate, or give its file by --calibration"
            )
        warn(
            "the calibration is the kit's default, not measured on a radio; "
            "before a flight: falconwing calibrate",
            stacklevel=2,
        )
        return shipped
    path = path or DEFAULT
    calibration = load_calibration(path)
    # The board reports its number of channels (checked on connection), but not its PPM frame.
    frame = {name: getattr(calibration, name) for name in ("frame_us", "gap_us", "polarity")}
    firmware = {name: getattr(shipped, name) for name in frame}
    if frame != firmware:
        other = {
            name: (frame[name], firmware[name]) for name in frame if frame[name] != firmware[name]
        }
        stale = ", ".join(
            f"{name} {old} where the firmware's is {new}" for name, (old, new) in other.items()
        )
    elif radio and radio != calibration.radio:
        stale = f"measured on {calibration.radio or 'no radio'}, not on {radio}"
    elif calibration.radio == SIMULATED_RADIO.radio and port not in SIMULATED_PORTS:
        stale = f"of a {calibration.radio}"
    else:
        age = (
            ((today or date.today()) - date.fromisoformat(calibration.measured)).days
            if calibration.measured
            else 0
        )
        stale = f"{age} days old" if not 0 <= age <= MAX_AGE_DAYS else ""
    if stale:
        raise InputError(
            f"{path}: expected a calibration of this radio and firmware, not older than "
            f"{MAX_AGE_DAYS} days, got a stale one: {stale}; run falconwing calibrate"
        )
    if not calibration.measured:
        warn(
            f"{path}: no date of measurement; before a flight: falconwing calibrate",
            stacklevel=2,
        )
    return calibration
