"""falconwing firmware: build the board's program, or test it in a simulated chip.

The checks of `firmware test` use only the board's serial line and pins. They run in virtual time on
the program that is flashed.
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

# bytes; the chip has 248 KiB besides the boot loader, and 8 KiB
FLASH_BUDGET, RAM_BUDGET = 16 * 1024, 2 * 1024
SAFE_US, FLOWN_US = (1000, 1500, 1500, 1500), (1300, 1600, 1450, 1700)
PERIOD = 0.05  # s between commands
COMMAND_MS, LOSS_MS = 30, 225  # maximum delay command -> pin, last command -> safe pin
# Maximum delay from a stick of the pilot to the safe pin: the radio's frame that is on the wire,
# the one that carries the stick, and a frame of the board.
TAKE_OVER_MS = 66


@dataclass(frozen=True)
class Firmware:
    """Build the board's program, or test it in a simulated chip; neither needs hardware.

    Exit code 0 if the program fits its memory budget, or every check passed; else 1.
    """

    action: Annotated[Literal["build", "test"], tyro.conf.Positional]
    """build: write the program and print how to flash it; test: run it through a list of checks"""
    out: Path = Path("firmware_build")
    """folder for the program"""
    json: bool = False
    """print JSON instead of a table"""

    def run(self) -> int:
        """Build or test.

        Returns:
            0 if the program fits or all checks passed, else 1.

        Raises:
            InputError: a tool is missing (the message names the Debian package), or a file cannot
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
            "to flash it: open firmware/trainer_bridge in the Arduino IDE, board Mega 2560, "
            "propeller off; or"
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
        print_table(
            ("check", "result", "measured"), rows, title=f"SIMULATED: {SimulatedBoard.kind}"
        )
        next_line(
            "flash it, propeller off, and falconwing find-port"
            if passed
            else "fix firmware/trainer_bridge"
        )
        return 0 if passed else 1


@dataclass(frozen=True)
class FirmwareCheckResult:
    """Result of one check."""

    check: str  # requirement
    passed: bool
    seen: str


class RequirementError(Exception):
    """A requirement is not met; the text is what was measured."""


class BoardTestBench:
    """A board on the bench: sends commands, collects its messages and PPM frames."""

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
        """Advance virtual time and read what the board sent."""
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
        """Send a command with the next sequence number and advance time."""
        self.sequence, self.sent_at = self.sequence + 1, self.board.t
        self.board.write(encode_channels(self.sequence, channels_us, engage))
        self.run(seconds)

    def fly(self) -> None:
        """Engage at idle and neutral, then fly until the board follows."""
        self.ask(SAFE_US)
        for _ in range(7):
            self.send(True)
        self.expect("ACTIVE")

    def ask(self, channels_us: Sequence[int]) -> None:
        """The rising edge of `engage` and five commands."""
        self.send(False, channels_us)
        for _ in range(5):
            self.send(True, channels_us)

    def expect(self, state: str, fault: str = "none") -> Status:
        """The next STATUS; RequirementError unless it has this state and fault."""
        self.run(PERIOD + 0.005)
        status = self.status
        if status is None:
            raise RequirementError("no STATUS")
        if (status.state, status.fault) != (state, fault):
            raise RequirementError(
                f"expected {state} (fault {fault}), got {status.state} (fault {status.fault})"
            )
        return status

    def first_frame(self, since: float, channels_us: Sequence[int]) -> float:
        """Start of the first frame with these channels after a time [ms since then]."""
        for frame in self.frames:
            if frame.t_start >= since and np.abs(frame.slots_us - channels_us).max() <= 1.0:
                return 1e3 * (frame.t_start - since)
        raise RequirementError(f"no frame with {tuple(channels_us)} us")


def starts_safe(bench: BoardTestBench) -> str:
    """After power-on the motor is idle and the controls are neutral."""
    status = bench.expect("SAFE")
    bench.first_frame(0.0, SAFE_US)
    return f"{status.state}, channels {status.channels_us} us"


def pulses_are_exact(bench: BoardTestBench) -> str:
    """Frame length, channels and sync pulses are exact to 1 us while commands change."""
    calibration = load_calibration()
    bench.fly()
    for k in range(40):
        bench.send(True, [us + k % 7 for us in FLOWN_US])
    whole = np.array([np.abs(f.slots_us - np.round(f.slots_us)).max() for f in bench.frames])
    gaps = np.concatenate([f.gap_us for f in bench.frames]) - calibration.gap_us
    lengths = np.array([f.frame_us for f in bench.frames[:-1]]) - calibration.frame_us
    worst = max(float(np.abs(values).max()) for values in (whole, gaps, lengths))
    return require_within(
        f"maximum error {worst:.2f} us in {len(bench.frames)} frames", worst <= 1.0
    )


