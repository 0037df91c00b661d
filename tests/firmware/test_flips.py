"""Disturbed bits of the chip: of 500 none engages or moves the aircraft, and pulses come back; and
each guard by itself.
"""

import re
import subprocess
from itertools import pairwise

import numpy as np
import pytest

from falconwing_kit.tools.bridge.build import build_firmware, firmware_folder
from falconwing_kit.trainer_port.protocol import PilotFrame
from tests.firmware.chip import SAFE, Bench, ProbedBoard, is_safe, require_tools
from tests.firmware.flips import (
    BACK_S,
    FLOWN,
    Host,
    fly_flips,
    read_frames,
    table,
    take_falls,
    watch_flip,
)

FLIPS, SEED = 500, 20
DDRB, TIMSK0, TCCR0A, TCCR0B, TIMSK1, TCCR1B, TIMSK3, TIMSK4, TCCR4A, TCCR4B, SMCR = (
    *(0x24, 0x6E, 0x44, 0x45, 0x6F, 0x81, 0x71, 0x72, 0xA0, 0xA1, 0x53),
)  # data sheet ATmega2560, register summary


def address_of(name: str) -> int:
    """Where a variable of the program is in the chip's memory, by its symbol table."""
    command = ["avr-nm", str(build_firmware())]
    symbols = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return int(re.search(rf"^00(80\w{{4}}) \w {name}$", symbols, re.MULTILINE)[1], 16) - 0x800000


@pytest.mark.timeout(300)
def test_of_500_flipped_bits_none_engages_or_moves_the_aircraft():
    """The issue's bounds; 99.9 % of 500 allows none without pulses for more than 300 ms. Ten
    thousand are tests/benchmarks/bench_firmware_flips.py.
    """
    require_tools()
    flips = fly_flips(FLIPS, SEED)
    assert len(flips) == FLIPS
    bad = [f for f in flips if f.engaged or f.moved or f.without_s > BACK_S]
    assert not bad, f"{table(flips)}\n{bad}"
    assert sum(f.state == "FAULT" for f in flips) > 5, "some flips must hit the sealed object"


def test_frames_are_read_as_a_radio_does():
    """By hand: a whole frame; one with a slot of 2300 us and one of three slots are none."""
    frame = np.cumsum([0, 1000, 1500, 1500, 1200])
    long, short = np.cumsum([0, 1000, 2300, 1500, 1200]), np.cumsum([0, 1000, 1500, 1500])
    falls = 1e-6 * np.concatenate([frame, 22000 + long, 44000 + short, 66000 + frame])
    starts, slots = read_frames(falls)
    assert starts == pytest.approx([0.0, 0.066])
    assert slots == pytest.approx(np.array([[1000, 1500, 1500, 1200]] * 2))
    assert read_frames(np.array([]))[1].shape == (0, 4)


@pytest.mark.parametrize(
    ("register", "bit"),
    [
        (DDRB, 5),  # pin 11 becomes an input
        (TIMSK1, 1),  # no interrupt for the next edge
        (TCCR1B, 1),  # no clock for the pulses
        (TCCR1B, 0),  # or one of an eighth
        (TCCR1B, 3),  # counts to OCR1A
        (TIMSK0, 0),  # micros() stands still
        (TCCR0B, 0),
        (TCCR0A, 0),
        (TIMSK4, 5),  # the pilot is measured no more
        (TCCR4B, 1),
        (TCCR4B, 6),  # at the wrong edge
        (TCCR4A, 0),
    ],
)
def test_a_disturbed_register_is_set_again_by_the_next_pass_of_loop(bench, register, bit):
    """Within a frame, for the pulse interrupt wakes loop() too, and without a restart: 45 frames a
    second as ever.
    """
    value = bench.board.peek(register)
    bench.board.flip(register, bit)
    bench.wait(0.022)
    assert bench.board.peek(register) == value
    take_falls(bench.board)
    bench.wait(1.0)
    assert len(read_frames(take_falls(bench.board))[0]) >= 43
    assert bench.board.watchdog_resets == 0 and bench.status().state == "SAFE"


def test_sleep_is_idle_sleep_again_at_the_next_nap(bench):
    """Power-down would stop the timers; the simulator has no such mode: the register is read."""
    bench.board.flip(SMCR, 2)
    bench.wait(0.002)
    assert bench.board.peek(SMCR) & 0x0E == 0


def test_an_interrupt_that_nobody_enabled_restarts_the_board_at_once(bench):
    """Overflow of Timer3, which the Arduino core leaves running: a jump to address 0 without a
    reset would meet the same interrupt again. By the overflow's 4 ms, the watchdog's 16, twice a
    frame's 22, and a start.
    """
    take_falls(bench.board)
    start = bench.board.t
    bench.board.flip(TIMSK3, 0)
    bench.wait(0.3)
    starts, slots = read_frames(take_falls(bench.board))
    assert np.diff([start, *starts]).max() < 0.08
    assert bench.board.watchdog_resets == 1 and bench.board.peek(TIMSK3) == 0
    assert np.abs(slots - SAFE).max() <= 1.0 and bench.status().fault == "stall"


def test_the_watchdog_ends_a_dead_pulse_interrupt(bench):
    """loop() runs on, without pulses: the board restarts 250 ms (256 here) after the last frame,
    and is in FAULT; a host that asks on gets nothing.
    """
    bench.engage()
    bench.board.stop_pulses()
    start = bench.board.t
    take_falls(bench.board)
    bench.fly(4)
    assert bench.board.watchdog_resets == 0
    # The reason of the restart in memory: the Mega's boot loader clears the chip's own.
    assert bench.board.peek(address_of("hung")) == 1
    bench.fly(6)
    assert bench.board.watchdog_resets == 1
    starts, slots = read_frames(take_falls(bench.board))
    assert starts[0] - start < BACK_S
    assert np.abs(slots - SAFE).max() <= 1.0
    assert (bench.status().state, bench.status().fault) == ("FAULT", "stall")


