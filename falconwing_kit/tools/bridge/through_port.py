"""Through the port: a simulated aircraft that flies on what the pin of a board said, not on what
the pilot meant.

command -> serial frame -> board -> PPM pulses -> microseconds -> sticks -> aircraft, all in the
board's virtual time. The board is the firmware in a simulated chip, or the one in plain Python.
Everything here is simulated.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, Self
from warnings import warn

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Command, State
from falconwing_kit.flight.loop import CONTROL_PERIOD
from falconwing_kit.flight.world import SimulatedWorld
from falconwing_kit.tools.bridge.python_board import Board, PythonBoard
from falconwing_kit.trainer_port.port import TrainerPort
from falconwing_kit.trainer_port.ppm import Calibration, load_calibration

PORTS = ("sim", "sim-python")  # names of simulated boards: the firmware, and plain Python
GROUND_S, SETTLE_S = (
    3.0,
    1.0,
)  # the first: so long a board has to answer and to follow; the second: to settle, slew limits included
POLL_S = 0.01  # between two looks at the board's answers


class PortWorld:
    """A simulated world behind the trainer port. For sources it is the world, for the loop the
    sink.

    The switch-over comes before the flight: the board follows the first command already when its
    time begins. The radio is taken to act on a frame when its last slot is complete; where the
    pulses stop it holds the last one. The port's delay, 19 ms in the mean (16 bytes 1.4, half a
    frame 11, four slots 6), comes on top of the world's own.
    """

    def __init__(
        self,
        world: SimulatedWorld,
        board: Board,
        calibration: Calibration | None = None,
        on_event: Callable[[float, str, Mapping[str, Any]], None] | None = None,
    ) -> None:
        """Wait until the board answers; that takes no time of the flight.

        Args:
            world: at its start.
            board: just switched on; the caller closes it.
            calibration: of sticks to microseconds; None takes the kit's own.
            on_event: told what happens at the port: time of the flight [s] (0 for what was before),
                what, and more about it; None for nobody.

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
        self._zero = math.nan  # the board's time when the flight begins

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
        """What went through the port, for the record of a trial."""
        counters, status = self.port.counters, self.port.status
        return {
            "board": self.board.kind,
            "board_state": status.state if status else "",
            "commands_sent": counters.sent,
            "commands_dropped": counters.dropped,
            "ppm_frames": self.frames,
        }

    def measured(self) -> State:
        """What an estimator would say."""
        return self.world.measured()

    def send(self, t: float, command: Command) -> None:
        """Put a command on the wire at t [s] of the flight.

        Raises:
            InputError: it is the first one and the board does not follow it.
        """
        if math.isnan(self._zero):
            self._engage_board(command)
            self._zero = self.board.t - t
        self._run_board(t)
        self.port.send(command, engage=True)

    def advance(self, t: float) -> None:
        """Let the board run to t [s] and the aircraft fly on what its pin said.

        A frame is known when the next one begins, up to 16 ms after its last slot. That is sooner
        than a command gets through the radio (the world's own delay), so none comes too late.
        """
        if not math.isnan(self._zero):
            self._run_board(t)
            for frame in self.board.ppm_frames():
                self.frames += 1
                self.world.send(
                    float(frame.t_slots[-1]) - self._zero,
                    self.calibration.command(frame.slots_us.tolist()),
                )
        self.world.advance(t)

    def _run_board(self, t: float) -> None:
        """The board's time in looks, so that its answers are read when they come."""
        end = self._zero + t
        while self.board.t < end - 1e-9:
            self.board.run_until(min(self.board.t + POLL_S, end))
            self.port.poll()
        while self.port.events:
            event = self.port.events.popleft()
            if self._on_event is not None:
                self._on_event(max(event.t - self._zero, 0.0), event.name, event.details)

    def _engage_board(self, command: Command) -> None:
        """Ask the board to follow, until it does; of its frames the last one counts, which carries
        the command.
        """
        end = self.board.t + GROUND_S
        while self.port.engagement != "engaged" or self.board.t < end - GROUND_S + SETTLE_S:
            if self.board.t > end:
                state = self.port.status.state if self.port.status else "nothing"
                raise InputError(
                    f"{self.port.what}: expected it ACTIVE, got {state}; see `falconwing firmware test`"
                )
            self.port.send(command, engage=True)
            self._advance_clock(CONTROL_PERIOD)
        self.board.ppm_frames()

    def _advance_clock(self, dt: float) -> None:
        self.board.run_until(self.board.t + dt)
        self.port.poll()


def simulated_board(name: str) -> Board:
    """A board of virtual time.

    Args:
        name: "sim" for the firmware in a simulated chip, or plain Python where its tools are
            missing, with a warning; "sim-python" for plain Python.

    Raises:
        InputError: there is no simulated board of this name, or the firmware cannot be built.
    """
    if name not in PORTS:
        raise InputError(
            f"--port {name}: expected {' or '.join(PORTS)}, a simulated board, to fly in simulation"
        )
    from falconwing_kit.tools.bridge.build import missing_tools

    missing = missing_tools() if name == "sim" else []
    if missing:
        warn(
            f"the firmware cannot be simulated here, a board in {PythonBoard.kind} takes its place;"
            f" Debian or Ubuntu: apt install {' '.join(missing)}",
            stacklevel=2,
        )
    if missing or name == "sim-python":
        return PythonBoard()
    from falconwing_kit.tools.bridge.simulated_board import SimulatedBoard

    return SimulatedBoard()
