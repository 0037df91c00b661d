"""falconwing calibrate: a person moves one stick after the other -> which slot it is, its ends and
its direction.

A calibration is a small TOML file in the folder where you work, ./trainer_port.toml, in plain view
beside your logs. The verbs that use a port take it from there, or from where --calibration says.
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
MAX_AGE_DAYS = 180  # trims and plugs change; a term later it is measured again
HOLD_S, HOLDS = 0.6, 5  # how long a stick is held for a reading, and how often that may be tried
STILL_US = 12  # a stick that is held moves less
MIN_TRAVEL_US = 250  # between a stick's ends
CLEAR = 3.0  # the stick that was moved moves so many times more than any other
POSES: tuple[
    tuple[str, str, Command], ...
] = (  # name, what to tell the person, where the sticks are then
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
# the SIMULATED radio: all but the throttle's channel differs from the kit's default
REHEARSED = Calibration(
    "SIMULATED radio", "", 4, 22000, 400, 1,
    throttle=Stick(1, 1080, 1490, 1900), aileron=Stick(4, 1105, 1512, 1910, reversed=True),
    elevator=Stick(2, 1090, 1487, 1895), rudder=Stick(3, 1110, 1520, 1920, reversed=True),
)  # fmt: skip


class Operator(Protocol):
    """Who holds the sticks."""

    def hold(self, what: str, sticks: Command) -> None:
        """Bring the sticks where the text says; return when they are held there."""


class KeyboardOperator:
    """Somebody who reads and presses Enter."""

    def hold(self, what: str, sticks: Command) -> None:
        """Ask, and wait for Enter."""
        print(f"  {what}; hold it and press Enter ", end="", file=sys.stderr, flush=True)
        if not sys.stdin.readline():
            raise InputError(
                "calibrate: expected somebody at the keyboard who presses Enter, got the end of the input"
            )


@dataclass(frozen=True)
class SimulatedOperator:
    """A SIMULATED person with a SIMULATED radio, for --port sim."""

    port: TrainerPort
    radio: Calibration = REHEARSED

    def hold(self, what: str, sticks: Command) -> None:
        """Hold them at once."""
        print(f"  {what} (SIMULATED)", file=sys.stderr)
        if self.port.simulation is not None:
            with self.port.simulation.pause() as board:
                board.set_pilot(self.radio.channels_us(sticks))


@dataclass(frozen=True)
class Calibrate:
    """Learn the microseconds, order and directions of your radio's sticks from the pilot input of
    the board.

    Propeller off. One stick after the other is moved as you are told. With --port sim it is
    rehearsed.
    """

    port: str
    """serial port of the trainer bridge, or sim"""
    radio: str = ""
    """your radio, such as "Spektrum NX8"; stands in the file, so that no other one's is taken for
    it
    """
    out: Path = DEFAULT
    """the file to write; other verbs look for trainer_port.toml in the folder where you are"""
    replace: bool = False
    """write over an older file"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Ask, measure and write the file.

        Returns:
            0: the file is written.

        Raises:
            InputError: the port does not answer, a stick was not moved as told, or the file may not
                be written.
        """
        require_writable_path(self.out)
        if self.out.exists() and not self.replace:
            raise InputError(
                f"{self.out}: expected a new file, there is one; add --replace to write over it"
            )
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
            calibration = measure_calibration(port, operator, self.radio or REHEARSED.radio)
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
        next_line(
            f"falconwing bridge --port {self.port}, and see that every stick goes the right way"
        )


def measure_calibration(
    port: TrainerPort, operator: Operator, radio: str, pause: Callable[[float], object] = time.sleep
) -> Calibration:
    """Read the sticks in every pose and make a calibration of it.

    Args:
        port: ready; its pilot input is read.
        person: moves the sticks.
        radio: its name, for the file.
        pause: lets time pass [s].

    Returns:
        The calibration, measured today; the PPM frame is the one that the port's calibration has.

    Raises:
        InputError: no pulses come, a stick is not held still or was not moved as told, or the board
            is set for another order.
    """
    readings = {}
    for name, what, sticks in POSES:
        operator.hold(what, sticks)
        readings[name] = read_steady_channels(port, pause)
    found = assign_channels(readings)
    if port.status is None:
        raise InputError(
            "calibrate: expected a board that answers, got no STATUS; call wait_ready first"
        )
    channels = len(port.status.channels_us)
    beyond = {name: stick.channel for name, stick in found.items() if stick.channel > channels}
    if beyond:
        raise InputError(
            f"calibrate: expected the sticks in channels 1 to {channels}, as many as the board sends, got {beyond}; "
            "change the radio's order of channels"
        )
    calibration = replace(
        port.calibration, radio=radio, measured=date.today().isoformat(), channels=channels,
        throttle=found["throttle"], aileron=found["aileron"], elevator=found["elevator"], rudder=found["rudder"],
    )  # fmt: skip
    require_matching_calibration(calibration, port.status)
    return calibration


def read_steady_channels(
    port: TrainerPort, pause: Callable[[float], object] = time.sleep
) -> tuple[int, ...]:
    """The microseconds of sticks that are held.

    Args:
        port: ready.
        pause: lets time pass [s].

    Returns:
        (n,) medians over HOLD_S [us].

    Raises:
        InputError: no pulses come, or the sticks do not keep still.
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
            channels = list(
                zip(*frames[2:], strict=True)
            )  # the first may have begun before the sticks were there
            if all(max(us) - min(us) <= STILL_US for us in channels):
                return tuple(round(median(us)) for us in channels)
    if not frames:
        raise InputError(
            "calibrate: expected the radio's pulses at the board's pilot input (pin 49), got none; is the radio on, is its "
            "trainer port set to give PPM, is the cable in?"
        )
    raise InputError(
        f"calibrate: expected sticks held still to {STILL_US} us, got more, {HOLDS} times; begin again"
    )


