"""Single bits of the simulated chip turned over at random -> what the radio and the host saw."""

import faulthandler
import json
import math
import os
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from falconwing_kit.tools.bridge.build import build_firmware
from falconwing_kit.tools.bridge.simulated_board import CLOCK_HZ
from falconwing_kit.tools.cli.firmware import program_sizes
from falconwing_kit.trainer_port.protocol import Status
from tests.firmware.chip import LOOP, SAFE, Bench, ProbedBoard

FLOWN = (1550, 1700, 1300, 1660)  # each channel more than 12 % of 1000 us from SAFE
SCENES = ("SAFE", "ACTIVE", "LOST")  # of the board when the bit is turned over
WATCHED_S = 0.4  # after a flip
MOVED_US = 120.0  # 12 %
BACK_S = 0.3  # the bound on the time without a frame that a radio takes
SLOT_US, PAUSE_US = (800.0, 2200.0), 3000.0  # what a radio takes for a slot, and for a pause
RAM_START, RAM_END, SPL = 0x200, 0x21FF, 0x5D
SIMULATOR_FAILED = "the simulator crashed"  # libsimavr with a program counter or address of nowhere
STACK_BELOW = 32  # bytes below the stack pointer that the next interrupt uses
# Registers that keep what was written (data sheet ATmega2560, register summary): ports and their
# directions, all timers, serial lines, interrupts, watchdog, sleep, power, bus and converter.
IO_REGISTERS = (
    *[a + k for a in range(0x21, 0x35, 3) for k in (0, 1)],
    *[a + k for a in range(0x101, 0x10C, 3) for k in (0, 1)],
    *range(0x6E, 0x74),  # interrupts of the timers
    *range(0x44, 0x49),  # timer 0
    *range(0x80, 0x8E),  # timer 1
    *range(0xB0, 0xB5),  # timer 2
    *range(0x90, 0x9E),  # timer 3
    *range(0xA0, 0xAE),  # timer 4
    *range(0x120, 0x12E),  # timer 5
    *(0xC0, 0xC1, 0xC2, 0xC4, 0xC5),  # serial line 0
    *(0xC8, 0xC9, 0xCA, 0xCC, 0xCD),  # serial line 1
    *(0xD0, 0xD1, 0xD2, 0xD4, 0xD5, 0x130, 0x131, 0x132, 0x134, 0x135),  # lines 2 and 3
    *(0x3D, 0x43, 0x50, 0x53, 0x55, 0x5B, 0x5C, SPL, SPL + 1, 0x5F),
    *(0x60, 0x64, 0x65, 0x68, 0x69, 0x6A, 0x6B, 0x6C, 0x6D, 0x7A, 0x7B, 0x7C, 0xBC),
)


@dataclass(frozen=True)
class Flip:
    """One bit turned over, and what followed within WATCHED_S."""

    scene: str
    place: str  # "registers", "I/O registers", "memory" or "stack"
    address: int
    bit: int
    t: float  # of the board [s]
    engaged: bool  # ACTIVE, or commands on the pin, in a scene that is not ACTIVE
    moved: bool  # two frames in a row with a channel off by more than 12 %
    without_s: float  # longest time without a frame that a radio takes
    state: str  # of the last STATUS; "" for none in WATCHED_S
    resets: int  # by the watchdog


def fly_flips(count: int, seed: int, elf: Path | None = None) -> list[Flip]:
    """So many single flips, a third in each scene, each in a process of its own that is thrown away
    afterwards, so that no flip meets an earlier one.
    """
    rng, elf = np.random.default_rng(seed), elf or build_firmware()
    memory_end = RAM_START + program_sizes(elf)[1]
    flips = []
    for number, scene in enumerate(SCENES):
        with ProbedBoard(elf) as board:
            host = Host(Bench(board), scene)
            for _ in range(number, count, len(SCENES)):
                host.run(rng.uniform(0.001, 0.03))
                place, address = draw_address(board, rng, memory_end)
                flip = in_fork(host, scene, place, address, int(rng.integers(8)))
                flips.append(again(elf, flip) if flip.state == SIMULATOR_FAILED else flip)
    return flips


def again(elf: Path, flip: Flip) -> Flip:
    """The same flip in a new simulator: whether libsimavr crashes at an address of nowhere depends
    on where its own memory lies.
    """
    with ProbedBoard(elf) as board:
        host = Host(Bench(board), flip.scene)
        host.run(flip.t - board.t)
        return in_fork(host, flip.scene, flip.place, flip.address, flip.bit)


def draw_address(board: ProbedBoard, rng: np.random.Generator, end: int) -> tuple[str, int]:
    """A byte of what the program lives in: half of the flips in its memory, a quarter in the I/O
    registers, an eighth each in the stack and in the working registers.
    """
    stack = board.peek(SPL) + 256 * board.peek(SPL + 1) - STACK_BELOW
    places = {
        "memory": range(RAM_START, end),
        "I/O registers": IO_REGISTERS,
        "stack": range(stack, RAM_END + 1),
        "registers": range(32),
    }
    place = str(rng.choice(list(places), p=(0.5, 0.25, 0.125, 0.125)))
    return place, int(rng.choice(places[place]))


