"""Safety state machine: every rule by hand, and the same answers as the firmware's C++ over random
traces.
"""

import dataclasses
import re
from collections import Counter
from typing import NamedTuple

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.trainer_port import Safety, SafetyConfig, SafetyDecision, load_calibration
from falconwing_kit.trainer_port.ppm import SENT_US, VALID_US
from tests.trainer_port.host_library import FIRMWARE, HostSafety, build

MS, CLOCK = 1000, 2**32
SAFE = (1000, 1500, 1500, 1500)
FLY = (1020, 1600, 1400, 1500)  # as far from idle and neutral as a board without a pilot engages
OUT = (1200, 1600, 1400, 2101)  # one slot a microsecond above what is valid


class Host:
    """A host that counts its sequence and its time."""

    def __init__(self, safety, now_us=0):
        self.safety, self.now, self.sequence = safety, now_us, 100

    def send(self, engage, channels=FLY, wait_ms=50):
        """A command a while after the last event."""
        self.now = (self.now + round(wait_ms * MS)) % CLOCK
        self.sequence = (self.sequence + 1) % 65536
        return self.safety.frame(self.now, self.sequence, engage, channels)

    def tick(self, wait_ms=0.0, pilot=None):
        self.now = (self.now + round(wait_ms * MS)) % CLOCK
        return self.safety.tick(self.now, pilot)

    def ask(self, channels=FLY, pilot=None):
        """The shortest way from SAFE to ACTIVE, with the pilot measured all the time; the state."""
        for flag in (False, True, True, True, True, True):
            for _ in range(2 if pilot else 0):
                self.tick(22.0, pilot)
            self.send(flag, channels, wait_ms=50 - 44 * bool(pilot))
        return self.safety.state

    def engage(self):
        """From SAFE to ACTIVE."""
        assert self.ask() == "ACTIVE"
        return self


@pytest.fixture
def host():
    """A board that has ticked once, and a host that has sent nothing."""
    safety = Safety()
    assert safety.state == "BOOT"
    assert safety.tick(0) == SAFE
    return Host(safety)


def states_after(host, flags, wait_ms=50):
    """The states after each of the commands."""
    states = []
    for flag in flags:
        host.send(flag, wait_ms=wait_ms)
        states.append(host.safety.state)
    return states


def test_edge_and_five_frames_engage(host):
    """By the rule: 0, then 1 1 1 1 1; the fifth makes ACTIVE and its channels are the first to go
    out.
    """
    assert states_after(host, [0, 1, 1, 1, 1]) == ["SAFE"] * 5
    assert host.tick() == SAFE
    host.send(True, (1010, 1590, 1420, 1500))
    assert host.safety.state == "ACTIVE"
    assert host.tick() == (1010, 1590, 1420, 1500)


def test_without_an_edge_nothing_engages(host):
    """The first valid frame after boot is no edge, however many follow."""
    assert set(states_after(host, [1] * 50)) == {"SAFE"}


@pytest.mark.parametrize(("wait_ms", "state"), [(124.999, "ACTIVE"), (125.0, "SAFE")])
def test_five_frames_must_come_within_500_ms(host, wait_ms, state):
    """Four gaps of 125 ms are 500 ms from the edge to the fifth frame: too late by nothing; and
    then no more.
    """
    assert states_after(host, [0, 1, 1, 1, 1, 1], wait_ms)[-1] == state
    assert states_after(host, [1] * 20)[-1] == state


@pytest.mark.parametrize(("wait_ms", "state"), [(199.999, "ACTIVE"), (200.0, "SAFE")])
def test_a_gap_of_200_ms_forgets_the_edge(host, wait_ms, state):
    """One long gap among short ones, the whole within 500 ms; there was no tick in between."""
    states_after(host, [0, 1, 1, 1])
    host.send(True, wait_ms=wait_ms)
    assert states_after(host, [1])[-1] == state


def test_flickering_engage_never_engages(host):
    """0 1 1 1 1 0 again and again: four frames are none."""
    assert set(states_after(host, [0, 1, 1, 1, 1] * 40)) == {"SAFE"}


def test_refused_frames_between_do_not_count(host):
    """Replayed frames neither stand for the five nor break them: the rule counts valid frames."""
    host.send(False)
    for _ in range(4):
        host.send(True)
        assert host.safety.frame(host.now, host.sequence, True, FLY) == SafetyDecision.SEQUENCE
    assert host.safety.state == "SAFE"
    host.send(True)
    assert host.safety.state == "ACTIVE"


