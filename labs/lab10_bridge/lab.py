# %% [markdown]
# # Lab 10: the trainer port
#
# ![Who flies, over six seconds: the state goes between SAFE, ACTIVE and LOST as commands come and fail](goal.webp)
#
# *What you will have at the end (open course).*
#
# A computer flies, but a person is responsible. Between the two sits a small board: it takes the computer's commands
# from a USB cable and gives them to the transmitter's *trainer port*. The pilot's transmitter sends them on to the
# aircraft (paper, section III). In this lab you write the board's three duties, and the computer's check of
# the video by which it flies.
#
# **You will be able to**
# - write and read a PPM signal, pulse by pulse, with the timer of a real micro-controller;
# - design a state machine that hands back when the computer, the cable or the picture fails;
# - build a parser that reads a noisy line in any pieces, and the board's program around it;
# - say what the paper's video monitor sees, and what it does not.
#
# **Time** 4 hours. **Before** lab 2 (what an image is); no hardware is needed. All data here is **simulated**.
#
# **How it works** Write the functions in place of `raise NotImplementedError`. Each is followed by a `check(...)` cell
# that reports which claims hold. Run it as often as you like.

# %%
import numpy as np
from given import (
    BLOCK_PX,
    C1,
    C2,
    CENTRE_US,
    COMMAND,
    ENGAGE_FRAMES,
    FRAME_US,
    FROZEN_LEVELS,
    GAP_US,
    IDLE_US,
    LIMITS_US,
    LOST_MS,
    MAX_FRAME,
    MOVED_US,
    NEAR_US,
    PAUSE_US,
    RANGE_US,
    REACH_US,
    SAFE_US,
    SLEW_US,
    STICKS,
    TICKS_PER_US,
    TIMER,
    VALID_US,
    WINDOW_MS,
    board_states,
    bytes_of_faults,
    crc16,
    first_edges,
    kit_bridge,
    plot_frame,
    plot_monitor,
    plot_takeover,
    run_bridge,
    scene_of_faults,
    switched_on,
    video,
    with_faults,
)

from falconwing_kit.tools.bridge import PythonBoard
from falconwing_kit.tools.grading import check
from falconwing_kit.trainer_port import encode_channels

print(
    f"This course: pulse {GAP_US:g} us, middle {CENTRE_US:g} us, LOST after {LOST_MS:g} ms, "
    f"near is {NEAR_US:g} us"
)

# %%
from given import moving_wire

from falconwing_kit.tools.grading import borrow, keep_going

keep_going()  # a missing function stops only the cells that need it
moving_wire()

# %% [markdown]
# *In words: above, four bars, the sticks, swing to both sides. Below, a wire with five short low pulses; the distance of
# two pulses is one stick, so they move apart and together, and the whole frame grows and shrinks.*

# %% [markdown]
# ## 1. One frame on the wire
#
# PPM (pulse position modulation) sends all sticks over one wire. The wire rests high. A frame is a train of short low
# pulses, and **the time from the start of one pulse to the start of the next is a channel**:
#
# ```
# _   _____   _______   ____   _______   _____________________   ___
#  |_|  ch1 |_|  ch2  |_| ch3|_|  ch4  |_|       pause         |_|
# ```
#
# Four channels need five pulses: the last one only ends channel 4. Then comes a long pause, and after 22 ms the next
# frame begins.
#
# A stick at position $s$, from $-1$ to $1$, makes a slot of $\;T = T_0 + 500\,\mathrm{us}\cdot s\;$ with the middle
# $T_0$ = `CENTRE_US`, rounded to a whole microsecond. The throttle runs from 0 to 1 and uses the whole slot: 0 is at
# $T_0 - 500$ us and 1 is at $T_0 + 500$ us.
#
# The board makes the edges with a timer. It counts every half microsecond (`TICKS_PER_US` = 2) and has 16 bits:
# behind 65535 comes 0. To put an edge on the wire, the program writes the count at which it shall happen. So your
# function returns *counts*, and they wrap.
#
# Two rules keep the aircraft safe. A stick beyond its end is cut to its end. If any stick is not a finite number, the
# whole command cannot be trusted: throttle 0 and the other sticks in the middle.


