"""Safety state machine: every rule by hand, and the same answers as the firmware's C++ over random
traces.
"""

import dataclasses
import re
from collections import Counter

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.trainer_port import Safety, SafetyConfig, SafetyDecision, load_calibration
from falconwing_kit.trainer_port.ppm import SENT_US, VALID_US
from tests.trainer_port.host_library import FIRMWARE, HostSafety, build

MS, CLOCK = 1000, 2**32
SAFE = (1000, 1500, 1500, 1500)
FLY = (1200, 1600, 1400, 1500)
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

    def tick(self, wait_ms=0.0):
        self.now = (self.now + round(wait_ms * MS)) % CLOCK
        return self.safety.tick(self.now)

    def engage(self):
        """From SAFE to ACTIVE in the shortest way."""
        for flag in (False, True, True, True, True, True):
            self.send(flag)
        assert self.safety.state == "ACTIVE"
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
    host.send(True, (1100, 1700, 1400, 1500))
    assert host.safety.state == "ACTIVE"
    assert host.tick() == (1100, 1700, 1400, 1500)


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


def random_trace(rng, config, frames=120):
    """A hostile host: (time, sequence, engage, channels) in random moods, and None for the ticks in
    between.
    """
    now = int(rng.integers(CLOCK)) if rng.random() < 0.5 else CLOCK - int(rng.integers(20_000_000))
    start, next_tick, sequence, engage = (
        now,
        now + int(rng.integers(22_000)),
        int(rng.integers(65536)),
        False,
    )
    events, mood = [], "calm"
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
            events.append((next_tick % CLOCK, None))
            next_tick += 22_000 if rng.random() < 0.9 else max(1, now - next_tick)
        sequence = (
            sequence + (int(rng.choice(STEPS)) if wild["jumps"] and rng.random() < 0.5 else 1)
        ) % 65536
        count = config.channels if rng.random() < 0.99 else int(rng.integers(4, 9))
        channels = [
            int(us) for us in rng.choice([900, 1000, 1100, 1500, 1700, 2000, 2100, 1234], count)
        ]
        if wild["outside"] and rng.random() < 0.6:
            channels[int(rng.integers(count))] = int(rng.choice([899, 2101, 0, 65535]))
        events.append((now % CLOCK, (sequence, bool(engage), tuple(channels))))
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
                each.tick(now) if command is None else each.frame(now, *command)
                for each in (ours, theirs)
            ]
            where = (variant, number, step, now, command, before)
            assert answers[0] == answers[1], where
            assert (ours.state, ours.fault) == (theirs.state, theirs.fault), where
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
    assert (seen["silent"] > 100) == (config.silent_after_ms > 0)