def test_commands_in_boot_are_no_start(host):
    """The edge counts in SAFE only: before the first tick it is accepted and nothing follows from
    it.
    """
    early = Host(Safety())
    assert early.send(False) == early.send(True) == SafetyDecision.ACCEPTED
    assert early.safety.state == "BOOT"
    early.tick()
    assert set(states_after(early, [1] * 10)) == {"SAFE"}


def test_engage_zero_hands_back_at_once(host):
    """The slots are safe in the very next frame: no slew on the way out."""
    host.engage().send(True, (2000, 2000, 1000, 1500))
    for _ in range(10):
        host.tick()
    assert host.tick() == (2000, 2000, 1000, 1500)
    host.send(False)
    assert host.safety.state == "SAFE"
    assert host.tick() == SAFE


def test_host_loss_is_seen_at_200_ms(host):
    """At a tick 199.999 ms after the last valid frame it flies, at 200 ms it is lost; refused
    frames renew nothing.
    """
    host.engage()
    assert host.tick(199.999) != SAFE
    host.safety.frame(host.now, host.sequence, True, FLY)
    assert host.tick(0.001) == SAFE
    assert host.safety.state == "LOST"


def test_lost_needs_a_release_and_a_new_edge(host):
    """engage = 1 does nothing in LOST; 0 leads to SAFE, and from there the whole way again."""
    host.engage().tick(201.0)
    assert set(states_after(host, [1] * 20)) == {"LOST"}
    assert states_after(host, [0, 1, 1, 1, 1, 1]) == ["SAFE"] * 5 + ["ACTIVE"]


def test_the_fifth_violation_within_a_second_is_a_fault(host):
    """Four in a second and one a second after the first of them are none; five are, from ACTIVE
    too.
    """
    host.engage()
    for _ in range(4):
        assert host.send(True, OUT, wait_ms=10) == SafetyDecision.RANGE
    assert host.send(True, OUT, wait_ms=970) == SafetyDecision.RANGE
    assert host.safety.state == "ACTIVE"
    for _ in range(4):
        host.send(True, OUT, wait_ms=200)
    assert (host.safety.state, host.safety.fault) == ("FAULT", "range")
    assert host.tick() == SAFE


@pytest.mark.parametrize(("wait_ms", "state"), [(999.999, "FAULT"), (1000.0, "SAFE")])
def test_a_fault_ends_a_second_after_the_last_violation(host, wait_ms, state):
    """Only by engage = 0, and each violation in FAULT starts the second again."""
    for _ in range(6):
        host.send(True, OUT, wait_ms=100)
    host.send(True, wait_ms=0)
    assert host.send(False, wait_ms=wait_ms) == SafetyDecision.ACCEPTED
    assert host.safety.state == state
    assert (host.safety.fault == "none") == (state == "SAFE")


def test_a_fault_cannot_be_flown_through(host):
    """An edge and five frames within the second of rest: still a fault, and after it the whole way
    again.
    """
    for _ in range(5):
        host.send(True, OUT, wait_ms=10)
    assert set(states_after(host, [0, 1, 1, 1, 1, 1, 1])) == {"FAULT"}
    assert set(states_after(host, [1] * 20)) == {"FAULT"}
    assert states_after(host, [0, 1, 1, 1, 1, 1]) == ["SAFE"] * 5 + ["ACTIVE"]


def test_a_watchdog_reset_is_a_fault_for_a_second():
    """A tick does not make it SAFE; engage = 0 does, from 1 s after boot on."""
    host = Host(Safety(watchdog_reset=True))
    assert host.tick(22.0) == SAFE
    assert (host.safety.state, host.safety.fault) == ("FAULT", "stall")
    assert states_after(host, [0] * 19) == ["FAULT"] * 19  # 0.972 s
    assert states_after(host, [1, 0]) == ["FAULT", "SAFE"]


@pytest.mark.parametrize("step", [1, 2, 32767])
def test_a_sequence_that_advances_is_taken(host, step):
    """Up to half the circle counts as forward, across 65535 too."""
    for start in (0, 65535, 40000):
        safety = Safety()
        assert safety.frame(0, start, False, FLY) == SafetyDecision.ACCEPTED
        assert safety.frame(1, (start + step) % 65536, False, FLY) == SafetyDecision.ACCEPTED