# %% exercise="encode_ppm"
def encode_ppm(sticks: dict[str, float], order: str, start_tick: int) -> np.ndarray:
    """Timer counts of all edges of one PPM frame.

    Args:
        sticks: "throttle" 0..1, and "aileron", "elevator", "rudder" -1..1.
        order: first letters of the sticks in the order of the slots, such as "TAER" or "AETR".
        start_tick: count of the first edge, 0..65535.

    Returns:
        (10,) whole numbers 0..65535: down, up, down, up ... of five pulses, each GAP_US wide.
    """
    # BEGIN SOLUTION
    if not all(np.isfinite(sticks[name]) for name in STICKS):
        sticks = dict.fromkeys(STICKS, 0.0)
    positions = {name[0].upper(): float(np.clip(sticks[name], -1.0, 1.0)) for name in STICKS}
    positions["T"] = 2.0 * max(positions["T"], 0.0) - 1.0
    slots_us = [round(CENTRE_US + REACH_US * positions[letter]) for letter in order]
    down = start_tick + TICKS_PER_US * np.concatenate([[0], np.cumsum(slots_us)])
    up = down + TICKS_PER_US * int(GAP_US)
    return np.column_stack([down, up]).ravel().astype(int) % TIMER
    # END SOLUTION


# %% check="encode_ppm"
check(encode_ppm)

# %% [markdown]
# ## 2. Reading the pilot's sticks
#
# The board also listens to the pilot's own PPM. A timer notes its count at the **first edge of each pulse**. Turn
# these counts back into channels. Three things make it hard: the counts wrap (no gap is longer than one turn of the
# timer), the reading may begin in the middle of a frame, and the wire is not perfect. A pulse gets lost, or a spark
# looks like one.
#
# The rule: **a gap of `PAUSE_US` or more is a pause. What stands between two pauses is a frame if it has exactly the
# right number of slots and each of them lies within `VALID_US`.** Everything else is left out. A wrong frame is worse
# than none: the old one is still there.


# %% exercise="decode_ppm"
def decode_ppm(ticks: np.ndarray, channels: int) -> np.ndarray:
    """Slots of all good frames in a stream of pulses.

    Args:
        ticks: (n,) count of the timer at the first edge of each pulse, 0..65535.
        channels: how many slots a frame has.

    Returns:
        (frames, channels) slots [us]; (0, channels) where there is no good frame.
    """
    # BEGIN SOLUTION
    gaps_us = (np.diff(ticks) % TIMER) / TICKS_PER_US
    pauses = np.flatnonzero(gaps_us >= PAUSE_US)
    frames = []
    for i in range(len(pauses) - 1):
        slots = gaps_us[pauses[i] + 1 : pauses[i + 1]]
        if len(slots) == channels and np.all((slots >= VALID_US[0]) & (slots <= VALID_US[1])):
            frames.append(slots)
    return np.array(frames).reshape(-1, channels)
    # END SOLUTION


# %% check="decode_ppm"
check(decode_ppm)

# %% [markdown]
# ### See it: one frame, and the timing
#
# The left plot is your frame. For the right one, 2000 simulated frames go over the wire twice: once with edges made
# by the timer itself (they are exact; only the count is rounded), once with edges made by a program that has other work
# too (each edge a little early or late, standard deviation 4 us). Your `decode_ppm` reads both. On a radio that shows
# as servos that tremble.

# %% figure="timing"
edges = encode_ppm({"throttle": 0.6, "aileron": -0.4, "elevator": 0.15, "rudder": 0.0}, "TAER", 0)
slots_us = np.random.default_rng(0).uniform(1000.0, 2000.0, (2000, 4))
errors_us = {}
for name, jitter_us in (("by the timer", 0.0), ("by a program", 4.0)):
    read_us = decode_ppm(first_edges(slots_us, jitter_us, seed=1), 4)
    errors_us[name] = (read_us - slots_us[1 : len(read_us) + 1]).ravel()
