"""The board in plain Python: its times by hand, its faults, and the same story as the real firmware
tells.
"""

import math

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.bridge.python_board import BYTE_S, PythonBoard
from falconwing_kit.tools.bridge.simulated_board import SimulatedBoard
from falconwing_kit.trainer_port.ppm import encode_command
from falconwing_kit.trainer_port.protocol import (
    Deframer,
    PilotFrame,
    Status,
    SyncReply,
    encode,
    encode_channels,
    encode_sync,
)
from falconwing_kit.trainer_port.safety import SafetyConfig
from tests.firmware.chip import require_tools

SAFE = (1000, 1500, 1500, 1500)
FLY = (1200, 1600, 1400, 1500)


class Bench:
    """A host with a sequence, and all that the board has said."""

    def __init__(self, board):
        self.board, self.sequence, self.messages, self.frames, self.deframer = (
            board,
            0,
            [],
            [],
            Deframer(),
        )

    def send(self, engage, channels=FLY, wait=0.05):
        self.sequence += 1
        self.board.write(encode_channels(self.sequence, channels, engage))
        self.run(wait)

    def run(self, seconds):
        self.board.run_until(self.board.t + seconds)
        self.messages += self.deframer.feed(self.board.read())
        self.frames += self.board.ppm_frames()

    def engage(self):
        for flag in (False, *[True] * 5):
            self.send(flag, SAFE)  # no pilot is measured
        self.send(True)
        self.run(0.051)
        assert self.status.state == "ACTIVE"
        return self

    def of(self, kind):
        return [message for message in self.messages if isinstance(message, kind)]

    @property
    def status(self):
        return self.of(Status)[-1]


@pytest.fixture
def bench():
    with PythonBoard() as board:
        yield Bench(board)


def test_it_says_that_it_is_not_the_firmware(bench):
    """What a user reads must not promise more than there is."""
    assert bench.board.kind == "plain Python, not the firmware"


def test_frames_are_ideal(bench):
    """By hand: the first edge 22 ms after power-on, then one frame every 22 ms; slots add up,
    pulses are 400 us.
    """
    bench.run(1.0)
    assert len(bench.frames) == 44  # of the 45 that began until 0.99 s the last is not complete
    for number, frame in enumerate(bench.frames, 1):
        assert frame.t_start == pytest.approx(0.022 * number, abs=1e-9)
        assert frame.t_slots - frame.t_start == pytest.approx(
            [0.0010, 0.0025, 0.0040, 0.0055], abs=1e-9
        )
        assert frame.slots_us.tolist() == list(SAFE)
        assert frame.gap_us.tolist() == [400.0] * 5
        assert frame.frame_us == pytest.approx(22000.0, abs=1e-3)


def test_a_command_takes_its_time_on_the_wire(bench):
    """16 bytes of 10 bits at 115200 are 1.39 ms: a command that ends just before a frame is in it,
    else in the next.
    """
    bench.engage()
    for lead, first in ((16 * BYTE_S + 1e-6, 0), (16 * BYTE_S - 1e-6, 1)):
        tick = math.ceil(bench.board.t / 0.022 + 0.2) * 0.022
        bench.board.run_until(tick - lead)
        bench.frames.clear()
        wanted = 1450 if first else 1550
        bench.send(True, (1200, 1600, 1400, wanted), wait=0.07)
        later = [frame for frame in bench.frames if frame.t_start > tick - 0.001]
        assert [frame.slots_us[3] == wanted for frame in later[:2]] == [first == 0, True]


def test_status_comes_20_times_a_second(bench):
    """At 50, 100 ... 1000 ms; 40 bytes take 3.5 ms, so that of 1000 ms arrives after 1000 ms."""
    bench.run(1.0)
    assert [status.device_time_us for status in bench.of(Status)] == [
        50_000 * n for n in range(1, 20)
    ]
    assert bench.status.state == "SAFE" and bench.status.ppm_frames == 43
    assert (bench.status.boot_count, bench.status.reset_causes) == (1, ("power-on",))
    bench.run(0.0034)
    assert bench.status.device_time_us == 950_000
    bench.run(0.0002)
    assert bench.status.device_time_us == 1_000_000


