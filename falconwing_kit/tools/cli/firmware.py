"""falconwing firmware: the sketch -> a program for the board and its size; or that program, tried
in a simulated chip.

The checks of `firmware test` ask a board what the firmware promises, by its serial line and its
pins alone. They run in virtual time on the very program that is flashed.
"""

import random
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.files import atomic_write
from falconwing_kit.tools.bridge.python_board import Board, PpmFrame
from falconwing_kit.tools.cli.show import next_line, print_json, print_table
from falconwing_kit.trainer_port.ppm import load_calibration
from falconwing_kit.trainer_port.protocol import (
    Deframer,
    PilotFrame,
    Status,
    SyncReply,
    encode_channels,
    encode_sync,
)

FLASH_BUDGET, RAM_BUDGET = (
    16 * 1024,
    2 * 1024,
)  # bytes; the chip has 248 KiB beside the boot loader, and 8 KiB
SAFE_US, FLOWN_US = (1000, 1500, 1500, 1500), (1300, 1600, 1450, 1700)
PERIOD = 0.05  # s between commands
NEW, OLD = (
    30,
    225,
)  # ms: a command is on the pin by then; after the last command the pin is safe by then


@dataclass(frozen=True)
class Firmware:
    """Build the board's program, or try it in a simulated chip: no hardware is needed for either.

    Exit code 0 when it was built within its budget of memory, or every check passed; else 1.
    """

    action: Annotated[Literal["build", "test"], tyro.conf.Positional]
    """build: write the program and say how to flash it; test: run it through a list of checks"""
    out: Path = Path("firmware_build")
    """folder for the program"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Build or test.

        Returns:
            0 where it fits and works, else 1.

        Raises:
            InputError: a tool is missing; the sentence names the Debian package. Or a file cannot
                be written.
        """
        return self._build() if self.action == "build" else self._test()

    def _build(self) -> int:
        from falconwing_kit.tools.bridge.build import build_firmware

        if self.out.exists() and not self.out.is_dir():
            raise InputError(
                f"--out {self.out}: expected a folder, got a file; choose another name"
            )
        elf = build_firmware()
        self.out.mkdir(parents=True, exist_ok=True)
        program = self.out / "trainer_bridge.elf"
        with atomic_write(program) as file:
            file.write(elf.read_bytes())
        flash, ram = program_sizes(program)
        hexfile = write_hex(program)
        fits = flash < FLASH_BUDGET and ram < RAM_BUDGET
        record = {
            "elf": str(program),
            "hex": str(hexfile),
            "flash_bytes": flash,
            "ram_bytes": ram,
            "fits": fits,
        }
        if self.json:
            print_json(record)
            return 0 if fits else 1
        rows = [("flash", flash, FLASH_BUDGET), ("static RAM", ram, RAM_BUDGET)]
        print_table(("memory", "bytes", "budget"), rows, title=f"{program} and {hexfile.name}")
        print(
            "to flash it: open firmware/trainer_bridge in the Arduino IDE, board Mega 2560, propeller off; or"
        )
        print(f"  avrdude -p atmega2560 -c wiring -b 115200 -D -P PORT -U flash:w:{hexfile}:i")
        next_line("falconwing firmware test")
        return 0 if fits else 1

    def _test(self) -> int:
        from falconwing_kit.tools.bridge.simulated_board import SimulatedBoard

        results = [run_check(name, check, SimulatedBoard) for name, check in CHECKS]
        passed = all(result.passed for result in results)
        if self.json:
            print_json(
                {
                    "board": SimulatedBoard.kind,
                    "passed": passed,
                    "checks": [asdict(r) for r in results],
                }
            )
            return 0 if passed else 1
        rows = [
            (result.check, "passed" if result.passed else "FAILED", result.seen)
            for result in results
        ]
        print_table(("check", "result", "seen"), rows, title=f"SIMULATED: {SimulatedBoard.kind}")
        next_line(
            "flash it, propeller off, and falconwing find-port"
            if passed
            else "mend firmware/trainer_bridge"
        )
        return 0 if passed else 1


@dataclass(frozen=True)
class FirmwareCheckResult:
    """What came out of one check."""

    check: str  # what the firmware promises
    passed: bool
    seen: str


class RequirementError(Exception):
    """The board did not do what it promises; the text says what it did."""