plot_frame(edges, errors_us)

# %% [markdown]
# *In words: left, a wire at rest with five short low pulses in the first 7 ms and then the pause, the four
# slots between them labelled in microseconds; right, slot errors as a histogram, within half a microsecond for the
# timer and spread over some 15 us on both sides for the program.*
#
# **Question on the figure.** Each edge of the program is off by 4 us, yet the slots are off by more. Why, and by what
# factor? And why does the timer do better, though it is the same chip that runs the program?

# %% [markdown] answer="timing_reading"
# A slot lies between two edges, and both are off: the standard deviation is 4 us times the root of two, 5.7 us. The
# timer compares its count with the one that the program wrote *beforehand*, and sets the wire by itself. So it does not
# matter if the program is busy at that moment, as long as it wrote the count in time.

# %% [markdown]
# Now the same with faults: of the pulses 2 % are lost, and behind 2 % there is a spark. A frame is good if none of its
# five pulses has either, so expect about $0.98^{10}$ = 82 % of 1000 frames, and none of them wrong.

# %%
sent_us = np.round(np.random.default_rng(2).uniform(1000.0, 2000.0, (1000, 4)))
kept_us = decode_ppm(with_faults(first_edges(sent_us), seed=3), 4)
wrong = [row for row in kept_us if not (sent_us == row).all(axis=1).any()]
print(f"{len(kept_us)} of {len(sent_us)} frames kept, {len(wrong)} of them wrong")

# %% [markdown]
# The kit has a simulated board that speaks the real serial protocol. Commands at 20 Hz go in, and pulses come out.
# Your decoder reads them. (`falconwing_kit/trainer_port` is the code that flies; look into it.) The kit's radio has its
# middle at 1500 us, whatever your course has. The board starts in `SAFE` (section 3), so the first slots are idle; the
# first and the last frame are missing, since your decoder has not seen a pause on both sides of them. The board engages
# only near the sticks of the pilot, which it measures on a pin of its own; a simulated pilot holds them there.

# %%
board = PythonBoard()
board.set_pilot((1400, 1600, 1500, 1500))
for step in range(40):
    board.write(
        encode_channels(step, (1400, 1600, 1500, 1500), engage=step > 5)
    )  # off first, then on
    board.run_until(0.05 * (step + 1))
edges_s = [t for frame in board.ppm_frames() for t in (frame.t_start, *frame.t_slots)]
on_wire_us = decode_ppm(np.round(1e6 * TICKS_PER_US * np.array(edges_s)).astype(int) % TIMER, 4)
print(f"{len(on_wire_us)} frames in 2 s. First: {on_wire_us[0]}, last: {on_wire_us[-1]} us")

# %% [markdown]
# ## 3. Who flies?
#
# A state machine on the board decides whether the computer (the *host*) flies. You write the machine that the board
# runs (`firmware/trainer_bridge/safety.cpp`), step by step of a PPM frame:
#
# | state | what goes to the radio |
# |---|---|
# | `SAFE` | throttle idle, sticks in the middle: `SAFE_US` |
# | `ACTIVE` | the host's last command |
# | `LOST` | as `SAFE`; the host must disengage before it may fly again |
#
# The board has two more, which also send `SAFE_US`: `BOOT` until its first frame, and `FAULT` after five commands out of
# range in a second, a disturbed memory, or a restart by its watchdog. `FAULT` ends as `LOST` does, by a command without
# engage, but a second later at the earliest.
#
# ### Taking over must move nothing
#
# A host that engages with full throttle is a start of the motor that nobody expects. So a command may engage only if
# it **matches**:
#
# - where the pilot's sticks are measured, every slot is within `NEAR_US` of the pilot's;
# - where they are not (no signal, or one too old), the throttle slot, the first one, is within `IDLE_US` of idle, and
#   the others are within `NEAR_US` of the middle. Idle and middle are `SAFE_US`.
#
# A limit itself still matches.


