"""Hands: sticks messages of all clients -> the command of the one who may fly; for all threads."""

import threading
import time
from collections.abc import Callable

from falconwing_kit.aircraft.airframe import Airframe, load_airframe
from falconwing_kit.aircraft.model import Model, rates_model
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Command, Observation
from falconwing_kit.flight.manual import ManualPilot, Sticks, StickSource
from falconwing_kit.tools.classroom.channel import SticksMessage
from falconwing_kit.tools.classroom.take_over import HandsEvent, TakeOver


class Hands:
    """The take-over machine and the newest sticks of its owner, behind one lock."""

    def __init__(
        self, has_autopilot: bool = True, clock: Callable[[], float] = time.monotonic,
        model: Model | None = None, airframe: Airframe | None = None, pad: LandingPad | None = None,
    ) -> None:  # fmt: skip
        """Begin with the autopilot, or safe without one; clock: of silence [s]."""
        self._machine, self._lock, self._clock = TakeOver(has_autopilot), threading.Lock(), clock
        self._sticks = Command(0.0, 0.0, 0.0, 0.0)
        self._wants_assist = False
        self._stamp = 0.0
        self._is_flying = True
        self._source = StickSource()
        self._manual = ManualPilot(
            model or rates_model(), airframe or load_airframe(), pad or LandingPad(),
            self._source, False, clock,
        )  # fmt: skip

    @property
    def holder(self) -> str:
        """Who holds the sticks: "autopilot", "student", "safe", or "nobody" before and after."""
        return self._machine.holder if self._is_flying else "nobody"

    @property
    def owner(self) -> int:
        """The client who may fly; 0 for none."""
        return self._machine.owner

    @property
    def assisted(self) -> bool:
        """Whether the beginner's assist is in the student's sticks."""
        return self._manual.assist

    def set_assist(self, on: bool) -> None:
        """Switch the beginner's assist at the next step."""
        self._wants_assist = on

    def give(self, client: int, name: str) -> None:
        """Let a client fly."""
        with self._lock:
            self._machine.give(self._clock(), client, name)

    def take(self, reason: str = "the teacher took the sticks") -> None:
        """Take the sticks from any client."""
        with self._lock:
            self._machine.take(self._clock(), reason)

    def leave(self, client: int) -> None:
        """A client has gone or gives its turn back."""
        with self._lock:
            self._machine.leave(self._clock(), client)

    def sticks(self, client: int, sticks: SticksMessage) -> None:
        """Take sticks; those of others than the owner only pass by."""
        with self._lock:
            now = self._clock()
            self._machine.sticks(now, client, sticks.hold, sticks.sequence)
            if client == self._machine.owner:
                self._sticks = Command(
                    sticks.throttle, sticks.aileron, sticks.elevator, sticks.rudder
                )
                self._stamp = now
                self._wants_assist = sticks.assist

    def tick(self, problem: str = "") -> None:
        """Let time pass; a problem with the envelope hands back."""
        with self._lock:
            now = self._clock()
            self._machine.tick(now)
            self._machine.envelope(now, problem)

    def events(self) -> list[HandsEvent]:
        """The changes of hands since the last call."""
        with self._lock:
            return self._machine.events()

    def command(self, observation: Observation) -> Command:
        """The student's command; with the assist, what its sticks ask of the autopilot."""
        with self._lock:
            sticks, stamp, assist = self._sticks, self._stamp, self._wants_assist
        try:
            if assist != self.assisted:
                self._manual.assist = assist
        except InputError:
            self._wants_assist = False
        moved = (sticks.throttle, sticks.aileron, sticks.elevator, sticks.rudder)
        self._source.put(Sticks(*moved, hold=True, stamp=stamp))
        return self._manual.act(observation)

    def end(self) -> None:
        """Nobody flies any more."""
        self._is_flying = False
