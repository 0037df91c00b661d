"""Faults in the simulated chip: lost host, hung program, corrupted and repeated frames."""

import numpy as np
import pytest

from falconwing_kit.tools.bridge.build import build_firmware
from falconwing_kit.trainer_port.protocol import encode_channels
from tests.firmware.chip import (
    BYTE,
    FLOWN,
    LOOP,
    SAFE,
    Bench,
    ProbedBoard,
    is_safe,
    require_tools,
    slots,
)

SAFE_WITHIN = (
    0.225  # s: the bound, 200 ms of countdown and one frame of 22 ms, and 3 to spare
)
TOO_EARLY = 0.2  # s: before the countdown has run out nothing may be lost
PHASES = 23  # of the last command against the frames


def time_to_safe(bench, last: float) -> float:
    """From the last command's arrival to the first edge of the first safe frame; the board ran long
    enough [s].
    """
    frames = bench.board.ppm_frames()
    safe = np.array([is_safe(frame) for frame in frames])
    first = int(np.flatnonzero(safe)[0])
    assert safe[first:].all(), "once safe, always safe"
    assert np.abs(slots(frames[:first])[-5:] - FLOWN).max() <= 1.0, "it had followed until then"
    return frames[first].t_start - last


def test_without_a_host_the_slots_are_safe_within_225_ms(bench):
    """The host stops at 23 phases of the 22 ms frame; the slots must hold for 200 ms and be safe at
    225.
    """
    times = []
    for k in range(PHASES):
        bench.engage()
        bench.wait(k * 0.001)
        last = bench.send()
        bench.board.ppm_frames()
        bench.wait(0.4)
        times.append(time_to_safe(bench, last))
        assert bench.status().state == "LOST"
    assert min(times) >= TOO_EARLY - 16 * BYTE
    assert max(times) <= SAFE_WITHIN


def test_a_host_that_comes_back_asks_again_from_the_start(bench):
    """After a loss engage=1 does nothing; engage=0, the edge and five frames do."""
    bench.engage()
    bench.wait(0.3)
    bench.fly(10)
    assert bench.status().state == "LOST"
    assert is_safe(bench.board.ppm_frames()[-1])
    bench.engage()


def test_a_hung_program_is_safe_within_225_ms_and_tells_afterwards(bench):
    """loop() never returns; the interrupt's countdown does it, then the watchdog resets and the
    fault shows.

    A stall takes engage=0 at least a second after the boot to end; sooner it stays.
    """
    times = []
    for k in range(8):
        bench.engage()
        bench.wait(k * 0.003)
        last = bench.send()
        bench.wait(0.003)
        boots, resets = bench.status().boot_count, bench.board.watchdog_resets
        last = bench.send()
        bench.wait(0.002)
        bench.board.ppm_frames()
        bench.board.hang()
        bench.wait(0.6)
        assert bench.board.watchdog_resets == resets + 1
        frames = bench.board.ppm_frames()
        assert {len(frame.slots_us) for frame in frames} == {4}, (
            "what the reset broke off is no frame"
        )
        safe = [frame.t_start for frame in frames if is_safe(frame)]
        followed = [frame.t_start for frame in frames if not is_safe(frame)]
        assert safe[0] > followed[-1]
        times.append(safe[0] - last)
        status = bench.status()
        assert (status.state, status.fault) == ("FAULT", "stall")
        assert status.boot_count == boots + 1
        bench.fly(1, SAFE, engage=False)
        assert bench.status().state == "FAULT"
        bench.wait(1.0)
        bench.fly(1, SAFE, engage=False)
        assert (bench.status().state, bench.status().fault) == ("SAFE", "none")
    assert min(times) >= TOO_EARLY - 16 * BYTE
    assert max(times) <= SAFE_WITHIN


def test_a_hung_program_tells_also_where_the_boot_loader_takes_the_cause(bench):
    """The Mega's boot loader clears the watchdog's flag before the program can read it; the reset
    button stands for it here, which sets another flag. The interrupt's own mark is left.
    """
    bench.engage()
    bench.board.hang()
    bench.wait(0.2)
    assert bench.board.watchdog_resets == 0
    bench.board.reset()
    bench.wait(0.1)
    status = bench.status()
    assert (status.state, status.fault, status.reset_cause & 0x08) == ("FAULT", "stall", 0)