# %% exercise="matches"
def matches(command_us: tuple[float, ...], pilot_us: tuple[float, ...] | None) -> bool:
    """Whether a command may engage.

    Args:
        command_us: four slots of the host's command [us], the throttle first.
        pilot_us: four slots of the pilot's sticks [us], or None where they are not measured.

    Returns:
        True if taking over moves nothing by more than its limit.
    """
    # BEGIN SOLUTION
    if pilot_us is not None:
        return all(abs(a - b) <= NEAR_US for a, b in zip(command_us, pilot_us, strict=True))
    limits = (IDLE_US, NEAR_US, NEAR_US, NEAR_US)
    return all(abs(a - b) <= limit for a, b, limit in zip(command_us, SAFE_US, limits, strict=True))
    # END SOLUTION


# %% check="matches"
check(matches)

# %% [markdown]
# ### The machine
#
# It remembers six things in a dictionary: `state`; `engage`, the flag of the last valid command; `good`, how many
# matching commands in a row asked; `age_ms`, the time since the last valid command; `edge_ms`, the time since the first
# of these `good` commands; and `pilot_us`, where the pilot's sticks were at the engagement, or `None`.
#
# In every step, in this order:
#
# 1. **Time passes:** `age_ms` and `edge_ms` grow by the time of the step.
# 2. **The pilot**, in `ACTIVE` and if the sticks are measured: if `pilot_us` is `None`, they are remembered there. If
#    any of them is more than `MOVED_US` (12 % of the 1000 us of a stick) from there: `SAFE`. No computer flies against
#    the pilot, and the takeover needs one frame.
# 3. **Silence:** once `age_ms` is `LOST_MS` or more, `good` = 0, and `ACTIVE` becomes `LOST`.
# 4. **A valid command with engage off:** `SAFE`, and `good` = 0.
# 5. **A valid command with engage on**, in `SAFE` only. If `engage` was off before, this is the *edge*: `good` = 1 and
#    `edge_ms` = 0. Without an edge, `good` grows by 1 if it is at least 1 and `edge_ms` is less than `WINDOW_MS`; it is 0 if
#    the five take longer. A command that does not match sets `good` to 0. At `ENGAGE_FRAMES`: `ACTIVE`, `good` = 0, and
#    `pilot_us` becomes the pilot's sticks as they are measured now, or `None`.
# 6. Every valid command sets `age_ms` to 0 and `engage` to its flag.
#
# So after `LOST`, and after the pilot's takeover, a host that goes on asking gets nothing: there is no edge until it
# has let go.


# %% exercise="failsafe_state"
def failsafe_state(
    memory: dict,
    dt_ms: float,
    command_us: tuple[float, ...] | None,
    engage: bool,
    pilot_us: tuple[float, ...] | None,
) -> dict:
    """One step of the safety machine.

    Args:
        memory: "state" (text), "engage" (bool), "good" (int), "age_ms", "edge_ms" (float) and "pilot_us" (four slots
            or None), as the last step returned it.
        dt_ms: time since the last step [ms].
        command_us: four slots [us] of the valid command that came in this step; None without one.
        engage: its flag; means nothing without a command.
        pilot_us: four slots of the pilot's sticks [us]; None where they are not measured.

    Returns:
        The new memory, a dictionary with the same six keys. The old one stays as it is.
    """
    # BEGIN SOLUTION
    new = dict(memory, age_ms=memory["age_ms"] + dt_ms, edge_ms=memory["edge_ms"] + dt_ms)
    if new["state"] == "ACTIVE" and pilot_us is not None:
        if new["pilot_us"] is None:
            new["pilot_us"] = pilot_us
        if max(abs(a - b) for a, b in zip(pilot_us, new["pilot_us"], strict=True)) > MOVED_US:
            new["state"] = "SAFE"
    if new["age_ms"] >= LOST_MS:
        new["good"] = 0
        if new["state"] == "ACTIVE":
            new["state"] = "LOST"
    if command_us is None:
        return new
    if not engage:
        new["state"], new["good"] = "SAFE", 0
    elif new["state"] == "SAFE":
        if not memory["engage"]:
            new["good"], new["edge_ms"] = 1, 0.0
        elif new["good"] > 0:
            new["good"] = new["good"] + 1 if new["edge_ms"] < WINDOW_MS else 0
        if not matches(command_us, pilot_us):
            new["good"] = 0
        if new["good"] >= ENGAGE_FRAMES:
            new["state"], new["good"], new["pilot_us"] = "ACTIVE", 0, pilot_us
    return {**new, "age_ms": 0.0, "engage": engage}
    # END SOLUTION