def engages_after_edge_and_five_frames(bench: BoardTestBench) -> str:
    """The board engages only after the rising edge of `engage` plus five valid frames."""
    for _ in range(20):
        bench.send(True, SAFE_US)
    bench.expect("SAFE")
    bench.send(False, SAFE_US)
    for _ in range(4):
        bench.send(True, SAFE_US)
    bench.expect("SAFE")
    for _ in range(3):
        bench.send(True, SAFE_US)
    bench.expect("ACTIVE")
    return "ACTIVE after the rising edge and five frames, not before"


def without_a_pilot_only_idle_engages(bench: BoardTestBench) -> str:
    """No signal on the pilot pin: throttle or a deflected stick does not engage."""
    if bench.expect("SAFE").engages_without_pilot:
        raise RequirementError("compiled with ENGAGE_WITHOUT_PILOT")
    for channels_us in (FLOWN_US, (1050, 1500, 1500, 1500), (1000, 1500, 1650, 1500)):
        bench.ask(channels_us)
        bench.expect("SAFE")
    bench.ask(SAFE_US)
    bench.expect("ACTIVE")
    return "SAFE at throttle 1050 us and more, ACTIVE at idle and neutral"


def engages_near_the_pilots_sticks(bench: BoardTestBench) -> str:
    """With a signal on the pilot pin only commands within 100 us of the sticks engage."""
    bench.board.set_pilot(FLOWN_US)
    bench.run(0.3)
    for channel in range(len(FLOWN_US)):
        ours = list(FLOWN_US)
        ours[channel] -= 110
        bench.ask(ours)
        bench.expect("SAFE")
    bench.ask(SAFE_US)
    bench.expect("SAFE")
    bench.ask([us + 90 for us in FLOWN_US])
    if not bench.expect("ACTIVE").has_pilot:
        raise RequirementError("STATUS does not show the pilot's signal")
    return "SAFE 110 us away, ACTIVE 90 us away"


def pilots_stick_takes_over(bench: BoardTestBench) -> str:
    """A stick of the pilot moved by more than 12 % is SAFE, however the host insists."""
    delays = []
    for channel in range(len(FLOWN_US)):
        bench.board.set_pilot(FLOWN_US)
        bench.run(0.3)
        bench.ask(FLOWN_US)
        bench.expect("ACTIVE")
        moved, start = list(FLOWN_US), bench.board.t
        moved[channel] += 125
        bench.board.set_pilot(moved)
        bench.run(0.004 * channel)
        for _ in range(4):
            bench.send(True)
        if not bench.expect("SAFE").pilot_took_over:
            raise RequirementError("STATUS does not name the pilot")
        delays.append(bench.first_frame(start, SAFE_US))
    return require_within(
        f"safe channels within {max(delays):.0f} ms of the stick", max(delays) <= TAKE_OVER_MS
    )


def commands_reach_the_pin(bench: BoardTestBench) -> str:
    """Delay from a command's first byte to the first edge of the frame that carries it."""
    bench.fly()
    delays: list[float] = []
    for k in range(40):
        channels, start = [us + 2 + k for us in FLOWN_US], bench.board.t
        bench.send(True, channels, 0.0576)  # 2.62 frames: covers all phases
        delays.append(bench.first_frame(start, channels))
    return require_within(
        f"{np.percentile(delays, 95):.1f} ms (95 %), {max(delays):.1f} ms maximum",
        max(delays) <= COMMAND_MS,
    )


def host_loss_is_safe(bench: BoardTestBench) -> str:
    """Without commands the outputs become safe."""
    bench.fly()
    bench.send(True, seconds=0.4)
    bench.expect("LOST")
    delay = bench.first_frame(bench.sent_at, SAFE_US)
    return require_within(f"safe channels {delay:.0f} ms after the last command", delay <= LOSS_MS)


def hung_program_is_safe(bench: BoardTestBench) -> str:
    """If loop() hangs, the watchdog restarts the board, and commands do not re-engage it."""
    bench.fly()
    last = bench.sent_at
    bench.board.hang()
    for _ in range(16):
        bench.send(True)
    status = bench.expect("FAULT", "stall")
    delay = bench.first_frame(last, SAFE_US)
    return require_within(
        f"safe channels after {delay:.0f} ms, then {status.state}, "
        f"boot by {' and '.join(status.reset_causes)}",
        delay <= LOSS_MS,
    )


def disengage_is_immediate(bench: BoardTestBench) -> str:
    """One frame with engage=0 returns control to the pilot."""
    bench.fly()
    start = bench.board.t
    bench.send(False)
    bench.expect("SAFE")
    delay = bench.first_frame(start, SAFE_US)
    return require_within(f"safe channels after {delay:.1f} ms", delay <= COMMAND_MS)


