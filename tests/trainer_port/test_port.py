"""Trainer port: what it sends and when, against a board whose every word is written in the test."""

import math
from dataclasses import replace

import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import SAFE_COMMAND, Command
from falconwing_kit.trainer_port.port import (
    BACK_OFF,
    HAND_BACK_FRAMES,
    SILENT_AFTER,
    TrainerPort,
    require_matching_calibration,
)
from falconwing_kit.trainer_port.ppm import load_calibration
from falconwing_kit.trainer_port.protocol import (
    CommandFrame,
    Deframer,
    PilotFrame,
    Status,
    SyncReply,
    SyncRequest,
    encode,
)

STICKS = Command(0.5, 0.1, -0.2, 0.3)
SAYS = Status("SAFE", "none", 3, 1, 100, 40, 0, 0, 0, 0, False, (1000, 1500, 1500, 1500), 5_000_000)


class ScriptedBoard:
    """A line whose other end is the test: time is set by hand, words are put in, frames sent are
    kept.
    """

    def __init__(self) -> None:
        self.t, self.broken, self.closed = 50.0, False, False
        self._inbox, self._deframer = b"", Deframer()
        self.heard: list[CommandFrame | SyncRequest] = []

    def write(self, data: bytes) -> None:
        if self.broken:
            raise OSError("unplugged")
        self.heard += self._deframer.feed(data)

    def read(self) -> bytes:
        if self.broken:
            raise OSError("unplugged")
        data, self._inbox = self._inbox, b""
        return data

    def close(self) -> None:
        self.closed = True

    def says(self, message: object) -> None:
        self._inbox += encode(message) if not isinstance(message, bytes) else message

    @property
    def commands(self) -> list[CommandFrame]:
        return [frame for frame in self.heard if isinstance(frame, CommandFrame)]


@pytest.fixture
def board():
    return ScriptedBoard()


@pytest.fixture
def port(board):
    return TrainerPort(board, now=lambda: board.t)