# %% check="failsafe_state"
check(failsafe_state)

# %% [markdown]
# ### See it: dropouts and a takeover
#
# Six seconds with a short dropout, a long one, a host that disengages and asks with the wrong throttle, one that asks
# with the right one, and at the end a pilot who moves a stick while the host still sends engage.

# %% figure="takeover"
memory, states = switched_on(), []
for command_us, engage, pilot_us in scene_of_faults():
    memory = failsafe_state(memory, FRAME_US / 1000.0, command_us, engage, pilot_us)
    states.append(memory["state"])
plot_takeover(scene_of_faults(), states)

# %% [markdown]
# *In words: state over time; it goes from SAFE to ACTIVE, stays there through a short dropout, goes to LOST in
# a long one, stays LOST although commands come again, goes to SAFE when the host disengages, stays SAFE while it asks
# with the wrong throttle, goes to ACTIVE with the right one, and drops to SAFE in the frame in which the pilot moves a
# stick, and stays there.*

# %% [markdown]
# The kit's `Safety` is the model of the board's program; tests compare the two, trace by trace. The same six seconds
# through it, with your course's numbers:

# %%
board = board_states(scene_of_faults())
agree = sum(mine == its for mine, its in zip(states, board, strict=False))
print(f"The board's machine is in the same state in {agree} of {len(board)} frames")

# %% [markdown]
# ### Build it: the board's program
#
# Now the whole board, as a class of your own. It reads the serial line, byte by byte, and says what goes to the radio.
# How you build it is up to you: 30 to 80 lines, with as many methods and helpers as you like. Only the interface is
# fixed; the class's text states it. `failsafe_state` is yours to use.
#
# **On the line** a command is a *frame*: the bytes `COBS(payload + CRC)`, then one zero byte. All numbers have their low
# byte first.
#
# | payload | bytes | |
# |---|---|---|
# | type | 1 | `COMMAND`; any other type is not for you |
# | sequence | 2 | grows with every command; 0 follows 65535 |
# | flags | 1 | bit 0 is engage; the others may be anything |
# | slots | 4 x 2 | [us], the throttle first |
#
# - The **CRC** is a checksum of the payload, in 2 bytes: `crc16(payload)`. A frame whose CRC does not match is damaged.
# - **COBS** takes the zeros out, so that the only zero on the line is the end of a frame. `payload + CRC` is cut at its
#   zeros; each piece is sent behind one byte, which is its length plus one; the zeros are not sent. So
#   `11 22 00 33` becomes `03 11 22 02 33`, and `00` becomes `01 01`. To read it, jump from one such byte to the next:
#   what lies between them are the pieces, and between two pieces there was a zero. A jump beyond the end means damage.
#
# **A command is valid** if its frame is whole, its payload is exactly that long, every slot lies within `RANGE_US`,
# and its sequence is new: 1 to 32767 ahead of that of the last valid command, modulo 65536 (the first one may have any).
# Everything else is dropped, as if it had never come. It must not even keep the computer alive.
#
# **Bytes come as they like:** half a frame, three frames at once, noise in front, a byte missing. Whatever happened
# before, the next zero ends a frame and what follows is a new one. (On a board keep no more than `MAX_FRAME` bytes: a line
# that sends no zeros must not fill the memory.)
#
# **To the radio** goes, in `ACTIVE`, the last valid command: each slot cut to `LIMITS_US`, and no farther than `SLEW_US`
# from the same slot of the frame before, so that no servo jumps. In every other state it is `SAFE_US`, at once.