@pytest.mark.parametrize("step", [0, -1, 32768, -32767])
def test_a_sequence_that_stands_or_goes_back_is_refused(step):
    """0 is a stuck host, -1 a replay; what was refused does not move the last one."""
    safety = Safety()
    safety.frame(0, 7, False, FLY)
    assert safety.frame(1, (7 + step) % 65536, False, FLY) == SafetyDecision.SEQUENCE
    assert safety.last_sequence == 7
    assert safety.frame(2, 8, False, FLY) == SafetyDecision.ACCEPTED


@pytest.mark.parametrize(("us", "verdict"), [(899, 2), (900, 0), (2100, 0), (2101, 2)])
def test_valid_is_900_to_2100(host, us, verdict):
    """The ends belong to it; a frame out of range does not move the sequence."""
    before = host.safety.last_sequence
    assert host.send(False, (1000, us, 1500, 1500)) == verdict
    assert (host.safety.last_sequence == before) == (verdict == SafetyDecision.RANGE)


def test_out_of_range_counts_whatever_the_sequence_says(host):
    """A host that repeats one bad frame is as broken as one that counts on: the range is looked at
    first.
    """
    host.send(False)
    for _ in range(5):
        assert host.safety.frame(host.now, host.sequence, False, OUT) == SafetyDecision.RANGE
    assert host.safety.state == "FAULT"


def test_another_number_of_channels_is_no_command(host):
    """Four are configured; three and five are refused and touch nothing."""
    assert host.send(False, FLY[:3]) == host.send(False, (*FLY, 1500)) == SafetyDecision.FORM
    assert host.safety.last_sequence is None


# ---- the pilot ----

PILOT = (1540, 1480, 1610, 1500)
PROGRAMS = ["Python", "C++"]


@pytest.fixture(params=PROGRAMS)
def any_host(request, tmp_path_factory):
    """A host of the model, and one of the firmware's own machine."""
    if request.param == "Python":
        return Host(Safety())
    return Host(HostSafety(build(tmp_path_factory.getbasetemp() / "shipped")))


@pytest.mark.parametrize(
    ("channels", "state"),
    [
        ((1020, 1600, 1400, 1600), "ACTIVE"),
        ((1021, 1500, 1500, 1500), "SAFE"),
        ((1000, 1601, 1500, 1500), "SAFE"),
        ((1000, 1500, 1399, 1500), "SAFE"),
        ((2000, 1500, 1500, 1500), "SAFE"),
    ],
)
def test_without_a_pilot_only_idle_and_neutral_engage(any_host, channels, state):
    """The limits by the rule: throttle to 20 us above idle, the others to 100 us from neutral."""
    any_host.tick()
    assert any_host.ask(channels) == state
    assert not any_host.safety.has_pilot


@pytest.mark.parametrize("channel", range(4))
@pytest.mark.parametrize(("away_us", "state"), [(100, "ACTIVE"), (101, "SAFE"), (-101, "SAFE")])
def test_with_a_pilot_only_commands_near_the_sticks_engage(any_host, channel, away_us, state):
    """100 us by the rule, on every channel; idle and neutral, 540 us from the throttle, do not."""
    any_host.tick()
    ours = list(PILOT)
    ours[channel] += away_us
    assert any_host.ask(tuple(ours), PILOT) == state
    assert any_host.safety.has_pilot
    assert any_host.ask(SAFE, PILOT) == "SAFE"


def test_one_command_off_the_sticks_ends_the_count(any_host):
    """0 1 1 x 1 1 1 1 1 with x far off: all later ones match, and there is no new edge."""
    any_host.tick()
    for engage, channels in ((0, FLY), (1, FLY), (1, FLY), (1, (1900, *FLY[1:])), *[(1, FLY)] * 9):
        any_host.send(bool(engage), channels)
    assert any_host.safety.state == "SAFE"
    assert any_host.ask() == "ACTIVE"


