"""Random hosts: the chip's pulses against the Python model of the safety rules, frame by frame."""

from dataclasses import dataclass

import numpy as np

from falconwing_kit.tools.bridge.simulated_board import SimulatedBoard
from falconwing_kit.trainer_port.protocol import Status, encode_channels
from falconwing_kit.trainer_port.safety import Safety
from tests.firmware.chip import SAFE, Bench, is_safe, require_tools, slots

TRACES, COMMANDS = 30, 60
PROGRAM_US = 400  # a command takes effect between its last byte's arrival and so long after
GAPS_MS = (3, 20, 50, 50, 50, 50, 120, 190, 199, 201, 210, 260, 490, 510, 1010)


@dataclass(frozen=True)
class Sent:
    """A command on its way."""

    arrived_us: int
    sequence: int
    engage: bool
    channels_us: tuple[int, ...]


def adversary(rng: np.random.Generator) -> list[tuple[float, int, bool, tuple[int, ...]]]:
    """Commands as (pause before it [s], step of the sequence, engage, slots): mostly engaging, with
    all that can go wrong: pauses around every limit, numbers that stand, fall back or leap,
    flicker, values out of range.
    """
    calm = rng.random() < 0.8  # else anything may follow anything
    plan, wish = [], rng.random() < 0.3  # the first command may ask at once, which is no edge
    for _ in range(COMMANDS):
        gap = 50 if calm and rng.random() < 0.85 else int(rng.choice(GAPS_MS))
        step = 1 if rng.random() < 0.95 else int(rng.choice([0, -1, 2, 100, 32767, 32768, 40000]))
        wish = rng.random() < ((0.92 if calm else 0.7) if wish else 0.6)
        value = rng.integers(1000, 2001, 4)
        if rng.random() < 0.9:  # near enough to engage, near the limits now and then
            value = np.array(SAFE) + rng.integers(-100, 101, 4)
            value[0] = 1000 + rng.choice([0, 10, 20, 21], p=[0.6, 0.2, 0.15, 0.05])
        if rng.random() < 0.04:
            value[rng.integers(4)] = rng.choice([850, 2150, 899, 2101])
        plan.append((gap * 1e-3 + rng.uniform(0, 0.002), step, wish, tuple(value.tolist())))
    return plan


def fly_chip(bench, plan) -> tuple[list[Sent], list, Status]:
    """The commands as they arrived, the frames on the pin and the last status."""
    sent, number = [], 0
    for pause, step, engage, channels in plan:
        bench.wait(pause)
        number = (number + step) % 65536
        arrived = bench.send_raw(encode_channels(number, channels, engage))
        sent.append(Sent(round(arrived * 1e6), number, engage, channels))
    bench.wait(0.3)
    return sent, bench.board.ppm_frames(), bench.status()


def fly_model(
    sent: list[Sent], ticks_us: list[int], delay_us: int
) -> tuple[list[tuple[int, ...] | None], Safety]:
    """What the model puts out at each tick, where every command takes effect so long after its
    arrival.
    """
    model, waiting, out = Safety(), list(sent), []
    for tick in ticks_us:
        while waiting and waiting[0].arrived_us + delay_us <= tick:
            command = waiting.pop(0)
            model.frame(
                command.arrived_us + delay_us, command.sequence, command.engage, command.channels_us
            )
        out.append(model.tick(tick))
    return out, model


def test_the_chip_does_what_the_rules_say():
    """Every frame on the pin has the model's slots to a microsecond, and the last status its state
    and counts.

    The model was written from the rules, not from the firmware. A command's arrival is known to the
    time that the program takes; a trace in which that decides is not compared: the model's results
    for early and late arrival differ. With 60 commands of 0.4 ms in frames of 22 ms that is rarer
    than one in two, so at least half must be left.
    """
    require_tools()
    judged, followed = 0, 0
    for seed in range(TRACES):
        with SimulatedBoard(seed=seed) as board:
            sent, frames, status = fly_chip(Bench(board), adversary(np.random.default_rng(seed)))
        ticks = [round(frame.t_start * 1e6) for frame in frames]
        early, model = fly_model(sent, ticks, 0)
        late, _ = fly_model(sent, ticks, PROGRAM_US)
        if early != late:
            continue
        judged += 1
        wrong = np.abs(slots(frames) - np.array(early)).max(axis=1)
        k = int(wrong.argmax())
        assert wrong[k] <= 1.0, (
            f"{seed}: {frames[k].slots_us} at {frames[k].t_start:.3f} s, want {early[k]}"
        )
        assert (status.state, status.fault) == (model.state, model.fault), f"trace {seed}"
        assert status.last_sequence == (model.last_sequence or 0), f"trace {seed}"
        followed += not all(is_safe(frame) for frame in frames)
    assert judged >= TRACES / 2
    assert followed >= TRACES / 4, "the traces hardly ever reach ACTIVE and show little"