class BoardTestBench:
    """A board on the bench: commands in, what it says and sends collected."""

    def __init__(self, board: Board) -> None:
        self.board = board
        self._deframer = Deframer()
        self.sequence, self.sent_at = 0, 0.0  # of the last command; when it was sent [s]
        self.status: Status | None = None
        self.pilots: list[PilotFrame] = []
        self.replies: list[SyncReply] = []
        self.frames: list[PpmFrame] = []
        self.run(0.2)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        self.board.run_until(self.board.t + seconds)
        for message in self._deframer.feed(self.board.read()):
            if isinstance(message, Status):
                self.status = message
            elif isinstance(message, PilotFrame):
                self.pilots.append(message)
            elif isinstance(message, SyncReply):
                self.replies.append(message)
        self.frames += self.board.ppm_frames()

    def send(
        self, engage: bool, channels_us: Sequence[int] = FLOWN_US, seconds: float = PERIOD
    ) -> None:
        """One command with the next sequence, and time."""
        self.sequence, self.sent_at = self.sequence + 1, self.board.t
        self.board.write(encode_channels(self.sequence, channels_us, engage))
        self.run(seconds)

    def fly(self) -> None:
        """Until it follows."""
        self.send(False)
        for _ in range(12):
            self.send(True)
        self.expect("ACTIVE")

    def expect(self, state: str, fault: str = "none") -> Status:
        """The next STATUS, which must be of this state."""
        self.run(PERIOD + 0.005)
        status = self.status
        if status is None:
            raise RequirementError("no STATUS")
        if (status.state, status.fault) != (state, fault):
            raise RequirementError(
                f"{status.state} (fault {status.fault}), expected {state} (fault {fault})"
            )
        return status

    def first_frame(self, since: float, slots_us: Sequence[int]) -> float:
        """When the first frame with these slots began after a moment [ms since then]."""
        for frame in self.frames:
            if frame.t_start >= since and np.abs(frame.slots_us - slots_us).max() <= 1.0:
                return 1e3 * (frame.t_start - since)
        raise RequirementError(f"no frame with {tuple(slots_us)} us")


def starts_safe(bench: BoardTestBench) -> str:
    """Idle motor, neutral sticks, whatever was before."""
    status = bench.expect("SAFE")
    bench.first_frame(0.0, SAFE_US)
    return f"{status.state}, slots {status.channels_us} us"


def pulses_are_exact(bench: BoardTestBench) -> str:
    """Frame, slots and gap pulses to 1 us while commands change."""
    calibration = load_calibration()
    bench.fly()
    for k in range(40):
        bench.send(True, [us + k % 7 for us in FLOWN_US])
    whole = np.array([np.abs(f.slots_us - np.round(f.slots_us)).max() for f in bench.frames])
    gaps = np.concatenate([f.gap_us for f in bench.frames]) - calibration.gap_us
    lengths = np.array([f.frame_us for f in bench.frames[:-1]]) - calibration.frame_us
    worst = max(float(np.abs(values).max()) for values in (whole, gaps, lengths))
    return require_within(f"{worst:.2f} us off in {len(bench.frames)} frames", worst <= 1.0)


def follows_an_edge_and_five(bench: BoardTestBench) -> str:
    """Engage alone is not enough; nor are four frames after its edge."""
    for _ in range(20):
        bench.send(True)
    bench.expect("SAFE")
    bench.send(False)
    for _ in range(4):
        bench.send(True)
    bench.expect("SAFE")
    for _ in range(3):
        bench.send(True)
    bench.expect("ACTIVE")
    return "ACTIVE after the edge and five frames, not before"


def commands_reach_the_pin(bench: BoardTestBench) -> str:
    """From a command's first byte to the first edge of the frame that carries it."""
    bench.fly()
    delays: list[float] = []
    for k in range(40):
        slots, began = [us + 2 + k for us in FLOWN_US], bench.board.t
        bench.send(True, slots, 0.0576)  # 2 + 0.62 frames: every phase comes, in no order
        delays.append(bench.first_frame(began, slots))
    return require_within(
        f"{np.percentile(delays, 95):.1f} ms (95 %), {max(delays):.1f} ms at most",
        max(delays) <= NEW,
    )


def host_loss_is_safe(bench: BoardTestBench) -> str:
    """The last command, then silence."""
    bench.fly()
    bench.send(True, seconds=0.4)
    bench.expect("LOST")
    delay = bench.first_frame(bench.sent_at, SAFE_US)
    return require_within(f"safe slots {delay:.0f} ms after the last command", delay <= OLD)


def hung_program_is_safe(bench: BoardTestBench) -> str:
    """loop() hangs while commands go on; the watchdog restarts the board, and it does not fly on."""
    bench.fly()
    last = bench.sent_at
    bench.board.hang()
    for _ in range(16):
        bench.send(True)
    status = bench.expect("FAULT", "stall")
    delay = bench.first_frame(last, SAFE_US)
    return require_within(
        f"safe slots after {delay:.0f} ms, then {status.state}, boot by {' and '.join(status.reset_causes)}",
        delay <= OLD,
    )


def hand_back_is_at_once(bench: BoardTestBench) -> str:
    """One frame with engage=0."""
    bench.fly()
    began = bench.board.t
    bench.send(False)
    bench.expect("SAFE")
    delay = bench.first_frame(began, SAFE_US)
    return require_within(f"safe slots after {delay:.1f} ms", delay <= NEW)