class Host:
    """A host that goes on with its commands whatever the board does, and a pilot who holds still.

    In SAFE it sends engage=0, in ACTIVE and LOST engage=1, always FLOWN.
    """

    def __init__(self, bench: Bench, scene: str) -> None:
        self.bench, self.board, self.engage = bench, bench.board, scene != "SAFE"
        self.board.set_pilot(FLOWN)
        bench.wait(0.3)
        if self.engage:
            bench.fly(1, FLOWN, engage=False)
            bench.fly(6, FLOWN)
        if scene == "LOST":
            bench.wait(0.3)
        self._next = self.board.t
        self.run(0.2)
        assert bench.status().state == scene

    def run(self, seconds: float) -> None:
        """Commands every 50 ms while time passes."""
        end = self.board.t + seconds
        while self._next < end:
            self.bench.wait(max(self._next - self.board.t, 0.0))
            self.bench.send(FLOWN, self.engage)
            self._next += LOOP
        self.bench.wait(max(end - self.board.t, 0.0))


def in_fork(host: Host, scene: str, place: str, address: int, bit: int) -> Flip:
    """The flip and what follows in a copy of this process."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        faulthandler.disable()
        try:
            answer = json.dumps(asdict(watch_flip(host, scene, place, address, bit)))
            os.write(writer, answer.encode())
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        answer = pipe.read()
    os.waitpid(child, 0)
    if not answer:  # counts as no pulses for ever, though a chip would restart
        t = host.board.t
        return Flip(scene, place, address, bit, t, False, False, math.inf, SIMULATOR_FAILED, 0)
    return Flip(**json.loads(answer))


def watch_flip(host: Host, scene: str, place: str, address: int, bit: int) -> Flip:
    """Turn the bit over and watch pin and STATUS."""
    board, bench = host.board, host.bench
    take_falls(board)
    bench.messages.clear()
    start, resets = board.t, board.watchdog_resets
    board.flip(address, bit)
    host.run(WATCHED_S)
    starts, slots = read_frames(take_falls(board))
    off = np.abs(slots - SAFE).max(axis=1) > MOVED_US
    if scene == "ACTIVE":
        off &= np.abs(slots - FLOWN).max(axis=1) > MOVED_US
    states = [m.state for m in bench.messages if isinstance(m, Status)]
    moved = bool((off[1:] & off[:-1]).any())
    pauses = np.diff([start, *starts, board.t])
    return Flip(
        scene=scene,
        place=place,
        address=address,
        bit=bit,
        t=start,
        engaged=scene != "ACTIVE" and ("ACTIVE" in states or moved),
        moved=moved,
        without_s=float(pauses.max()),
        state=states[-1] if states else "",
        resets=board.watchdog_resets - resets,
    )


def take_falls(board: ProbedBoard) -> np.ndarray:
    """Times [s] at which the pin went low since the last call: the starts of the pulses."""
    at, levels, falls = np.empty(4096, np.uint64), np.empty(4096, np.uint8), []
    while count := board._sim.sim_take_edges(board._handle, at, levels, 4096):
        falls += at[:count][levels[:count] == 0].tolist()
    return np.array(falls, dtype=float) / CLOCK_HZ


def read_frames(falls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As a radio reads them: starts [s] and (n, 4) slots [us] of the whole frames of four slots."""
    gaps = 1e6 * np.diff(falls)
    pauses = np.flatnonzero(gaps > PAUSE_US)
    frames = []
    for first, last in zip([-1, *pauses], [*pauses, len(gaps)], strict=True):
        slots = gaps[first + 1 : last]
        if len(slots) == 4 and np.all((slots >= SLOT_US[0]) & (slots <= SLOT_US[1])):
            frames.append((falls[first + 1], slots))
    return np.array([f[0] for f in frames]), np.array([f[1] for f in frames]).reshape(-1, 4)


def table(flips: list[Flip]) -> str:
    """The figures, one line for each place."""
    lines = [
        f"{'place':14} {'flips':>6} {'engaged':>7} {'moved':>5} {'no pulses for 300 ms':>20} "
        f"{'simulator crashed':>17} {'restarts':>8} {'longest pause':>13}"
    ]
    for place in (*Counter(flip.place for flip in flips), "all"):
        some = [flip for flip in flips if place in (flip.place, "all")]
        crashed = sum(flip.state == SIMULATOR_FAILED for flip in some)
        late = sum(flip.without_s > BACK_S for flip in some) - crashed
        longest = max(flip.without_s for flip in some if flip.state != SIMULATOR_FAILED)
        lines.append(
            f"{place:14} {len(some):6} {sum(f.engaged for f in some):7} "
            f"{sum(f.moved for f in some):5} {late:20} {crashed:17} "
            f"{sum(f.resets > 0 for f in some):8} {1e3 * longest:10.0f} ms"
        )
    return "\n".join(lines)