# %% exercise="TrainerBridge"
class TrainerBridge:
    """The board: bytes from the computer and the pilot's sticks in, slots for the radio out.

    TrainerBridge()              a board that was just switched on, at 0 ms

    .receive(data, t_ms)         bytes that came at t_ms, any number, cut anywhere; returns nothing
    .frame(t_ms, pilot_us)       a frame for the radio begins: its four slots [us], a tuple
        pilot_us: four slots of the pilot's sticks [us] as they are now; None: not measured
    .state                       "SAFE", "ACTIVE" or "LOST", as the last call left it

    Times never go back. `frame` is called every 22 ms or so, and before the first bytes. A command
    that is complete at t_ms is a step of the machine then, with the pilot's sticks of the last
    frame; each frame is a step without a command.
    """

    def __init__(self) -> None:
        # BEGIN SOLUTION
        self._memory = switched_on()
        self._part = b""  # bytes since the last zero
        self._sequence: int | None = None  # of the last valid command
        self._command = self._slots = SAFE_US
        self._pilot: tuple[float, ...] | None = None
        self._t_ms = 0.0

    @property
    def state(self) -> str:
        """State of the safety machine."""
        return self._memory["state"]

    def receive(self, data: bytes, t_ms: float) -> None:
        """Bytes from the serial line."""
        *frames, part = (self._part + data).split(b"\0")
        self._part = part[: MAX_FRAME + 1]  # too long to be a frame, and stays so
        for frame in frames:
            payload = self._payload(frame)
            if payload is not None and payload[0] == COMMAND and len(payload) == 12:
                self._take(payload, t_ms)

    def frame(self, t_ms: float, pilot_us: tuple[float, ...] | None) -> tuple[float, ...]:
        """Slots of the frame that begins now."""
        self._pilot = pilot_us
        self._step(t_ms, None, False)
        if self.state != "ACTIVE":
            self._slots = SAFE_US
        else:
            cut = np.clip(self._command, *LIMITS_US)
            low, high = np.array(self._slots) - SLEW_US, np.array(self._slots) + SLEW_US
            self._slots = tuple(float(us) for us in np.clip(cut, low, high))
        return self._slots

    def _take(self, payload: bytes, t_ms: float) -> None:
        """A whole command: a step of the machine if it is valid."""
        sequence = int.from_bytes(payload[1:3], "little")
        slots = tuple(float(payload[i] + 256 * payload[i + 1]) for i in range(4, 12, 2))
        if not all(RANGE_US[0] <= us <= RANGE_US[1] for us in slots):
            return
        if self._sequence is not None and not 1 <= (sequence - self._sequence) % 65536 <= 32767:
            return
        self._sequence, self._command = sequence, slots
        self._step(t_ms, slots, bool(payload[3] & 1))

    def _step(self, t_ms: float, command_us: tuple[float, ...] | None, engage: bool) -> None:
        """Time has passed, and perhaps a command came."""
        dt_ms, self._t_ms = t_ms - self._t_ms, t_ms
        self._memory = failsafe_state(self._memory, dt_ms, command_us, engage, self._pilot)

    def _payload(self, frame: bytes) -> bytes | None:
        """What a frame carries; None if it is damaged."""
        pieces, at = [], 0
        while at < len(frame):
            end = at + frame[at]
            if end > len(frame):
                return None
            pieces.append(frame[at + 1 : end])
            at = end
        content = b"\0".join(pieces)
        payload, sent = content[:-2], content[-2:]
        if not payload or crc16(payload) != int.from_bytes(sent, "little"):
            return None
        return payload
        # END SOLUTION