def assign_channels(readings: Mapping[str, Sequence[int]]) -> dict[str, Stick]:
    """Which slot each stick is, its ends, its centre and its direction.

    Args:
        readings: (n,) [us] for the name of each of POSES.

    Returns:
        A stick for each of COMMAND_NAMES; half throttle is taken to lie in the middle between its
        ends.

    Raises:
        InputError: no slot moved enough, or more than one did.
    """
    found = {}
    for name in COMMAND_NAMES:
        up, rest = readings[f"{name} +"], readings["rest"]
        down = readings.get(f"{name} -", rest)
        travel = [abs(a - b) for a, b in zip(up, down, strict=True)]
        most, *others = sorted(travel, reverse=True)
        slot = travel.index(most)
        if most < MIN_TRAVEL_US:
            raise InputError(
                f"{name}: expected {MIN_TRAVEL_US} us from end to end, got {most}; move it all the way"
            )
        if others and most < CLEAR * others[0]:
            raise InputError(
                f"{name}: expected one channel to move, got two, by {most} and {others[0]} us; "
                "move one stick alone, and turn mixes, rates and flight modes off"
            )
        low, high = sorted((up[slot], down[slot]))
        centre = rest[slot] if f"{name} -" in readings else round((low + high) / 2)
        try:
            found[name] = Stick(slot + 1, low, centre, high, reversed=up[slot] < down[slot])
        except InputError as error:
            raise InputError(f"{name}: {error}") from None
    return found


def choose_calibration(
    port: str, path: Path | None = None, radio: str = "", today: date | None = None
) -> Calibration:
    """The calibration to fly with; a stale one is refused.

    Args:
        port: what it is for; a simulated radio's is for simulated boards alone.
        path: the file; None takes ./trainer_port.toml where there is one, else the kit's default,
            with a warning, as for a file without a date.
        radio: must be the one it was measured on; "" does not ask.
        today: for tests; None is today.

    Raises:
        FileNotFoundError: there is no file at the path.
        InputError: the file is no calibration, or a stale one: of another radio, of another PPM
            frame than the kit's firmware has, or older than MAX_AGE_DAYS.
    """
    shipped = load_calibration()
    if path is None and not DEFAULT.is_file():
        warn(
            "the calibration is the kit's default, measured on no radio; before a flight: falconwing calibrate",
            stacklevel=2,
        )
        return shipped
    path = path or DEFAULT
    calibration = load_calibration(path)
    # How many channels it has, the board itself will say (require_fit); of its frame it says
    # nothing.
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
    elif calibration.radio == REHEARSED.radio and port not in SIMULATED_PORTS:
        stale = f"rehearsed with a {calibration.radio}"
    else:
        age = (
            ((today or date.today()) - date.fromisoformat(calibration.measured)).days
            if calibration.measured
            else 0
        )
        stale = f"{age} days old" if not 0 <= age <= MAX_AGE_DAYS else ""
    if stale:
        raise InputError(f"{path}: expected a calibration of this radio and firmware, not older than {MAX_AGE_DAYS} days, "
                         f"got one that is stale: {stale}; type falconwing calibrate")  # fmt: skip
    if not calibration.measured:
        warn(
            f"{path}: it does not say when it was measured; before a flight: falconwing calibrate",
            stacklevel=2,
        )
    return calibration