def test_counters_tell_what_became_of_frames(bench):
    """One of each by hand: accepted, replayed, out of range, damaged, of the wrong direction,
    another count.
    """
    bench.send(False)
    bench.sequence -= 1
    bench.send(False)
    bench.send(False, (1000, 1500, 1500, 2101))
    bench.board.write(b"\x05\x01\x02\x03\x04\0")
    bench.board.write(encode(SyncReply(1, 2, 3)))
    bench.send(False, (1500,) * 8)
    bench.run(0.06)
    status = bench.status
    assert (status.accepted, status.bad_sequence, status.out_of_range, status.bad_frames) == (
        1,
        1,
        1,
        3,
    )
    assert status.last_sequence == 1


def test_a_token_comes_back_with_the_times(bench):
    """9 bytes to the board take 0.78 ms; the reply's times are the board's microseconds."""
    bench.board.run_until(0.2)
    bench.board.write(encode_sync(77))
    bench.run(0.02)
    (reply,) = bench.of(SyncReply)
    assert reply.token == 77
    assert reply.received_us == reply.sent_us == pytest.approx(200_000 + 9 * 10 / 0.1152, abs=1)


def test_host_loss_is_safe_within_225_ms(bench):
    """200 ms and at most one frame of 22 ms, wherever in the frame the last command fell."""
    for phase in np.linspace(0.0, 0.022, 12):
        bench.engage()
        bench.run(phase)
        bench.send(True)
        arrived = bench.board.t - 0.05 + 16 * BYTE_S
        bench.frames.clear()
        bench.run(0.5)
        first_safe = next(
            frame.t_start for frame in bench.frames if frame.slots_us.tolist() == list(SAFE)
        )
        assert 0.2 <= first_safe - arrived <= 0.222 + 1e-6
        assert bench.status.state == "LOST"


def test_a_hung_program_is_safe_and_comes_back_as_a_fault(bench):
    """By the rules: no status any more, the watchdog after 250 ms, FAULT (stall), boot count 2, and
    1 s of rest.
    """
    bench.engage().run(0.01)  # the status on the wire is through
    hung = bench.board.t
    bench.board.hang()
    bench.messages.clear()
    for _ in range(4):
        bench.send(True)
    assert bench.of(Status) == []
    bench.run(0.2)
    status = bench.status
    assert (status.state, status.fault, status.boot_count) == ("FAULT", "stall", 2)
    assert status.reset_causes == ("watchdog",)
    assert status.device_time_us == pytest.approx((bench.board.t - hung - 0.25) * 1e6, abs=51_000)
    assert not any(
        tuple(frame.slots_us) != SAFE for frame in bench.frames if frame.t_start > hung + 0.222
    )
    bench.run(1.0)
    bench.send(False)
    bench.run(0.06)
    assert bench.status.state == "SAFE"


def test_power_off_forgets_everything(bench):
    """Boot count 1 again, cause power-on, no sequence; the board's own clock starts anew, virtual
    time runs on.

    The status that was on the wire is cut off there, and its half spoils the first one after it:
        one bad frame.
    """
    bench.engage()
    t = bench.board.t
    bench.board.power_cycle()
    bench.run(0.11)
    status = bench.status
    assert (status.state, status.boot_count, status.reset_causes) == ("SAFE", 1, ("power-on",))
    assert (status.accepted, status.last_sequence, status.device_time_us) == (0, 0, 100_000)
    assert bench.board.t == pytest.approx(t + 0.11)
    assert bench.deframer.bad == 1


def test_a_frame_cut_by_a_power_cycle_is_none(bench):
    """Its safe slots and last pulse take 5.9 ms: power off 5 ms into the third frame leaves two, 6
    ms into it three.
    """
    for into, frames in ((0.005, 2), (0.006, 3)):
        bench.frames.clear()
        bench.board.power_cycle()
        bench.run(3 * 0.022 + into)
        bench.board.power_cycle()
        bench.run(0.001)
        assert len(bench.frames) == frames


def test_a_pilot_frame_has_the_clock_of_this_boot(bench):
    """Power comes back at 1 s of virtual time; the fourth frame from there on begins at 66 ms, the
    third ends at 50.
    """
    bench.board.run_until(1.0)
    bench.board.power_cycle()
    bench.board.set_pilot((1500,) * 4)
    bench.run(0.08)
    assert [pilot.device_time_us for pilot in bench.of(PilotFrame)] == [2 * 22_000 + 6000]


def test_silence_means_no_pulses():
    """With SILENT_AFTER_MS = 1000 the last frame begins before it and nothing follows; the status
    says so.
    """
    bench = Bench(PythonBoard(SafetyConfig(silent_after_ms=1000))).engage()
    start = bench.board.t
    bench.run(3.0)
    assert bench.frames[-1].t_start - start < 1.0
    assert math.isnan(bench.frames[-1].frame_us)
    assert bench.status.silent and bench.status.state == "LOST"
    bench.send(False)
    bench.run(0.1)
    assert not bench.status.silent