# %% check="TrainerBridge"
check(TrainerBridge)

# %% [markdown]
# The six seconds once more, this time as bytes, in pieces of 1 to 9, with one bit in 300 flipped on the way. The
# kit's `Deframer` and `Safety`, which speak with the real board, read the same bytes:

# %%
line = bytes_of_faults()
mine, its = run_bridge(TrainerBridge, line), run_bridge(kit_bridge(), line)
same = (mine["slots"] == its["slots"]).all(axis=1)
print(
    f"{sum(data is not None for _, data, _ in line)} pieces of bytes: your board sends what the "
    f"kit's does in {same.sum()} of {len(same)} frames"
)

# %% [markdown]
# ## 4. Can the picture be trusted?
#
# The policy flies by an analog video link. The paper (section III, *Safety Mechanisms*) warns the pilot when the
# *structural similarity* (SSIM) of consecutive pictures is below 0.7 five times in a row. SSIM compares two patches
# $x$ and $y$ by their means $\mu$, variances $\sigma^2$ and covariance $\sigma_{xy}$ over the pixels (divide by the
# number of pixels):
#
# $$\mathrm{SSIM} = \frac{(2\mu_x\mu_y + C_1)\,(2\sigma_{xy} + C_2)}
#                        {(\mu_x^2 + \mu_y^2 + C_1)\,(\sigma_x^2 + \sigma_y^2 + C_2)}$$
#
# Here a patch is a block of 8 x 8 pixels (`BLOCK_PX`), blocks do not overlap, and the similarity of two pictures is
# the mean over their blocks. Your monitor has two alarms:
#
# - **1, noise:** the SSIM of the last `count` pairs was below `threshold` each time;
# - **2, frozen:** in the last `count` pairs the two pictures differed by less than `FROZEN_LEVELS` grey levels on
#   average (mean of the absolute difference) each time. A frozen picture is perfectly similar, so SSIM never sees it.
#
# A picture has the type `uint8`. Remember what `200 + 100` is in 8 bits.