def test_the_switch_engages_at_any_command_without_a_pilot_only(tmp_path_factory):
    """ENGAGE_WITHOUT_PILOT: cruise throttle engages where no pilot is measured, and where one is,
    the sticks count as ever.
    """
    library = build(tmp_path_factory.mktemp("switch"), "-DENGAGE_WITHOUT_PILOT=1")
    for safety in (Safety(SafetyConfig(engage_without_pilot=1)), HostSafety(library)):
        host = Host(safety)
        host.tick()
        assert host.ask((1550, 1900, 1500, 1500)) == "ACTIVE"
        host.send(False)
        assert host.ask((1550, 1900, 1500, 1500), SAFE) == "SAFE"
        assert host.ask(PILOT, PILOT) == "ACTIVE"


@pytest.mark.parametrize("channel", range(4))
@pytest.mark.parametrize(("moved_us", "state"), [(120, "ACTIVE"), (121, "SAFE"), (-121, "SAFE")])
def test_a_moved_stick_is_safe_in_the_same_frame(any_host, channel, moved_us, state):
    """12 % of 1000 us from where it was at the engagement, on every channel; no slew on the way
    out, and a host that goes on asking gets nothing.
    """
    any_host.tick()
    assert any_host.ask(PILOT, PILOT) == "ACTIVE"
    assert any_host.tick(22.0, PILOT) != SAFE
    stick = list(PILOT)
    stick[channel] += moved_us
    assert (any_host.tick(22.0, tuple(stick)) == SAFE) == (state == "SAFE")
    assert any_host.safety.state == state
    assert any_host.safety.pilot_took_over == (state == "SAFE")
    for _ in range(20):
        any_host.send(True, tuple(stick), wait_ms=28)
        any_host.tick(22.0, tuple(stick))
    assert any_host.safety.state == state


def test_a_slow_stick_is_a_moved_stick(any_host):
    """Ten microseconds a frame: judged by where it was at the engagement, not by the last frame."""
    any_host.tick()
    assert any_host.ask(PILOT, PILOT) == "ACTIVE"
    states = []
    for k in range(1, 15):
        any_host.send(True, PILOT, wait_ms=10)
        any_host.tick(12.0, (PILOT[0] - 10 * k, *PILOT[1:]))
        states.append(any_host.safety.state)
    assert states == ["ACTIVE"] * 12 + ["SAFE"] * 2


def test_after_a_take_over_the_host_asks_anew_near_the_new_sticks(any_host):
    """Edge, five commands and the place where the sticks are now."""
    any_host.tick()
    assert any_host.ask(PILOT, PILOT) == "ACTIVE"
    moved = (PILOT[0] - 300, *PILOT[1:])
    any_host.tick(22.0, moved)
    any_host.send(True, PILOT)
    assert any_host.safety.pilot_took_over
    assert any_host.ask(PILOT, moved) == "SAFE"
    assert not any_host.safety.pilot_took_over
    assert any_host.ask(moved, moved) == "ACTIVE"


def test_a_signal_that_stops_is_no_movement_and_no_pilot(any_host):
    """It leaves ACTIVE as it is and is not fresh 100 ms later; when it returns, its sticks are
    compared with those of the engagement.
    """
    any_host.tick()
    assert any_host.ask(PILOT, PILOT) == "ACTIVE"
    for _ in range(5):
        any_host.send(True, PILOT, wait_ms=10)
        any_host.tick(12.0)
    assert any_host.safety.state == "ACTIVE"
    any_host.send(True, PILOT, wait_ms=50)
    any_host.tick(0.0)
    assert not any_host.safety.has_pilot
    any_host.tick(1.0, (PILOT[0], PILOT[1] + 130, *PILOT[2:]))
    assert any_host.safety.state == "SAFE"


@pytest.mark.parametrize(("age_ms", "state"), [(99.999, "SAFE"), (100.0, "ACTIVE")])
def test_a_signal_is_fresh_for_100_ms(any_host, age_ms, state):
    """While it is fresh idle does not engage against sticks in flight; then it does."""
    any_host.tick(0.0, PILOT)
    any_host.tick(age_ms)
    assert any_host.safety.has_pilot == (state == "SAFE")
    assert any_host.ask() == state


def test_a_signal_that_begins_in_flight_defines_where_the_sticks_are(any_host):
    """Engaged without one, at idle: the first frame is the reference, wherever it is."""
    any_host.tick()
    assert any_host.ask() == "ACTIVE"
    any_host.tick(1.0, PILOT)
    any_host.tick(1.0, (PILOT[0] + 120, *PILOT[1:]))
    assert any_host.safety.state == "ACTIVE"
    any_host.tick(1.0, (PILOT[0] + 121, *PILOT[1:]))
    assert any_host.safety.state == "SAFE"