def test_pilot_frames_are_reported(bench):
    """Three like frames teach what a frame is; each is known to be complete at the next one's first
    edge.
    """
    bench.board.run_until(0.1)
    bench.board.set_pilot((1100, 1200.4, 1300, 1400, 1500))
    bench.run(0.5)
    pilots = bench.of(PilotFrame)
    assert (
        len(pilots) == 20
    )  # frames begin at 100, 122 ... 584 ms: 23; the first two teach, the last is not complete
    assert all(pilot.channels_us == (1100, 1200, 1300, 1400, 1500) for pilot in pilots)
    assert pilots[0].device_time_us == 100_000 + 2 * 22_000 + 6500
    bench.board.set_pilot((700, 1200, 1300, 1400, 1500))
    bench.run(0.1)
    bench.board.set_pilot((1100, 1200, 1300, 1400, 1600))
    bench.run(0.05)
    assert bench.of(PilotFrame)[-1].rejected in (4, 5)
    bench.board.set_pilot(None)
    bench.run(0.05)
    count = len(bench.of(PilotFrame))
    bench.run(0.2)
    assert len(bench.of(PilotFrame)) == count
    with pytest.raises(InputError, match="pause"):
        bench.board.set_pilot((2200,) * 8)


def test_a_flood_of_questions_does_not_pile_up(bench):
    """Line rate in, replies are longer than questions: what does not fit is dropped whole, and
    status stays young.
    """
    bench.board.write(encode_sync(1) * 2000)
    bench.run(2000 * 9 * BYTE_S)
    assert bench.deframer.bad == 0
    assert bench.board.t * 1e6 - bench.status.device_time_us < 50_000 + (128 + 40) * BYTE_S * 1e6
    bench.run(0.1)
    assert bench.board.read() == b""


def test_time_does_not_run_backwards(bench):
    """A time that is past changes nothing, nan is refused."""
    bench.board.run_until(1.0)
    bench.board.run_until(0.5)
    assert bench.board.t == 1.0
    with pytest.raises(InputError, match="t: expected a finite number"):
        bench.board.run_until(math.nan)


def story(board):
    """A flight with a loss, a hand-back, a flicker, violations and a hang; the states and slots
    along it.
    """
    bench = Bench(board)
    bench.run(0.13)
    seen = []

    def look(seconds):
        bench.frames.clear()
        bench.run(seconds)
        seen.append(
            (
                bench.status.state,
                bench.status.fault,
                bench.status.boot_count,
                board.led,
                bench.frames[-1].slots_us,
            )
        )

    bench.engage()
    look(0.1)
    look(0.3)  # lost
    for flag in (True, False, True, True, True, True, True, True):
        bench.send(flag)
    look(0.06)
    for number in range(8):
        sticks = np.sin(0.9 * number + np.arange(4))
        bench.sequence += 1
        bench.board.write(encode_command(bench.sequence, *sticks, True))
        look(0.06)
    bench.send(False)
    look(0.06)
    bench.engage()
    for _ in range(5):
        bench.send(True, (899, 1500, 1500, 1500), wait=0.02)
    look(0.06)
    bench.run(1.0)
    bench.send(False)
    bench.engage()
    board.hang()
    look(0.5)
    status = bench.status
    counters = (
        status.accepted,
        status.bad_frames,
        status.bad_sequence,
        status.out_of_range,
        status.reset_causes,
    )
    return seen, counters


def test_the_firmware_tells_the_same_story():
    """The flashed program in the simulated chip, cycle by cycle, and this board: states, slots and
    counters agree.

    Slots to 1 us: the chip's timer counts half microseconds and its edges have up to 0.25 us of the
        simulator.
    """
    require_tools()
    with PythonBoard() as plain, SimulatedBoard() as chip:
        ours, theirs = story(plain), story(chip)
    assert ours[1] == theirs[1]
    for (*mine, slots), (*other, pins) in zip(ours[0], theirs[0], strict=True):
        assert mine == other
        assert slots == pytest.approx(pins, abs=1.0)
    assert {state for state, *_ in ours[0]} == {"SAFE", "ACTIVE", "LOST", "FAULT"}
    assert all(led == (state == "ACTIVE") for state, _, _, led, _ in ours[0])