# %% exercise="ssim_monitor"
def ssim_monitor(images: np.ndarray, threshold: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Similarity and alarms for each pair of consecutive pictures.

    Args:
        images: (n, H, W) uint8 grey levels; H and W are multiples of BLOCK_PX.
        threshold: SSIM below this is noise.
        count: number of pairs in a row that raise an alarm.

    Returns:
        (n - 1,) SSIM, and (n - 1,) whole numbers: 0 no alarm, 1 noise, 2 frozen.
    """
    # BEGIN SOLUTION
    n, height, width = images.shape
    grey = images.astype(float)
    blocks = grey.reshape(n, height // BLOCK_PX, BLOCK_PX, width // BLOCK_PX, BLOCK_PX)
    mean, variance = blocks.mean(axis=(2, 4)), blocks.var(axis=(2, 4))
    covariance = (blocks[:-1] * blocks[1:]).mean(axis=(2, 4)) - mean[:-1] * mean[1:]
    light = (2.0 * mean[:-1] * mean[1:] + C1) / (mean[:-1] ** 2 + mean[1:] ** 2 + C1)
    structure = (2.0 * covariance + C2) / (variance[:-1] + variance[1:] + C2)
    ssim = (light * structure).mean(axis=(1, 2))
    difference = np.abs(np.diff(grey, axis=0)).mean(axis=(1, 2))
    alarm = np.zeros(n - 1, int)
    for i in range(count - 1, n - 1):
        last = slice(i - count + 1, i + 1)
        if np.all(ssim[last] < threshold):
            alarm[i] = 1
        elif np.all(difference[last] < FROZEN_LEVELS):
            alarm[i] = 2
    return ssim, alarm
    # END SOLUTION


# %% check="ssim_monitor"
check(ssim_monitor)

# %% [markdown]
# ### See it: five seconds of video
#
# Simulated video from the arena at 20 Hz. Watch the turn.

# %% figure="monitor"
images, parts = video()
ssim, alarm = ssim_monitor(images, 0.7, 5)
plot_monitor(ssim, alarm, parts, 0.7)

# %% [markdown]
# *In words: SSIM over time with the parts of the video named below; it is high in straight flight, falls in
# the turn, falls to about zero while the signal is lost, and is exactly one while the picture is frozen; crosses mark
# noise alarms and squares mark frozen alarms.*

# %% [markdown]
# ## Questions
#
# **1.** A command is lost now and then. Why does the board keep the last command for a while and not go to idle
# immediately? And why does it not keep it for two seconds? Give numbers: how far does the aircraft fly at 7 m/s until
# `LOST_MS`, and how far in two seconds?

# %% [markdown] answer="q1"
# Single frames get lost all the time; immediate idle would shut the throttle and centre the surfaces many times a minute,
# and each jerk disturbs the aircraft more than an old command does. For 220 ms the old command is nearly the right
# one: at 7 m/s the aircraft moves 1.5 m. In two seconds it flies 14 m, a third of the hall, and an old roll command
# would have turned it on its back.

# %% [markdown]
# **2.** After `LOST` the host's commands come again, with engage on. Why must the board not simply go on?

# %% [markdown] answer="q2"
# The pilot has taken over in the meantime, or the aircraft is in a state that the host has not observed. A computer
# that comes back by itself takes the aircraft out of the pilot's hands without warning. To disengage and engage again
# is a deliberate act of a person who sees that it is safe. The host's program may also have hung and now sends old
# commands.

# %% [markdown]
# **3.** Look at the turn and at the frozen picture. What would the paper's rule alone (SSIM below 0.7, five times) do
# in each? What would you change?

# %% [markdown] answer="q3"
# In the turn consecutive pictures differ because the aircraft turns: perfect video raises the alarm, and pilots learn
# to ignore it. On the frozen picture SSIM is one, so the rule stays silent while the policy flies blind. Fix: move
# the old picture by the known or estimated motion before comparing, and check separately whether the picture is new
# (frozen, too old) and shows anything at all (one colour). The kit's FrameMonitor does both.

# %% quiz="quiz"
from falconwing_kit.tools.grading import check_quiz

quiz = {1: None, 2: None, 3: None, 4: None, 5: None}
check_quiz(quiz)

# %% [markdown]
# ## What you can do now
#
# You wrote the path from a command to the pulses in the radio, the rules that take the aircraft away from a computer,
# the board's whole program around them, and an eye on the video. Lab 13 flies through your `TrainerBridge`. Run `falconwing fly --task landing --port sim-python --headless` to see the whole chain.
#
# ## With hardware
#
# **Propeller off.** You need an Arduino Mega, its USB cable and an oscilloscope (or a logic analyser).
#
# 1. Build and flash the firmware: `falconwing firmware build`, then open `firmware/trainer_bridge` in the Arduino
#    IDE.
# 2. Put the probe on pin 11 and find the five pulses. Send 1400, 1600, 1500, 1500 as to the simulated board above: with
#    `serial.Serial(PORT, 115200)` in its place, 3 s after opening it (that resets the board), and a sleep of 50 ms for
#    each step. No pilot is measured here, so begin with 1000, 1500, 1500, 1500 until step 15: only idle engages. Measure each slot; the board's pulse is 400 us wide, whatever your course has. Trigger on the first
#    pulse with infinite persistence: how wide is the jitter?
# 3. While the board is ACTIVE, stop sending; leave the cable in, since it powers the board. How long until the throttle slot
#    is idle? (Without the cable the pulses stop.)
#
# In place of the figures hand in: a photo of the screen with the slots marked, and a video of step 3.