def test_a_pilot_with_fewer_channels_is_no_pilot(tmp_path_factory):
    """Eight slots go out; the radio's six cannot be compared with them."""
    library = build(tmp_path_factory.mktemp("eight"), "-DCHANNELS=8")
    for safety in (Safety(SafetyConfig(channels=8)), HostSafety(library)):
        safety.tick(0, (1500,) * 6)
        assert not safety.has_pilot
        safety.tick(1, (1500,) * 8)
        assert safety.has_pilot


# ---- disturbed memory of the firmware's machine ----


@pytest.mark.parametrize("state", ["SAFE", "ACTIVE", "LOST"])
def test_any_flipped_bit_of_the_machine_is_a_fault_with_safe_slots(tmp_path_factory, state):
    """Every bit of the object, one at a time: the seal finds it before the next frame or tick does
    anything, and the host's commands, which go on, do not engage.
    """
    library = build(tmp_path_factory.getbasetemp() / "shipped")
    size = HostSafety(library).size
    assert 60 < size < 256
    for byte in range(size):
        for bit in range(8):
            host = Host(HostSafety(library))
            host.tick(0.0, PILOT)
            if state != "SAFE":
                assert host.ask(PILOT, PILOT) == "ACTIVE"
            if state == "LOST":
                host.tick(201.0, PILOT)
            assert host.safety.state == state
            host.safety.flip(byte, bit)
            if bit % 2:
                host.send(True, PILOT, wait_ms=1)
            assert host.tick(1.0, PILOT) == SAFE, (byte, bit)
            assert (host.safety.state, host.safety.fault) == ("FAULT", "memory")
            host.send(True, PILOT, wait_ms=1)
            assert host.tick(1.0, PILOT) == SAFE
            host.safety.close()


def test_slots_move_at_most_a_slew_per_frame():
    """By hand: 1000 -> 1900 with 250 a frame is 1250 1500 1750 1900; the ceiling cuts throttle at
    1600.
    """
    host = Host(Safety(SafetyConfig(throttle_ceiling_us=1600)))
    host.tick()
    host.engage().send(True, (1900, 1000, 2100, 900))
    frames = [host.tick(22.0) for _ in range(4)]
    assert [slots[0] for slots in frames] == [1250, 1500, 1600, 1600]
    assert [slots[1] for slots in frames] == [1250, 1000, 1000, 1000]
    assert [slots[2] for slots in frames] == [
        1750,
        2000,
        2000,
        2000,
    ]  # valid, but cut to CHANNEL_MAX_US
    assert [slots[3] for slots in frames] == [1250, 1000, 1000, 1000]


def test_a_high_ceiling_does_not_lift_the_limit_of_the_channel():
    """By the rule the throttle has both limits: 2100 is valid and goes out as CHANNEL_MAX_US."""
    host = Host(Safety(SafetyConfig(throttle_ceiling_us=2100, slew_us=2000)))
    host.tick()
    host.engage().send(True, (2100, 1500, 1500, 1500))
    assert host.tick() == (2000, 1500, 1500, 1500)


def test_silence_begins_and_ends_as_told():
    """1 s after the last valid frame, in LOST and in SAFE; never before the host was there; any
    valid frame ends it.
    """
    host = Host(Safety(SafetyConfig(silent_after_ms=1000)))
    assert host.tick() == host.tick(5000.0) == SAFE
    host.engage()
    assert host.tick(999.999) == SAFE
    assert host.tick(0.001) is None
    assert host.safety.state == "LOST" and host.safety.silent
    host.send(True)
    assert host.tick() == SAFE
    host.send(False)
    assert host.tick(1000.0) is None
    assert host.safety.state == "SAFE"