def damaged_frames_are_refused(bench: BoardTestBench) -> str:
    """One to four bits of a good frame turned over; only frames that change nothing may pass."""
    draw, count = random.Random(1), 300
    before = bench.expect("SAFE").accepted
    for k in range(count):
        data = bytearray(encode_channels(k + 1, FLOWN_US, True))
        for bit in draw.sample(range(8 * (len(data) - 1)), draw.randint(1, 4)):
            data[bit // 8] ^= 1 << bit % 8
        bench.board.write(bytes(data))
        bench.run(0.003)
    status = bench.expect("SAFE")
    accepted = status.accepted - before
    return require_within(
        f"{accepted} of {count} accepted, {status.bad_frames} counted as bad", accepted == 0
    )


def old_sequences_are_refused(bench: BoardTestBench) -> str:
    """A stuck or replayed sequence keeps nothing alive."""
    bench.fly()
    before = bench.expect("ACTIVE").accepted
    for back in range(40):
        bench.board.write(encode_channels((bench.sequence - back // 2) % 65536, FLOWN_US, True))
        bench.run(0.01)
    status = bench.expect("LOST")
    return require_within(
        f"{status.accepted - before} of 40 accepted, then {status.state}", status.accepted == before
    )


def out_of_range_is_a_fault(bench: BoardTestBench) -> str:
    """Five commands with 2200 us within a second."""
    bench.fly()
    for _ in range(5):
        bench.send(True, (1300, 2200, 1450, 1700))
    status = bench.expect("FAULT", "range")
    bench.first_frame(bench.board.t - 0.05, SAFE_US)
    return f"FAULT after {status.out_of_range}, safe slots"


def pilot_is_measured(bench: BoardTestBench) -> str:
    """A radio's pulses on the pilot pin come back as microseconds."""
    given = (1111, 1502, 1893, 1234)
    bench.board.set_pilot(given)
    bench.run(1.0)
    if len(bench.pilots) < 20:
        raise RequirementError(
            f"{len(bench.pilots)} frames of the pilot in a second, expected 40 or more"
        )
    worst = int(np.abs(np.array([pilot.channels_us for pilot in bench.pilots]) - given).max())
    return require_within(f"{worst} us off in {len(bench.pilots)} frames", worst <= 1)


def clock_is_reported(bench: BoardTestBench) -> str:
    """SYNC is answered with the board's own time, which runs like ours."""
    for token in (7, 8):
        bench.board.write(encode_sync(token))
        bench.run(0.5)
    if [reply.token for reply in bench.replies] != [7, 8]:
        raise RequirementError(
            f"answers to tokens 7 and 8: {[reply.token for reply in bench.replies]}"
        )
    passed: Array = np.diff([reply.received_us for reply in bench.replies])
    return require_within(f"{passed[0] / 1e3:.2f} ms for 500", abs(float(passed[0]) - 5e5) < 2e3)


def require_within(seen: str, fine: bool) -> str:
    """What was seen, if it is fine."""
    if not fine:
        raise RequirementError(seen)
    return seen


def run_check(
    name: str, check: Callable[[BoardTestBench], str], make_board: Callable[[], Board]
) -> FirmwareCheckResult:
    """One check on a board that was just switched on."""
    board = make_board()
    try:
        return FirmwareCheckResult(name, True, check(BoardTestBench(board)))
    except (RequirementError, RuntimeError) as error:
        return FirmwareCheckResult(name, False, str(error))
    finally:
        board.close()


def program_sizes(elf: Path) -> tuple[int, int]:
    """Bytes of flash and of static RAM that a program takes, by avr-size: text and data; data and
    bss.
    """
    text, data, bss = (
        int(word) for word in _output(["avr-size", str(elf)]).splitlines()[1].split()[:3]
    )
    return text + data, data + bss


def write_hex(elf: Path) -> Path:
    """The program as the Intel hex that flashing tools want, beside it."""
    target = elf.with_suffix(".hex")
    part = elf.with_suffix(".hex.part")
    try:
        _output(["avr-objcopy", "-O", "ihex", "-R", ".eeprom", str(elf), str(part)])
        with atomic_write(target) as file:
            file.write(part.read_bytes())
    finally:
        part.unlink(missing_ok=True)
    return target


def _output(command: list[str]) -> str:
    if shutil.which(command[0]) is None:
        raise InputError(
            f"{command[0]}: expected it to be installed; Debian or Ubuntu: apt install binutils-avr"
        )
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise InputError(
            f"{command[0]}: expected it to do its work, got: {done.stderr.strip()}; is the disk full?"
        )
    return done.stdout


CHECKS: tuple[tuple[str, Callable[[BoardTestBench], str]], ...] = (
    ("starts SAFE with the motor idle", starts_safe),
    ("pulses and frames to 1 us", pulses_are_exact),
    ("follows after an edge and five frames only", follows_an_edge_and_five),
    (f"a command is on the pin within {NEW} ms", commands_reach_the_pin),
    (f"host silent: safe within {OLD} ms", host_loss_is_safe),
    (f"program hangs: safe within {OLD} ms", hung_program_is_safe),
    (f"hand-back: safe within {NEW} ms", hand_back_is_at_once),
    ("damaged frames are refused", damaged_frames_are_refused),
    ("stuck and old sequences are refused", old_sequences_are_refused),
    ("commands out of range: FAULT", out_of_range_is_a_fault),
    ("the pilot's pulses to 1 us", pilot_is_measured),
    ("the clock is told", clock_is_reported),
)
