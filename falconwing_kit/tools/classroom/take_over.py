"""Take-over: who may fly, hold buttons and times -> who holds the sticks, and why that changed.

                     five sticks messages of the owner with hold pressed,
                     the first of them pressed anew, no gap of 200 ms
        AUTOPILOT ------------------------------------------------------> STUDENT
        (or SAFE    <------------------------------------------------------
         where there   hold released; 200 ms without sticks; the envelope left;
         is none)      the owner gone; another owner; the teacher takes

One client at most is the owner, whom the teacher or the queue lets fly, and only the owner's sticks
count. The rules are those of the trainer port's safety machine (trainer_port/safety.py): SAFE and
ACTIVE there are autopilot and student here. Times are seconds on any one clock, passed in.
"""

from collections import deque
from dataclasses import dataclass
from typing import Literal

Holder = Literal["nobody", "autopilot", "student", "safe"]

SILENCE_S = 0.2  # without sticks: the autopilot
STICKS_MESSAGES = 5  # of a take-over, the first with hold pressed anew
SEQUENCES = 2**16  # of sticks messages, wrap here
MAX_EVENTS = 1000  # that wait to be read


@dataclass(frozen=True)
class HandsEvent:
    """A change of hands."""

    t: float  # [s]
    holder: Holder
    client: int  # who holds, or held, the sticks; 0 for none
    name: str  # of that client
    reason: str  # one plain sentence without its full stop


class TakeOver:
    """The state machine; not for several threads at once."""

    def __init__(self, has_autopilot: bool = True) -> None:
        self.idle: Holder = "autopilot" if has_autopilot else "safe"
        self.holder: Holder = self.idle
        self.owner, self.name = 0, ""  # client that may take the sticks; 0 for none
        self._is_pressed = True  # so that a button held since before does not count as pressed
        self._messages = 0  # since hold was pressed
        self._last_t = 0.0  # of the owner's last sticks
        self._last_sequence: int | None = None
        self._blocked = ""  # why the student may not fly at this moment
        self._events: deque[HandsEvent] = deque(maxlen=MAX_EVENTS)

    def give(self, t: float, client: int, name: str) -> None:
        """Let a client fly from now on, and no other; a student who flies hands back."""
        if client == self.owner:
            self.name = name
            return
        self._to_idle(t, f"{name} is to fly")
        self.owner, self.name = client, name
        self._forget()
        self._last_t = t

    def take(self, t: float, reason: str = "the teacher took the sticks") -> None:
        """The teacher's: no client may fly from now on."""
        if self.holder == self.idle and self.owner:
            self._add(t, self.idle, reason)
        self._to_idle(t, reason)
        self.owner, self.name = 0, ""
        self._forget()

    def leave(self, t: float, client: int) -> None:
        """A client has gone or gives its turn back."""
        if client == self.owner and client:
            self._to_idle(t, f"{self.name} has gone")
            self.owner, self.name = 0, ""
            self._forget()

    def sticks(self, t: float, client: int, hold: bool, sequence: int) -> bool:
        """Take a sticks message.

        Args:
            t: now [s].
            client: who sent it.
            hold: whether the hold button is pressed.
            sequence: of the message, wraps at 2^16; one that does not advance is an old one.

        Returns:
            Whether the sticks are the aircraft's: the client holds them now.
        """
        self.tick(t)
        if not client or client != self.owner or self._is_old(sequence):
            return False
        silent = t - self._last_t >= SILENCE_S
        if silent and self._last_sequence is None:
            self._is_pressed = False  # a button held since before would have been heard by now
        self._last_t, self._last_sequence = t, sequence
        if not hold:
            self._is_pressed, self._messages = False, 0
            self._to_idle(t, f"{self.name} let go")
            return False
        if self.holder == "student":
            return True
        if not self._is_pressed:
            self._is_pressed, self._messages = True, 1
        elif self._messages:
            # A gap counts as letting go: the button has to be pressed again.
            self._messages = 0 if silent else self._messages + 1
        if self._messages >= STICKS_MESSAGES and not self._blocked:
            self.holder = "student"
            self._add(t, "student", f"{self.name} holds the button")
        return self.holder == "student"

    def tick(self, t: float) -> None:
        """Let time pass to t [s]."""
        if self.holder == "student" and t - self._last_t >= SILENCE_S:
            self._to_idle(t, f"no sticks from {self.name} for {1e3 * SILENCE_S:.0f} ms")

    def envelope(self, t: float, problem: str) -> None:
        """Whether the aircraft is where a student may fly: a problem ends their turn at the sticks.

        Args:
            t: now [s].
            problem: what was left, such as "too near a wall"; empty where all is well.
        """
        self._blocked = problem
        if problem and self.holder == "student":
            self._to_idle(t, problem)

    def events(self) -> list[HandsEvent]:
        """The changes of hands since the last call, oldest first."""
        found = list(self._events)
        self._events.clear()
        return found

    def _is_old(self, sequence: int) -> bool:
        last = self._last_sequence
        return last is not None and not 0 < (sequence - last) % SEQUENCES < SEQUENCES // 2

    def _to_idle(self, t: float, reason: str) -> None:
        """Autopilot or safe; the return of the student requires the button to be pressed anew."""
        if self.holder != "student":
            return
        self.holder, self._messages = self.idle, 0
        self._add(t, self.idle, reason)

    def _forget(self) -> None:
        """Begin with a new owner: the button counts as pressed until it was seen released."""
        self._is_pressed, self._messages, self._last_sequence = True, 0, None

    def _add(self, t: float, holder: Holder, reason: str) -> None:
        self._events.append(HandsEvent(t, holder, self.owner, self.name, reason))
