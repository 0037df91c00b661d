"""Take-over: its rules one by one, and 10,000 random orders of events without two owners."""

import numpy as np
import pytest

from falconwing_kit.tools.classroom.take_over import SILENCE_S, STICKS_MESSAGES, TakeOver

PERIOD = 0.02  # of sticks messages [s]


class Student:
    """A client that sends sticks to a machine at 50 Hz."""

    def __init__(self, machine, client=1):
        self.machine, self.client, self.sequence = machine, client, 0

    def send(self, t, hold=True):
        """One message."""
        self.sequence = (self.sequence + 1) % 2**16
        return self.machine.sticks(t, self.client, hold, self.sequence)

    def press(self, t, messages=STICKS_MESSAGES):
        """Released once, then pressed for some messages; the time after them."""
        self.send(t, hold=False)
        for k in range(1, messages + 1):
            self.send(t + k * PERIOD)
        return t + messages * PERIOD


@pytest.fixture
def machine():
    """Client 1 may fly."""
    machine = TakeOver()
    machine.give(0.0, 1, "Mia")
    return machine


def test_five_messages_after_the_edge_take_over(machine):
    """The fifth, counted from the first with hold pressed; the reason is an event."""
    student = Student(machine)
    t = student.press(1.0, STICKS_MESSAGES - 1)
    assert machine.holder == "autopilot"
    assert student.send(t + PERIOD)
    assert machine.holder == "student"
    (event,) = machine.events()
    assert (event.holder, event.name) == ("student", "Mia") and event.reason


def test_a_button_held_since_before_takes_nothing(machine):
    """Without the edge there is no take-over, as long as it may last."""
    student = Student(machine)
    for k in range(500):
        student.send(0.01 + k * PERIOD)
    assert machine.holder == "autopilot"


def test_letting_go_hands_back_at_once(machine):
    """One message with hold released."""
    student = Student(machine)
    t = student.press(1.0)
    assert not student.send(t + PERIOD, hold=False)
    assert machine.holder == "autopilot"
    assert "let go" in machine.events()[-1].reason


def test_silence_of_200_ms_hands_back_and_the_button_must_be_pressed_anew(machine):
    """199 ms are none. A phone that wakes up with the stick held sends on without an edge."""
    student = Student(machine)
    t = student.press(1.0)
    machine.tick(t + SILENCE_S - 1e-3)
    assert machine.holder == "student"
    machine.tick(t + SILENCE_S + 1e-6)
    assert machine.holder == "autopilot" and "200 ms" in machine.events()[-1].reason
    for k in range(100):
        assert not student.send(t + 30.0 + k * PERIOD)
    student.press(t + 40.0)
    assert machine.holder == "student"


def test_a_gap_between_the_five_messages_counts_as_letting_go(machine):
    """Three, 200 ms of silence, three more."""
    student = Student(machine)
    t = student.press(1.0, 3)
    for k in range(10):
        student.send(t + SILENCE_S + 1e-6 + k * PERIOD)
    assert machine.holder == "autopilot"


def test_leaving_the_envelope_hands_back_until_it_is_entered_again(machine):
    """While the problem lasts no edge helps."""
    student = Student(machine)
    t = student.press(1.0)
    machine.envelope(t, "too near a wall")
    assert machine.holder == "autopilot" and machine.events()[-1].reason == "too near a wall"
    t = student.press(t + 0.1)
    assert machine.holder == "autopilot"
    machine.envelope(t, "")
    student.press(t + 0.1)
    assert machine.holder == "student"


def test_the_teacher_beats_everything(machine):
    """After a take the student's sticks are nobody's, edge or not, until they are given again."""
    student = Student(machine)
    t = student.press(1.0)
    machine.take(t)
    assert (machine.holder, machine.owner) == ("autopilot", 0)
    t = student.press(t + 0.1)
    assert machine.holder == "autopilot"
    machine.give(t, 1, "Mia")
    student.press(t + 0.1)
    assert machine.holder == "student"


def test_another_owner_ends_the_first_ones_turn(machine):
    """The first one's sticks count no more, the second one's after an edge of their own."""
    first, second = Student(machine, 1), Student(machine, 2)
    t = first.press(1.0)
    machine.give(t, 2, "Tom")
    assert machine.holder == "autopilot" and not first.send(t + PERIOD)
    t = second.press(t + 0.1)
    assert machine.holder == "student" and not first.send(t + PERIOD) and second.send(t + PERIOD)


def test_a_student_who_leaves_hands_back(machine):
    """The name is in the reason."""
    t = Student(machine).press(1.0)
    machine.leave(t, 1)
    assert (machine.holder, machine.owner) == ("autopilot", 0)
    assert machine.events()[-1].reason == "Mia has gone"


def test_old_messages_are_none(machine):
    """A repeated or earlier sequence number, also across the wrap at 2^16."""
    student = Student(machine)
    student.sequence = 2**16 - 3
    t = student.press(1.0)
    assert machine.holder == "student"
    assert not machine.sticks(t + PERIOD, 1, True, student.sequence)
    assert not machine.sticks(t + PERIOD, 1, True, 2**16 - 1)
    machine.tick(t + SILENCE_S + 1e-6)
    assert machine.holder == "autopilot"


def test_without_an_autopilot_the_sticks_are_safe():
    """SAFE in its place, everything else the same."""
    machine = TakeOver(has_autopilot=False)
    assert machine.holder == "safe"
    machine.give(0.0, 1, "Mia")
    t = Student(machine).press(1.0)
    assert machine.holder == "student"
    machine.tick(t + SILENCE_S + 1e-6)
    assert machine.holder == "safe"


def test_never_two_owners_in_10000_random_orders():
    """The events alone say who may fly: the last one given, unless taken or gone since. Only this
    client's sticks are ever accepted, never while the envelope is left, never later than 200 ms
    after its last message, and only after five messages with hold pressed in a row.
    """
    rng = np.random.default_rng(20)
    accepted = 0
    for _ in range(10_000):
        machine = TakeOver()
        kinds = rng.choice(6, size=50, p=(0.05, 0.01, 0.02, 0.05, 0.05, 0.82)).tolist()
        clients = rng.integers(1, 4, size=50).tolist()
        favourite = clients[0]
        steps = rng.choice((0.005, 0.02, 0.02, 0.02, 0.1, 0.25), size=50).tolist()
        draws = rng.random(50).tolist()
        t, may, outside, run, sequence, last = 0.0, 0, False, 0, 0, -1.0
        for kind, client, dt, draw in zip(kinds, clients, steps, draws, strict=True):
            t += dt
            if kind == 0:
                machine.give(t, client, "name")
                run = run if may == client else 0
                may = client
            elif kind == 1:
                machine.take(t)
                may = run = 0
            elif kind == 2:
                machine.leave(t, client)
                may, run = (0, 0) if client == may else (may, run)
            elif kind == 3:
                outside = draw < 0.5
                machine.envelope(t, "outside" if outside else "")
            elif kind == 4:
                machine.tick(t)
            else:
                client, hold = (favourite, draw < 0.77) if draw < 0.8 else (client, draw < 0.95)
                sequence += 1
                is_accepted = machine.sticks(t, client, hold, sequence)
                if client == may:
                    run = 0 if not hold else 1 if t - last >= SILENCE_S else run + 1
                    last = t
                if is_accepted:
                    accepted += 1
                    assert client == may and hold and not outside and run >= STICKS_MESSAGES
            if machine.holder == "student":
                assert may and may == machine.owner and not outside
    assert accepted > 1000  # the orders do reach flying