def test_the_led_is_on_while_active_only(bench):
    """`falconwing bench` measures the camera's delay by it."""
    assert not bench.board.led
    bench.engage()
    assert bench.board.led
    bench.fly(1, SAFE, engage=False)
    assert not bench.board.led


def test_status_shows_the_switch_of_engaging_without_a_pilot():
    """ENGAGE_WITHOUT_PILOT in config.h: a host must see that its board engages at any stick."""
    require_tools()
    for value in (0, 1):
        with ProbedBoard(build_firmware([f"ENGAGE_WITHOUT_PILOT={value}"])) as board:
            assert Bench(board).status().engages_without_pilot == bool(value)


def test_a_power_cycle_is_a_first_boot(bench):
    """Memory holds anything after power-on: the boot count must be 1 all the same, and 2 after the
    reset button.
    """
    for seed in range(5):
        bench.board.power_cycle()
        bench.wait(0.2)
        status = bench.status()
        assert (status.boot_count, status.reset_cause, status.fault) == (1, 0x01, "none"), (
            f"power cycle {seed}"
        )
    bench.board.reset()
    bench.wait(0.2)
    status = bench.status()
    assert (status.boot_count, status.reset_cause) == (2, 0x02)


def feed(bench, frames: list[bytes], at_a_time: int = 32) -> None:
    """Frames one behind the other at the line's rate."""
    for k in range(0, len(frames), at_a_time):
        data = b"".join(frames[k : k + at_a_time])
        bench.board.write(data)
        bench.wait(len(data) * BYTE)


def test_none_of_10000_corrupt_frames_is_accepted(bench):
    """One to four bits of a good command turned over, its closing zero included; each is the next
    in sequence.
    """
    rng, frames = np.random.default_rng(7), []
    for k in range(10_000):
        frame = np.frombuffer(encode_channels(k + 1, FLOWN, engage=True), np.uint8)
        bits = np.unpackbits(frame)
        bits[rng.choice(bits.size, rng.integers(1, 5), replace=False)] ^= 1
        frames.append(np.packbits(bits).tobytes())
    feed(bench, frames)
    status = bench.status()
    assert status.accepted == 0 and status.state == "SAFE"
    assert status.bad_frames >= 9000  # a frame that lost its zero takes the next one with it
    assert all(is_safe(frame) for frame in bench.board.ppm_frames())
    bench.board.write(b"\0")
    bench.engage()


def test_none_of_10000_replayed_or_stuck_sequences_is_accepted(bench):
    """Half repeat the last number, half one of the 32768 behind it; they do not keep the host alive
    either.
    """
    rng = np.random.default_rng(8)
    bench.sequence = 1000
    bench.engage()
    accepted, last = bench.status().accepted, bench.sequence
    old = [last if k % 2 else last - int(rng.integers(0, 32769)) for k in range(10_000)]
    feed(
        bench,
        [
            encode_channels(sequence % 65536, (1400, 1400, 1400, 1400), engage=True)
            for sequence in old
        ],
    )
    status = bench.status()
    assert (status.accepted, status.last_sequence) == (accepted, last)
    assert status.bad_sequence == 10_000
    assert status.state == "LOST"
    bench.fly(1, SAFE, engage=False)
    assert bench.status().accepted == accepted + 1


@pytest.mark.parametrize(
    "garbage", [b"\x01", b"\xff" * 300, bytes(range(1, 256)), b"\x10\x01\x05\x00\x00\x02"]
)
def test_the_next_good_frame_after_garbage_is_taken(bench, garbage):
    """One zero ends whatever it was. Without it the garbage takes one frame with it, and the one
    after is taken.
    """
    bench.board.write(garbage + b"\0")
    bench.wait(LOOP)
    bench.fly(1)
    assert bench.status().accepted == 1
    bench.board.write(garbage)
    bench.wait(LOOP)
    bench.fly(2)
    assert bench.status().accepted >= 2
    assert bench.status().last_sequence == bench.sequence


def test_a_broken_host_is_a_fault(bench):
    """Five commands out of range within a second; it takes engage=0 a second after the last to end
    it.
    """
    bench.engage()
    bench.fly(4, (850, 1500, 1500, 1500))
    assert bench.status().fault == "none"
    bench.fly(1, (850, 1500, 1500, 1500))
    status = bench.status()
    assert (status.state, status.fault, status.out_of_range) == ("FAULT", "range", 5)
    bench.wait(1.0)
    bench.fly(1, SAFE, engage=False)
    assert bench.status().state == "SAFE"
    bench.engage()
