"""The firmware's thinking part on this computer: under sanitizers, and its pulses and pilots worked
out by hand.
"""

import ctypes
import os
import shutil
import subprocess
from itertools import accumulate, pairwise
from pathlib import Path

import numpy as np
import pytest

FIRMWARE = Path(__file__).resolve().parents[2] / "firmware"
FRAME_US, GAP_US = 22000, 400
STICKS = (1000, 1500, 1234, 2000)


def make(target, out):
    """`make` in firmware/, into a folder of the test's."""
    missing = [tool for tool in ("make", "g++") if shutil.which(tool) is None]
    if missing:
        (pytest.fail if os.environ.get("CI") else pytest.skip)(
            f"{' and '.join(missing)} missing: apt-get install them"
        )
    command = ["make", "-s", "-C", str(FIRMWARE), target, f"OUT={out}"]
    return subprocess.run(command, capture_output=True, text=True, timeout=280, check=False)


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """firmware/host_tests/host_api.h."""
    out = tmp_path_factory.mktemp("host")
    done = make("host-lib", out)
    assert done.returncode == 0, done.stderr
    library = ctypes.CDLL(str(out / "libtrainer_bridge.so"))
    for name in ("ppm_out_new", "pilot_ppm_new", "pilot_spektrum_new"):
        getattr(library, name).restype = ctypes.c_void_p
    return library