@pytest.mark.parametrize("program", ["Python", "C++"])
def test_nothing_comes_back_after_the_clock_has_gone_round(tmp_path_factory, program):
    """The board's 32 bits wrap after 71.6 minutes: a silence stays, and an old edge or violation is
    not young again.
    """
    if program == "Python":
        safety = Safety(SafetyConfig(silent_after_ms=1000))
    else:
        safety = HostSafety(build(tmp_path_factory.mktemp("host"), "-DSILENT_AFTER_MS=1000"))
    host = Host(safety)
    host.tick()
    start = host.now
    for _ in range(4):
        host.send(False, OUT, wait_ms=1)
    host.send(False, wait_ms=1)
    host.send(True, wait_ms=1)  # an edge
    host.tick(1100.0)  # silent from here on
    for _ in range(195):
        assert host.tick(22_000.0) is None
    while (
        not 10 * MS < (host.now - start) % CLOCK < 1000 * MS
    ):  # once round, and just behind all that was sent
        assert host.tick(0.5) is None
    host.send(True, OUT, wait_ms=0)
    assert states_after(host, [1] * 4, wait_ms=1) == ["SAFE"] * 4


def test_a_board_that_cannot_be_is_refused():
    """Throttle in a slot that there is not."""
    with pytest.raises(InputError, match="4 to 8 channels"):
        SafetyConfig(throttle_channel=4)


def test_settings_are_those_of_the_firmware():
    """Each default stands in config.h under the same name, and the shipped calibration fits the
    frame made there.
    """
    text = (FIRMWARE / "trainer_bridge" / "config.h").read_text(encoding="utf-8")
    settings = dict(re.findall(r"^#define (\w+) ([\d, ]+)", text, re.MULTILINE))
    ours = {
        field.name.upper(): getattr(SafetyConfig(), field.name)
        for field in dataclasses.fields(SafetyConfig)
    }
    ours["SAFE_SLOTS_US"] = ", ".join(map(str, ours.pop("SAFE_US")))
    shipped = load_calibration()
    ours |= {
        "FRAME_US": shipped.frame_us,
        "GAP_PULSE_US": shipped.gap_us,
        "POLARITY": shipped.polarity,
    }
    assert {name: str(value) for name, value in ours.items()} == {
        name: settings[name].strip() for name in ours
    }
    assert shipped.channels == SafetyConfig().channels
    assert (SafetyConfig().valid_min_us, SafetyConfig().valid_max_us) == VALID_US
    assert (SafetyConfig().channel_min_us, SafetyConfig().channel_max_us) == SENT_US


# ---- the same traces through the firmware's C++ ----

VARIANTS = {
    "shipped": ("", SafetyConfig(), 1000),
    "silent": ("-DSILENT_AFTER_MS=1000", SafetyConfig(silent_after_ms=1000), 250),
    "other": (
        "-DCHANNELS=8 -DSLEW_US=37 -DTHROTTLE_CEILING_US=1600 -DTHROTTLE_CHANNEL=2 "
        "-DSAFE_SLOTS_US=1500,1500,1100,"
        "1500,1500,1500,1500,1500 -DHOST_TIMEOUT_MS=100 -DENGAGE_FRAMES=3 -DENGAGE_WINDOW_MS=150",
        SafetyConfig(
            channels=8,
            slew_us=37,
            throttle_ceiling_us=1600,
            throttle_channel=2,
            safe_us=(1500, 1500, 1100, *[1500] * 5),
            host_timeout_ms=100,
            engage_frames=3,
            engage_window_ms=150,
        ),
        250,
    ),
}
GAPS_MS = (
    50,
    50,
    50,
    50,
    20,
    1,
    99.999,
    100,
    125,
    124.999,
    199.999,
    200,
    200.001,
    240,
    400,
    999.999,
    1000,
    1100,
    2500,
)
STEPS = (0, -1, 2, 32767, 32768, -32767, 1000)


class Sent(NamedTuple):
    """A command in a trace; a tick has the pilot's sticks or None in its place."""

    sequence: int
    engage: bool
    channels_us: tuple[int, ...]