def damaged_frames_are_rejected(bench: BoardTestBench) -> str:
    """Frames with one to four flipped bits are rejected."""
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


def old_sequences_are_rejected(bench: BoardTestBench) -> str:
    """A stuck or replayed sequence number does not count as a command."""
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
    """Five commands with 2200 us within a second raise a range fault."""
    bench.fly()
    for _ in range(5):
        bench.send(True, (1300, 2200, 1450, 1700))
    status = bench.expect("FAULT", "range")
    bench.first_frame(bench.board.t - 0.05, SAFE_US)
    return f"FAULT after {status.out_of_range}, safe channels"


def pilot_is_measured(bench: BoardTestBench) -> str:
    """A radio's pulses on the pilot pin are reported in microseconds."""
    given = (1111, 1502, 1893, 1234)
    bench.board.set_pilot(given)
    bench.run(1.0)
    if len(bench.pilots) < 20:
        raise RequirementError(
            f"expected 40 frames of the pilot in a second, got {len(bench.pilots)}"
        )
    worst = int(np.abs(np.array([pilot.channels_us for pilot in bench.pilots]) - given).max())
    return require_within(f"maximum error {worst} us in {len(bench.pilots)} frames", worst <= 1)


def clock_is_reported(bench: BoardTestBench) -> str:
    """SYNC is answered with the board's time, which runs at the host's rate."""
    for token in (7, 8):
        bench.board.write(encode_sync(token))
        bench.run(0.5)
    if [reply.token for reply in bench.replies] != [7, 8]:
        raise RequirementError(
            f"answers to tokens 7 and 8: {[reply.token for reply in bench.replies]}"
        )
    passed: Array = np.diff([reply.received_us for reply in bench.replies])
    return require_within(f"{passed[0] / 1e3:.2f} ms in 500 ms", abs(float(passed[0]) - 5e5) < 2e3)


def require_within(measured: str, ok: bool) -> str:
    """The measured value as text; RequirementError unless it is ok."""
    if not ok:
        raise RequirementError(measured)
    return measured


def run_check(
    name: str, check: Callable[[BoardTestBench], str], make_board: Callable[[], Board]
) -> FirmwareCheckResult:
    """Run one check on a board after power-on."""
    board = make_board()
    try:
        return FirmwareCheckResult(name, True, check(BoardTestBench(board)))
    except (RequirementError, RuntimeError) as error:
        return FirmwareCheckResult(name, False, str(error))
    finally:
        board.close()


def program_sizes(elf: Path) -> tuple[int, int]:
    """Bytes of flash (text + data) and of static RAM (data + bss) of a program, by avr-size."""
    sizes = _output(["avr-size", str(elf)]).splitlines()[1].split()
    text, data, bss = (int(size) for size in sizes[:3])
    return text + data, data + bss


def write_hex(elf: Path) -> Path:
    """Write the program as Intel hex, the format of flashing tools, beside it."""
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
            f"{command[0]}: expected the program, found none; "
            "Debian or Ubuntu: apt install binutils-avr"
        )
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise InputError(
            f"{command[0]}: expected it to succeed, got: {done.stderr.strip()}; "
            "check the free disk space"
        )
    return done.stdout


CHECKS: tuple[tuple[str, Callable[[BoardTestBench], str]], ...] = (
    ("starts SAFE with the motor idle", starts_safe),
    ("pulses and frames to 1 us", pulses_are_exact),
    (
        "engages only after the rising edge plus five valid frames",
        engages_after_edge_and_five_frames,
    ),
    ("no pilot measured: engages at idle and neutral only", without_a_pilot_only_idle_engages),
    ("engages near the measured sticks only", engages_near_the_pilots_sticks),
    (f"a stick moved by 12 %: safe within {TAKE_OVER_MS} ms", pilots_stick_takes_over),
    (f"a command is on the pin within {COMMAND_MS} ms", commands_reach_the_pin),
    (f"no commands: safe within {LOSS_MS} ms", host_loss_is_safe),
    (f"program hangs: safe within {LOSS_MS} ms", hung_program_is_safe),
    (f"disengaged: safe within {COMMAND_MS} ms", disengage_is_immediate),
    ("damaged frames are rejected", damaged_frames_are_rejected),
    ("stuck and old sequences are rejected", old_sequences_are_rejected),
    ("commands out of range: FAULT", out_of_range_is_a_fault),
    ("the pilot's pulses to 1 us", pilot_is_measured),
    ("board clock reported correctly", clock_is_reported),
)