def test_a_million_broken_frames_are_refused_under_sanitizers(tmp_path):
    """AddressSanitizer and UndefinedBehaviorSanitizer are independent; claims in host_test.cpp."""
    done = make("host-test", tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "1000000 corrupted frames: 0 accepted; every valid frame" in done.stdout
    assert "1000000 buffers of random bytes: 0 accepted" in done.stdout
    assert done.stdout.endswith("host tests: all passed\n")


class Pulses:
    """The firmware's PPM out, edge by edge."""

    def __init__(self, library):
        self._library, self._self = library, ctypes.c_void_p(library.ppm_out_new())

    def next(self, silent=False):
        """The next edge: (us after the one before, whether a pulse begins there)."""
        ticks = ctypes.c_uint16()
        slots = (ctypes.c_uint16 * len(STICKS))(*STICKS)
        pulse = self._library.ppm_out_next(self._self, slots, int(silent), ctypes.byref(ticks))
        return ticks.value / 2, bool(pulse)

    @property
    def frames(self):
        return self._library.ppm_out_frames(self._self)

    @property
    def at_start(self):
        return bool(self._library.ppm_out_at_frame_start(self._self))


def test_a_frame_is_what_the_drawing_says(library):
    """By hand: 400 us of pulse and the rest of each slot; the pause is 22000 - (1000 + 1500 + 1234
    + 2000) - 400.
    """
    pulses = Pulses(library)
    assert pulses.next() == (22000, True)
    assert [pulses.next() for _ in range(10)] == [
        *[
            (400, False),
            (600, True),
            (400, False),
            (1100, True),
            (400, False),
            (834, True),
            (400, False),
            (1600, True),
        ],
        *[(400, False), (22000 - 5734 - 400, True)],
    ]
    assert pulses.at_start
    assert pulses.frames == 1


def test_silence_finishes_its_frame_and_ends_with_a_whole_one(library):
    """Half a frame is worse than none: pulses stop at a frame's end, and come back at the next
    start.
    """
    pulses = Pulses(library)
    pulses.next()
    assert [pulses.next(silent=True)[1] for _ in range(10)] == [False, True] * 4 + [False, False]
    assert pulses.frames == 1
    for _ in range(3):
        assert pulses.at_start
        assert pulses.next(silent=True) == (22000, False)
    assert pulses.next() == (22000, True)
    assert [pulses.next()[1] for _ in range(10)] == [False, True] * 5
    assert pulses.frames == 2


class PilotPulses:
    """Falling edges into the firmware's PPM decoder; the capture register wraps as in the chip."""

    def __init__(
        self, library, start_us=4_294_900_000
    ):  # near the end of the clock's 32 bits: it wraps in the test
        self._library, self._self, self.now = (
            library,
            ctypes.c_void_p(library.pilot_ppm_new()),
            start_us,
        )

    def edge(self, after_us):
        """An edge a while after the one before: the frame it completed, or ()."""
        self.now += after_us
        channels = (ctypes.c_uint16 * 8)()
        ticks, now = (
            ctypes.c_uint16(round(2 * self.now) % 65536),
            ctypes.c_uint32(int(self.now) % 2**32),
        )
        n = self._library.pilot_ppm_edge(self._self, ticks, now, channels)
        return tuple(channels[:n])

    def frame(self, slots, pause_us=None):
        """A frame's edges after its pause: the frame that the first of them completed, which is the
        one before.
        """
        got = self.edge(FRAME_US - sum(STICKS) if pause_us is None else pause_us)
        assert [self.edge(slot) for slot in slots] == [()] * len(slots)
        return got

    @property
    def rejected(self):
        return self._library.pilot_ppm_rejected(self._self)


@pytest.fixture
def pilot(library):
    """A decoder that has seen five good frames, one of them not ended yet."""
    pilot = PilotPulses(library)
    assert [pilot.frame(STICKS) for _ in range(5)] == [(), (), (), STICKS, STICKS]
    assert pilot.rejected == 0
    return pilot


@pytest.mark.parametrize("n", [4, 5, 6, 8])
def test_the_number_of_slots_is_learnt_from_three_frames(library, n):
    """Radios send four to eight; the fourth pause ends the third whole frame."""
    pilot, sticks = PilotPulses(library), tuple(1100 + 100 * k for k in range(n))
    assert [pilot.frame(sticks, 22000 - sum(sticks)) for _ in range(5)] == [
        (),
        (),
        (),
        sticks,
        sticks,
    ]


@pytest.mark.parametrize("lost", range(5))
def test_a_missing_pulse_loses_its_frame_only(pilot, lost):
    """Two slots run together are over 2200 us; the first or last pulse takes a slot away, and the
    pause grows.
    """
    edges = [0, *accumulate(STICKS)]
    del edges[lost]
    before = pilot.edge(FRAME_US - sum(STICKS) + edges[0])
    assert before == STICKS  # the one before was whole
    assert [pilot.edge(b - a) for a, b in pairwise(edges)] == [()] * 3
    assert pilot.frame(STICKS, FRAME_US - edges[-1]) == ()
    assert pilot.rejected == 1
    assert pilot.frame(STICKS) == STICKS


@pytest.mark.parametrize("at_us", [150, 500, 1000 + 750, 2500 + 617, 3734 + 1000, 5734 + 1500])
def test_an_extra_pulse_loses_its_frame_only(pilot, at_us):
    """A slot cut in two is under 800 us or makes five slots; in the pause it makes a fifth slot."""
    edges = sorted([0, *accumulate(STICKS), at_us])
    assert pilot.edge(FRAME_US - sum(STICKS)) == STICKS
    assert [pilot.edge(b - a) for a, b in pairwise(edges)] == [()] * 5
    assert pilot.frame(STICKS, FRAME_US - edges[-1]) == ()
    assert pilot.rejected == 1
    assert pilot.frame(STICKS) == STICKS


def test_a_lost_signal_makes_no_frame_of_what_was_before(pilot):
    """32.768 ms after an edge the timer shows the same number again: 33.768 ms must not look like a
    slot of 1 ms.
    """
    assert pilot.edge(33768) == ()
    assert [pilot.edge(slot) for slot in STICKS] == [()] * 4
    assert pilot.frame(STICKS) == STICKS
    assert pilot.rejected == 0


def test_captured_slots_are_right_to_half_a_tick(pilot):
    """The timer counts half microseconds, and a microsecond's rounding is half of one at most."""
    rng = np.random.default_rng(5)
    sent = [rng.integers(2 * 1000, 2 * 2000, 4) / 2 for _ in range(200)]
    got = [pilot.frame(slots, 12000) for slots in [*sent, STICKS]][1:]
    assert np.abs(np.array(got) - np.array(sent)).max() <= 0.5


class Spektrum:
    """Bytes into the firmware's decoder of remote receivers, at 115200 baud."""

    def __init__(self, library):
        self._library, self._self, self.now = (
            library,
            ctypes.c_void_p(library.pilot_spektrum_new()),
            0,
        )

    def frame(self, data, pause_us=11000):
        """What a frame's bytes completed, or ()."""
        channels, got = (ctypes.c_uint16 * 8)(), ()
        self.now += pause_us
        for value in data:
            n = self._library.pilot_spektrum_byte(
                self._self, value, ctypes.c_uint32(self.now), 4, channels
            )
            got = got or tuple(channels[:n])
            self.now += 87
        return got

    @property
    def rejected(self):
        return self._library.pilot_spektrum_rejected(self._self)


def spektrum_frame(words):
    """Two bytes of fades and seven words, high byte first; unused ones are all ones."""
    return b"\0\xb2" + b"".join(word.to_bytes(2, "big") for word in [*words, *[0xFFFF] * 7][:7])


# Channel number << 11 | position. Ends and middle of the stick in Spektrum's text: 903 us +
# position x 1194 / 2048.
WORDS = (0 << 11 | 0, 1 << 11 | 1024, 2 << 11 | 2047, 3 << 11 | 512)
WORDS_US = (903, 1500, 2096, 1201)


def test_spektrum_frame_by_hand(library):
    """903, 903 + 597, 903 + 1193.4 and 903 + 298.5, cut to whole microseconds."""
    assert Spektrum(library).frame(spektrum_frame(WORDS)) == WORDS_US


def test_spektrum_channels_may_come_in_two_frames(library):
    """A radio alternates frames of more than seven channels; reports need all four channels."""
    spektrum = Spektrum(library)
    assert spektrum.frame(spektrum_frame(WORDS[:2])) == ()
    assert spektrum.frame(spektrum_frame(WORDS[2:])) == WORDS_US
    assert spektrum.frame(spektrum_frame([1 << 11])) == (903, 903, 2096, 1201)


@pytest.mark.parametrize(
    "data",
    [
        spektrum_frame(WORDS)[:15],  # cut short
        spektrum_frame([WORDS[0], WORDS[0], *WORDS[1:]]),  # a channel twice
        spektrum_frame([*WORDS, 13 << 11]),  # there are twelve channels
    ],
)
def test_broken_spektrum_frames_are_refused(library, data):
    """There is no checksum, so the form has to do: 16 bytes, each channel once, no channel above
    11.
    """
    spektrum = Spektrum(library)
    assert spektrum.frame(data) == ()
    assert spektrum.frame(spektrum_frame(WORDS)) == WORDS_US
    assert spektrum.rejected == 1


def test_spektrum_joined_in_the_middle_waits_for_a_pause(library):
    """The half frame that was heard is no frame, and the next one is."""
    spektrum = Spektrum(library)
    assert spektrum.frame(spektrum_frame(WORDS)[7:], pause_us=0) == ()
    assert spektrum.frame(spektrum_frame(WORDS)) == WORDS_US