def test_a_watchdog_that_loop_always_feeds_fails_that_test(tmp_path):
    """The mutation: loop() feeds it whether the pulse interrupt has run or not."""
    require_tools()
    sketch = "trainer_bridge.ino"
    text = (firmware_folder() / "trainer_bridge" / sketch).read_text(encoding="utf-8")
    assert text.count("  if (ticked) {") == 1
    (tmp_path / sketch).write_text(text.replace("  if (ticked) {", "  if (true) {"))
    with ProbedBoard(build_firmware(replace=tmp_path)) as board:
        bench = Bench(board)
        board.stop_pulses()
        bench.wait(1.0)
        assert board.watchdog_resets == 0


def test_safe_slots_are_no_table_in_memory(tmp_path):
    """1000, 1500, 1500, 1500, low bytes first, stand nowhere in the memory that the start fills: a
    flipped bit there would be a wrong failsafe for good (found by flips).
    """
    require_tools()
    data = tmp_path / "data.bin"
    command = ["avr-objcopy", "-O", "binary", "-j", ".data", str(build_firmware()), str(data)]
    subprocess.run(command, check=True)
    assert len(data.read_bytes()) > 4
    assert not re.search(rb"\xdc\x05\xdc\x05", data.read_bytes())


@pytest.mark.parametrize("scene", ["SAFE", "ACTIVE", "LOST"])
def test_a_flip_in_the_middle_of_the_state_machine_is_a_fault(scene):
    """The state itself, its lowest bits: LOST becomes ACTIVE and back by one of them. STATUS says
    memory.
    """
    require_tools()
    safety = address_of("safety")
    for bit in range(3):
        with ProbedBoard() as board:
            host = Host(Bench(board), scene)
            flip = watch_flip(host, scene, "memory", safety, bit)
            assert not (flip.engaged or flip.moved)
            assert flip.resets == 0 and flip.without_s < 0.03
            fault = host.bench.status().fault
            assert fault == ("none" if scene == "SAFE" and flip.state == "SAFE" else "memory")


def test_lost_sounds_the_buzzer_and_nothing_else_does():
    """BUZZER_PIN 8 is bit 5 of port H (pins_arduino.h of the Mega): on and off twice a second in
    LOST, silent in SAFE and ACTIVE and after the hand-back.
    """
    require_tools()
    port_h = 0x102

    def sounds(bench, seconds=1.0):
        levels = []
        for _ in range(round(100 * seconds)):
            bench.wait(0.01)
            levels.append(bench.board.peek(port_h) >> 5 & 1)
        return sum(b > a for a, b in pairwise(levels)), sum(levels)

    with ProbedBoard(build_firmware(["BUZZER_PIN=8"])) as board:
        bench = Bench(board)
        assert sounds(bench, 0.5) == (0, 0)
        bench.engage()
        assert sounds(bench, 0.15) == (0, 0)
        bench.wait(0.1)
        times, on = sounds(bench, 2.0)
        assert bench.status().state == "LOST"
        assert 3 <= times <= 5 and 80 <= on <= 120
        bench.fly(1, SAFE, engage=False)
        assert sounds(bench, 0.5) == (0, 0)


def test_a_pilots_stick_is_safe_in_the_frame_after_its_measurement(bench):
    """At 23 phases of the radio's frames against the board's. A frame of the radio is measured when
    the next one begins (PILOT is stamped with its last edge, 6 ms after its first); the next frame
    of the board, within 22 ms, is safe, and so are all later ones.
    """
    waits, sticks = [], []
    for k in range(23):
        bench.board.set_pilot(None)
        bench.wait(0.044 + 0.022 - (bench.board.t % 0.022) + 0.001 * k)  # the radio begins anew
        bench.board.set_pilot(FLOWN)
        bench.wait(0.3)
        bench.fly(1, FLOWN, engage=False)
        bench.fly(6, FLOWN)
        assert bench.status().state == "ACTIVE"
        bench.send(FLOWN)
        bench.wait(0.0037 * (k % 6))
        bench.board.ppm_frames()
        bench.messages.clear()
        moved = (*FLOWN[:3], FLOWN[3] - 130)
        start = bench.board.t
        bench.board.set_pilot(moved)
        bench.wait(0.03)
        bench.fly(3, FLOWN)
        frames = bench.board.ppm_frames()
        safe = [frame.t_start for frame in frames if is_safe(frame)]
        assert all(is_safe(frame) for frame in frames if frame.t_start >= safe[0])
        assert bench.status().pilot_took_over
        pilots = [m for m in bench.messages if isinstance(m, PilotFrame)]
        first = next(p for p in pilots if abs(p.channels_us[3] - moved[3]) <= 1)
        last_edge = start + ((first.device_time_us * 1e-6 - start + 2147.0) % 4294.967296 - 2147.0)
        measured = last_edge + 0.022 - 1e-6 * sum(moved)
        waits.append(safe[0] - measured)
        sticks.append(safe[0] - start)
    print(
        f"pilot's stick: {1e3 * max(waits):.1f} ms from its measurement, "
        f"{1e3 * max(sticks):.1f} ms from the stick, at most"
    )
    assert min(waits) > -0.001 and max(waits) <= 0.0225  # half a ms for the clocks' difference
    assert max(sticks) <= 0.066