def step(
    board: ScriptedBoard, port: TrainerPort, status: Status | None = None, seconds: float = 0.05
) -> None:
    """Time passes, the board says something, the port reads it."""
    board.t += seconds
    if status is not None:
        now_us = round((board.t - 45.0) * 1e6) % 2**32
        if status.ppm_frames == SAYS.ppm_frames:  # 45 frames a second, unless the test stops them
            status = replace(status, ppm_frames=now_us // 22_000)
        board.says(
            replace(status, device_time_us=now_us)
            if status.device_time_us == SAYS.device_time_us
            else status
        )
    port.poll()


def fly(board: ScriptedBoard, port: TrainerPort) -> None:
    """From the first STATUS to an aircraft that follows."""
    step(board, port, SAYS)
    port.send(STICKS, engage=True)
    step(board, port, replace(SAYS, last_sequence=101, accepted=41))
    for k in range(5):
        port.send(STICKS, engage=True)
        step(board, port, replace(SAYS, last_sequence=102 + k, accepted=42 + k))
    step(board, port, replace(SAYS, state="ACTIVE", last_sequence=106, accepted=46))
    assert port.engagement == "engaged"


# What is sent, and when.


def test_nothing_is_sent_before_the_first_status(board, port):
    """A Mega that was just restarted is in its boot loader for two seconds; not one byte may reach
    it.
    """
    for _ in range(100):
        step(board, port)
        assert not port.send(STICKS, engage=True)
        port.hand_back()
    assert board.heard == [] and port.counters.unsent == 400
    step(board, port, SAYS)
    assert port.send(STICKS, engage=False) and len(board.commands) == 1


def test_sequence_goes_on_where_the_board_is_and_wraps(board, port):
    """By hand: 65534 accepted, so 65535, 0, 1."""
    step(board, port, replace(SAYS, last_sequence=65534))
    for _ in range(3):
        port.send(STICKS, engage=False)
    assert [frame.sequence for frame in board.commands] == [65535, 0, 1]


def test_after_a_pause_no_sequence_is_used_twice(board, port):
    """Three are on their way when the board falls silent and says 101 again; it would refuse a
    second 102.
    """
    step(board, port, SAYS)
    for _ in range(4):
        port.send(STICKS, engage=False)
    step(board, port, seconds=SILENT_AFTER + 0.1)
    step(board, port, replace(SAYS, last_sequence=101, accepted=41))
    port.send(STICKS, engage=False)
    assert [frame.sequence for frame in board.commands] == [101, 102, 103, 104, 105]


def test_channels_are_those_of_the_calibration(board, port):
    """The shipped file by hand: throttle 1000..2000, the others 1500 +- 500 us, slots in order."""
    step(board, port, SAYS)
    port.send(STICKS, engage=False)
    assert board.commands[0].channels_us == (1500, 1550, 1400, 1650)


def test_there_is_no_heartbeat(board, port):
    """A loop that stops sends nothing, however often the port is read: the board must notice."""
    fly(board, port)
    before = len(board.commands)
    for _ in range(200):
        step(board, port, replace(SAYS, state="ACTIVE", last_sequence=106))
    assert len(board.commands) == before and any(
        isinstance(frame, SyncRequest) for frame in board.heard
    )


def test_engaging_lets_the_board_hear_0_in_safe_before_the_edge(board, port):
    """The firmware's rule: a frame with 0, then the edge. While the board is LOST, or has not
    heard, 0 goes on.
    """
    step(board, port, replace(SAYS, state="LOST"))
    for status in (
        replace(SAYS, state="LOST"),
        replace(SAYS, state="LOST", last_sequence=101, accepted=41),
        replace(SAYS, last_sequence=102, accepted=42),
    ):
        port.send(STICKS, engage=True)
        step(board, port, status)
    port.send(STICKS, engage=True)
    assert [frame.engage for frame in board.commands] == [False, False, False, True]
    assert port.engagement == "engaging"


def test_a_safe_that_was_said_before_the_frame_came_is_no_answer(board, port):
    """Two STATUS from before our first 0 was heard: the edge waits."""
    step(board, port, SAYS)
    for _ in range(2):
        port.send(STICKS, engage=True)
        step(board, port, SAYS)
    assert not any(frame.engage for frame in board.commands)


def test_an_edge_that_came_to_nothing_is_tried_again(board, port):
    """A second in SAFE with engage=1: frames were lost, so 0 is sent once more, then 1."""
    step(board, port, SAYS)
    flags = []
    for k in range(40):
        port.send(STICKS, engage=True)
        flags.append(board.commands[-1].engage)
        step(board, port, replace(SAYS, last_sequence=101 + k, accepted=41 + k))
    assert flags[:2] == [False, True] and False in flags[2:] and flags[-1]


@pytest.mark.parametrize(
    "status", [{"state": "LOST"}, {"state": "FAULT", "fault": "range"}, {"boot_count": 4}]
)
def test_a_board_that_stopped_following_is_not_taken_back_by_itself(board, port, status):
    """For any reason: engage=0 is sent until engagement is withdrawn and requested again."""
    fly(board, port)
    step(board, port, replace(SAYS, last_sequence=106, accepted=46, **status))
    assert port.engagement == "dropped" and "dropped" in [event.name for event in port.events]
    for k in range(50):
        port.send(STICKS, engage=True)
        step(board, port, replace(SAYS, last_sequence=107 + k, accepted=47 + k))
        assert not board.commands[-1].engage
    port.send(STICKS, engage=False)
    port.send(STICKS, engage=True)
    assert port.engagement == "asking"


@pytest.mark.parametrize("was_engaged", [True, False])
def test_a_pilot_who_took_over_keeps_the_aircraft(board, port, was_engaged):
    """The event names the pilot, even where no STATUS has shown ACTIVE in between; nothing is asked
    again.
    """
    if was_engaged:
        fly(board, port)
    else:
        step(board, port, SAYS)
        port.send(STICKS, engage=True)
        step(board, port, replace(SAYS, last_sequence=101, accepted=41))
        assert port.engagement == "engaging"
    status = replace(SAYS, last_sequence=106, accepted=46, pilot_took_over=True)
    step(board, port, status)
    assert port.engagement == "dropped"
    assert "pilot took over" in [event.name for event in port.events]
    for k in range(50):
        port.send(STICKS, engage=True)
        step(board, port, replace(status, last_sequence=107 + k, accepted=47 + k))
        assert not board.commands[-1].engage


@pytest.mark.parametrize(
    ("throttle", "pilot_us", "says", "reason"),
    [
        (0.5, None, {}, "throttle 1500 us, without a pilot's signal 1000 +- 20 us"),
        (0.02, None, {}, ""),
        (0.5, (1450, 1560, 1420, 1640), {"has_pilot": True}, ""),
        (
            0.5,
            (1300, 1560, 1520, 1640),
            {"has_pilot": True},
            "throttle 1500 us, the pilot's stick 1300 +- 100 us; "
            "elevator 1400 us, the pilot's stick 1520 +- 100 us",
        ),
        (0.5, None, {"engages_without_pilot": True}, ""),
        (
            0.5,
            (1300, 1560, 1520),
            {"has_pilot": True},
            "the pilot's radio has 3 channels, 4 are sent",
        ),
    ],
)
def test_why_the_board_does_not_engage_is_said(board, port, throttle, pilot_us, says, reason):
    """By hand from the shipped calibration; an event each second, as long as it is asked."""
    sticks = Command(throttle, 0.1, -0.2, 0.3 if pilot_us else 0.2)
    status = replace(SAYS, **says)
    for k in range(60):
        if pilot_us:
            board.says(PilotFrame(5_000_000, 0, 0, pilot_us))
        step(board, port, replace(status, last_sequence=100 + k, accepted=40 + k))
        port.send(sticks, engage=True)
    assert port.mismatch() == reason
    reasons = [e.details["reason"] for e in port.events if e.name == "not engaged"]
    assert len(reasons) >= 2 and set(reasons) == {reason}


def test_hand_back_is_at_once_and_stays(board, port):
    """Three frames with 0 and safe slots in the same moment; a loop that goes on asking gets
    nothing.
    """
    fly(board, port)
    before = len(board.commands)
    port.hand_back()
    burst = board.commands[before:]
    assert len(burst) == HAND_BACK_FRAMES and not any(frame.engage for frame in burst)
    assert burst[0].channels_us == (1000, 1500, 1500, 1500)
    assert [frame.sequence for frame in burst] == [107, 108, 109]
    for k in range(20):
        step(board, port, replace(SAYS, last_sequence=109 + k, accepted=49 + k))
        port.send(STICKS, engage=True)
        assert not board.commands[-1].engage


def test_sticks_that_are_no_numbers_hand_back(board, port):
    """On the way to the aircraft wrong input means failsafe, not an exception."""
    fly(board, port)
    assert port.send(Command(0.5, math.nan, 0.0, 0.0), engage=True)
    assert (
        board.commands[-1].channels_us == (1000, 1500, 1500, 1500) and not board.commands[-1].engage
    )
    assert port.engagement == "dropped" and "bad command" in [event.name for event in port.events]


@pytest.mark.parametrize("nothing", [None, "sticks", (0.5, 0.0, 0.0, 0.0)])
def test_what_is_no_command_hands_back(board, port, nothing):
    """A controller that returned none: hand-back is immediate, not a timeout 200 ms later."""
    fly(board, port)
    assert port.send(nothing, engage=True)
    assert (
        board.commands[-1].channels_us == (1000, 1500, 1500, 1500) and not board.commands[-1].engage
    )
    assert port.engagement == "dropped"


def test_closing_hands_back(board, port):
    """Leaving the `with` block in flight: the last frame has engage=0, and the line is closed."""
    with port:
        fly(board, port)
    assert not board.commands[-1].engage and board.closed


# A line that breaks.


def test_silence_stops_sending_until_the_board_speaks_again(board, port):
    """Without STATUS the board may be in its boot loader; it goes safe by itself meanwhile."""
    fly(board, port)
    step(board, port, seconds=SILENT_AFTER - 0.01)
    assert port.send(STICKS, engage=True)
    step(board, port, seconds=0.02)
    assert port.state == "silent" and not port.send(STICKS, engage=True)
    step(board, port, replace(SAYS, state="LOST", last_sequence=107, accepted=47))
    assert port.state == "open" and port.send(STICKS, engage=True) and not board.commands[-1].engage


def test_a_lost_port_is_opened_again_with_back_off(board):
    """By hand: attempts 0.25 s after the loss, then 0.5, 1, 2, 4, 4 s apart; nothing raises."""
    lines, attempts, new = [board], [], ScriptedBoard()

    def reopen():
        attempts.append(board.t - lost)
        if len(attempts) < 6:
            raise InputError("not there")
        lines.append(new)
        return new

    port = TrainerPort(board, now=lambda: board.t, reopen=reopen)
    fly(board, port)
    board.broken, lost = True, board.t
    assert not port.send(STICKS, engage=True)
    assert port.state == "lost" and board.closed and port.events[-1].details == {"why": "unplugged"}
    while len(lines) == 1 and board.t < lost + 60.0:
        board.t += 0.01
        assert not port.send(STICKS, engage=True)
        port.poll()
    gaps = [later - earlier for earlier, later in zip([0.0, *attempts], attempts, strict=False)]
    assert gaps == pytest.approx(
        [BACK_OFF[0], 0.5, 1.0, 2.0, BACK_OFF[1], BACK_OFF[1]], abs=0.021
    )  # steps of 10 ms
    assert port.state == "waiting" and port.counters.reconnects == 1 and new.heard == []
    new.says(replace(SAYS, state="LOST", last_sequence=106, accepted=46))
    port.poll()
    assert port.engagement == "dropped" and port.send(STICKS, engage=True)
    assert (new.commands[0].sequence, new.commands[0].engage) == (107, False)


def test_without_a_way_to_open_it_again_a_lost_port_stays_lost(board, port):
    """Reading and sending go on without an exception."""
    fly(board, port)
    board.broken = True
    for _ in range(100):
        step(board, port)
        assert not port.send(STICKS, engage=True)
    port.hand_back()
    port.close()
    assert port.state == "lost" and [event.name for event in port.events].count("port lost") == 1


# Counting.


def test_frames_sent_accepted_and_dropped_are_counted(board, port):
    """By hand: ten sent; the board accepted seven of the first nine, and the tenth is still on its
    way.
    """
    step(board, port, SAYS)
    for _ in range(10):
        port.send(STICKS, engage=False)
    step(board, port, replace(SAYS, last_sequence=109, accepted=47))
    counters = port.counters
    assert (counters.sent, counters.accepted, counters.dropped) == (10, 7, 2)
    board.says(b"\x05garbage\x00")
    step(board, port, replace(SAYS, last_sequence=110, accepted=48))
    assert (counters.accepted, counters.dropped, counters.bad) == (8, 2, 1)


def test_accepted_goes_on_over_the_board_s_wrap_and_reset(board, port):
    """By hand: from 2^32 - 2 to 1 is three; after a reset the board begins at zero and had four."""
    step(board, port, replace(SAYS, accepted=2**32 - 2))
    step(board, port, replace(SAYS, accepted=1))
    assert port.counters.accepted == 3
    step(board, port, replace(SAYS, boot_count=4, accepted=4))
    assert port.counters.accepted == 7 and port.counters.resets == 1


@pytest.mark.parametrize(
    ("then", "resets"),
    [
        ({"boot_count": 4, "device_time_us": 2000}, 1),
        (
            {"boot_count": 3, "device_time_us": 2000},
            1,
        ),  # power was off: the count starts again at the same number
        ({"boot_count": 3, "device_time_us": 20_050_000}, 0),
        ({"boot_count": 2, "device_time_us": 20_050_000}, 1),
    ],
)
def test_a_reset_is_seen_by_boot_count_or_clock(board, port, then, resets):
    """A board whose clock jumps back was restarted, whatever it counts."""
    step(board, port, replace(SAYS, device_time_us=20_000_000))
    step(board, port, replace(SAYS, **then))
    assert (
        port.counters.resets == resets == [event.name for event in port.events].count("board reset")
    )


def test_the_board_s_clock_may_wrap(board, port):
    """50 ms over 2^32 us is no reset."""
    step(board, port, replace(SAYS, device_time_us=2**32 - 20_000))
    step(board, port, replace(SAYS, device_time_us=30_000))
    assert port.counters.resets == 0


# Time.


def test_device_time_is_put_on_the_host_s_clock(board, port):
    """Truth: the board's clock is the host's less 45 s. Its answer takes 5 ms, so the error is
    below 5 ms.
    """
    assert math.isnan(port.to_host_time(0))
    step(board, port, SAYS)
    assert port.to_host_time(6_000_000) == pytest.approx(
        51.0, abs=1e-9
    )  # from the STATUS alone, which came at once
    sync = next(frame for frame in board.heard if isinstance(frame, SyncRequest))
    board.t += 0.005
    device = round((board.t - 0.0025 - 45.0) * 1e6)
    board.says(SyncReply(sync.token, device, device + 100))
    board.says(SyncReply(12345, 0, 0))  # nobody asked this
    port.poll()
    assert port.clock.is_synchronised
    assert port.to_host_time(device) == pytest.approx(board.t - 0.0025, abs=1e-3)
    # By hand: 5 ms less 26 bytes of 10 bits at 115200 baud, less 0.1 ms inside the board, halved.
    assert port.clock.error_bound(device) == pytest.approx(1.32e-3, abs=0.01e-3)


def test_wait_ready_waits_for_status_and_clock(board, port):
    """A board that answers everything at once; 5 ms a look."""

    def pass_time(seconds):
        board.t += seconds
        device = round((board.t - 45.0) * 1e6)
        for frame in board.heard:
            if isinstance(frame, SyncRequest):
                board.says(SyncReply(frame.token, device - 50, device))
        board.says(replace(SAYS, device_time_us=device))

    status = port.wait_ready(sleep=pass_time)
    assert status.boot_count == 3 and port.clock.is_synchronised and board.t < 50.1


def test_no_status_is_one_sentence(board):
    """After the time that was given; what to do is in it."""
    port = TrainerPort(board, now=lambda: board.t, what="board on /dev/ttyX")

    def pass_time(seconds):
        board.t += seconds

    with pytest.raises(
        InputError, match=r"board on /dev/ttyX: expected a STATUS .* got none in 3 s; .*find-port"
    ):
        port.wait_ready(3.0, pass_time)


def test_another_number_of_channels_is_refused(board, port):
    """The calibration has four; a board of six would refuse every command."""

    def pass_time(seconds):
        board.t += seconds
        board.says(replace(SAYS, channels_us=(1500,) * 6))

    with pytest.raises(InputError, match="expected 6 channels as the board's firmware has, got 4"):
        port.wait_ready(0.1, pass_time)


def test_safe_slots_that_would_leave_the_motor_on_are_refused():
    """By hand: the throttle in channel 2, where the board's safe slot is 1500 us, half throttle.
    While the board is ACTIVE its slots are somebody's command and say nothing.
    """
    shipped = load_calibration()
    aileron, throttle = replace(shipped.aileron, channel=1), replace(shipped.throttle, channel=2)
    swapped = replace(shipped, throttle=throttle, aileron=aileron)
    require_matching_calibration(shipped, SAYS)
    require_matching_calibration(swapped, replace(SAYS, state="ACTIVE"))
    with pytest.raises(
        InputError, match=r"got throttle 50%, .* in channel 2 and idles at 1000 us; .*SAFE_SLOTS_US"
    ):
        require_matching_calibration(swapped, SAYS)


def test_a_host_that_comes_back_at_once_is_checked_too(board):
    """The board is still ACTIVE with old slots; it is LOST, with its safe slots, 0.2 s later."""
    shipped = load_calibration()
    aileron, throttle = replace(shipped.aileron, channel=1), replace(shipped.throttle, channel=2)
    port = TrainerPort(
        board, replace(shipped, throttle=throttle, aileron=aileron), now=lambda: board.t
    )

    def pass_time(seconds):
        board.t += seconds
        device = round((board.t - 45.0) * 1e6)
        for frame in board.heard:
            board.says(SyncReply(frame.token, device - 50, device))
        board.says(
            replace(SAYS, device_time_us=device, state="ACTIVE" if board.t < 50.2 else "LOST")
        )

    with pytest.raises(InputError, match="to stop the motor, got throttle 50%"):
        port.wait_ready(sleep=pass_time)


def test_the_safe_command_is_an_idle_motor_and_neutral_sticks():
    """By hand."""
    assert SAFE_COMMAND.vector.tolist() == [0.0, 0.0, 0.0, 0.0]


def test_a_board_that_answers_without_pulses_is_dropped_within_150_ms(board, port):
    """Its pulse interrupt stopped: STATUS goes on and says ACTIVE, its count of frames stands.

    The last STATUS with a new frame, then two with the same count, 50 and 100 ms later.
    """
    fly(board, port)
    active = replace(SAYS, state="ACTIVE", last_sequence=106, accepted=46)
    for _ in range(5):
        port.send(STICKS, engage=True)
        step(board, port, active)
    assert port.engagement == "engaged"
    stopped = replace(active, ppm_frames=777)
    for _ in range(3):
        assert port.engagement == "engaged"
        port.send(STICKS, engage=True)
        step(board, port, stopped)
    assert port.engagement == "dropped"
    assert [event.name for event in port.events].count("no pulses") == 1
    port.send(STICKS, engage=True)
    assert not board.commands[-1].engage


def test_a_board_may_be_without_pulses_before_it_is_asked(board, port):
    """Silent in SAFE, as its setting allows: nothing is reported."""
    silent = replace(SAYS, silent=True, ppm_frames=777)
    for k in range(20):
        step(board, port, replace(silent, last_sequence=100 + k, accepted=40 + k))
        port.send(STICKS, engage=False)
    assert port.engagement == "off" and "no pulses" not in {event.name for event in port.events}
