"""Simulated flight through the trainer port: commands -> board -> PPM pulses -> aircraft.

command -> serial frame -> board -> PPM pulses -> microseconds -> control inputs -> aircraft, all in
the board's virtual time. The board is the firmware in a simulated chip, or the one in plain Python.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, Self

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import CONTROL_PERIOD_S, Command, State
from falconwing_kit.flight.world import SimulatedWorld
from falconwing_kit.tools.bridge.python_board import Board
from falconwing_kit.trainer_port.port import TrainerPort
from falconwing_kit.trainer_port.ppm import Calibration, load_calibration

GROUND_S = 3.0  # maximum time on the ground until the board answers and follows
SETTLE_S = 1.0  # on the ground after that, longer than the slew limits need
POLL_S = 0.01  # between two reads from the board
PORT_DELAY_S = 0.0184  # mean: 16 bytes 1.4 ms, half a frame 11 ms, four channels of 1.5 ms


class PortWorld:
    """A simulated world behind the trainer port: the world for sources, the sink for the loop.

    The board is engaged before the flight: it follows the first command when the flight's time
    begins. A board engages only near the pilot's sticks, so a SIMULATED pilot at the radio holds
    them where the first command is, and the board measures them; they stay there during the flight,
    for a stick that moves takes the aircraft from the computer. The radio acts on a frame when its
    last channel is complete, and holds the last frame if the pulses stop. The world's own delay,
    `control.loops.LINK_DELAY_S`, has the port's mean in it, so that is taken off here.
    """

    def __init__(
        self,
        world: SimulatedWorld,
        board: Board,
        calibration: Calibration | None = None,
        on_event: Callable[[float, str, Mapping[str, Any]], None] | None = None,
    ) -> None:
        """Wait, before the flight's time begins, until the board answers.

        Args:
            world: in its initial state.
            board: just switched on; the caller closes it.
            calibration: control inputs to microseconds; None for the shipped one.
            on_event: receives the port's events: time of the flight [s] (0 before it), name and
                details.

        Raises:
            InputError: the board does not answer.
        """
        self.world, self.board = world, board
        self.calibration = calibration or load_calibration()
        self.frames, self._on_event = 0, on_event
        self.port = TrainerPort(
            board, self.calibration, now=lambda: board.t, what=f"SIMULATED board, {board.kind}"
        )
        self.port.wait_ready(GROUND_S, self._advance_clock)
        self._zero = math.nan  # the board's time at the start of the flight

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.port.hand_back()

    @property
    def state(self) -> State:
        """The true state."""
        return self.world.state

    @property
    def leader_state(self) -> State | None:
        """The leader's true state."""
        return self.world.leader_state

    @property
    def record(self) -> dict[str, Any]:
        """Counts of the port, for the record of a trial."""
        counters, status = self.port.counters, self.port.status
        return {
            "board": self.board.kind,
            "board_state": status.state if status else "",
            "commands_sent": counters.sent,
            "commands_dropped": counters.dropped,
            "ppm_frames": self.frames,
        }

    def measured(self) -> State:
        """The state as an estimator gives it."""
        return self.world.measured()

    def send(self, t: float, command: Command) -> None:
        """Send a command at t [s] of the flight; InputError if the first is not followed."""
        if math.isnan(self._zero):
            self._engage_board(command)
            self._zero = self.board.t - t
        self._run_board(t)
        self.port.send(command, engage=True)

    def hand_back(self) -> None:
        """Return control to the person with the sticks; later commands are no longer followed."""
        self.port.hand_back()

    def advance(self, t: float) -> None:
        """Run the board to t [s], then the aircraft with the commands of its PPM frames.

        A frame is complete when the next one begins, up to 18 ms after its last channel. That is
        less than the 32 ms that are left of the world's own delay, so no frame is late.
        """
        if not math.isnan(self._zero):
            self._run_board(t)
            for frame in self.board.ppm_frames():
                self.frames += 1
                self.world.send(
                    float(frame.t_slots[-1]) - self._zero - PORT_DELAY_S,
                    self.calibration.command(frame.slots_us.tolist()),
                )
        self.world.advance(t)

    def _run_board(self, t: float) -> None:
        """Run the board in steps of POLL_S, so that its messages are read when they arrive."""
        end = self._zero + t
        while self.board.t < end - 1e-9:
            self.board.run_until(min(self.board.t + POLL_S, end))
            self.port.poll()
        while self.port.events:
            event = self.port.events.popleft()
            if self._on_event is not None:
                self._on_event(max(event.t - self._zero, 0.0), event.name, event.details)

    def _engage_board(self, command: Command) -> None:
        """Engage the board and let its output settle at the command; discard the frames so far."""
        self.board.set_pilot(self.calibration.channels_us(command))
        end = self.board.t + GROUND_S
        while self.port.engagement != "engaged" or self.board.t < end - GROUND_S + SETTLE_S:
            if self.board.t > end:
                state = self.port.status.state if self.port.status else "nothing"
                raise InputError(
                    f"{self.port.what}: expected it ACTIVE, got {state}"
                    f" ({self.port.mismatch() or 'the command matches'}); "
                    "see `falconwing firmware test`"
                )
            self.port.send(command, engage=True)
            self._advance_clock(CONTROL_PERIOD_S)
        self.board.ppm_frames()

    def _advance_clock(self, dt: float) -> None:
        self.board.run_until(self.board.t + dt)
        self.port.poll()