def random_trace(rng, config, frames=120):
    """A hostile host: (time, sequence, engage, channels) in random moods; the pilot's sticks or
    None for the ticks in between.
    """
    now = int(rng.integers(CLOCK)) if rng.random() < 0.5 else CLOCK - int(rng.integers(20_000_000))
    start, next_tick, sequence, engage = (
        now,
        now + int(rng.integers(22_000)),
        int(rng.integers(65536)),
        False,
    )
    events, mood = [], "calm"
    # Half of the traces have a pilot, and most hosts ask near the sticks, or near idle.
    safe = config.safe_us[: config.channels]
    sticks = tuple(int(us) for us in rng.integers(1000, 2001, 8)) if rng.random() < 0.5 else None
    for _ in range(frames):
        if rng.random() < 0.15:
            mood = str(
                rng.choice(["calm", "calm", "calm", "flicker", "gaps", "outside", "jumps", "mixed"])
            )
            engage = bool(rng.random() < 0.5) if mood != "calm" else engage
        wild = {
            name: mood == name or (mood == "mixed" and rng.random() < 0.3)
            for name in ("gaps", "outside", "jumps")
        }
        engage = (
            bool(rng.random() < 0.5)
            if mood == "flicker" or rng.random() < 0.1
            else engage or rng.random() < 0.3
        )
        gap_ms = rng.choice(GAPS_MS) if wild["gaps"] or rng.random() < 0.02 else rng.uniform(10, 60)
        now += round(float(gap_ms) * MS)
        while next_tick <= now:
            # A frame and a tick may fall on one microsecond, in either order.
            if next_tick == now and rng.random() < 0.5:
                break
            if sticks and rng.random() < 0.02:
                sticks = tuple(int(us + rng.integers(-130, 131)) for us in sticks)
            is_measured = sticks is not None and (mood != "gaps" or rng.random() < 0.2)
            events.append((next_tick % CLOCK, sticks if is_measured else None))
            next_tick += 22_000 if rng.random() < 0.9 else max(1, now - next_tick)
        sequence = (
            sequence + (int(rng.choice(STEPS)) if wild["jumps"] and rng.random() < 0.5 else 1)
        ) % 65536
        count = config.channels if rng.random() < 0.99 else int(rng.integers(4, 9))
        channels = [
            int(us) for us in rng.choice([900, 1000, 1100, 1500, 1700, 2000, 2100, 1234], count)
        ]
        if rng.random() < 0.97:
            near = np.array((sticks or safe)[: config.channels])
            spread = 20 if sticks is None else 60
            channels = (near + rng.integers(-spread, spread + 1, len(near))).tolist()
            count = len(channels)
        if wild["outside"] and rng.random() < 0.6:
            channels[int(rng.integers(count))] = int(rng.choice([899, 2101, 0, 65535]))
        events.append((now % CLOCK, Sent(sequence, bool(engage), tuple(channels))))
    return start % CLOCK, events


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_firmware_gives_the_same_answers(tmp_path_factory, variant):
    """Two programs written apart from one text; verdict, state, fault, slots and silence after
    every event.

    The count of transitions shows that the traces went everywhere, and that nothing became ACTIVE
    but from SAFE.
    """
    defines, config, traces = VARIANTS[variant]
    library = build(tmp_path_factory.mktemp("host"), defines)
    rng = np.random.default_rng(5)
    seen = Counter()
    for number in range(traces):
        start, events = random_trace(rng, config)
        stalled = bool(rng.random() < 0.2)
        ours, theirs = (
            Safety(config, start, watchdog_reset=stalled),
            HostSafety(library, start, watchdog_reset=stalled),
        )
        for step, (now, command) in enumerate(events):
            before = ours.state
            answers = [
                each.frame(now, *command) if isinstance(command, Sent) else each.tick(now, command)
                for each in (ours, theirs)
            ]
            where = (variant, number, step, now, command, before)
            assert answers[0] == answers[1], where
            assert (ours.state, ours.fault) == (theirs.state, theirs.fault), where
            assert ours.has_pilot == theirs.has_pilot, where
            assert ours.pilot_took_over == theirs.pilot_took_over, where
            took_over = not isinstance(command, Sent) and (before, ours.state) == ("ACTIVE", "SAFE")
            seen["took over"] += took_over
            seen[before, ours.state] += before != ours.state
            seen["silent"] += answers[0] is None
        theirs.close()
    expected = {
        ("BOOT", "SAFE"),
        ("SAFE", "ACTIVE"),
        ("ACTIVE", "SAFE"),
        ("ACTIVE", "LOST"),
        ("LOST", "SAFE"),
    }
    expected |= {("FAULT", "SAFE")} | {(state, "FAULT") for state in ("SAFE", "ACTIVE", "LOST")}
    assert all(seen[each] >= traces // 50 for each in expected), seen
    assert not any(seen[before, "ACTIVE"] for before in ("BOOT", "LOST", "FAULT")), seen
    assert seen["took over"] >= traces // 50, seen
    assert (seen["silent"] > 100) == (config.silent_after_ms > 0)
