"""The loop: its schedule on a manual clock; faults of pilot, hook and log; ends of a flight."""

import signal

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_log import FlightLogWriter, read_flight_log, to_flight_table
from falconwing_kit.core.messages import Command, Image, State
from falconwing_kit.flight.loop import SAFE_COMMAND, Loop, WallClock, deadlines

STATE = State.from_vector(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 7.0, 0.0, -0.5]))
MODES = ("approach", "flare")


class HandClock:
    """A manual clock: waiting ends `late` after the deadline; the test adds the time of work."""

    def __init__(self, late: float = 0.0) -> None:
        self.late, self.t = late, 0.0

    def start(self) -> None:
        self.t = 0.0

    def now(self) -> float:
        return self.t

    def wait_until(self, t: float) -> None:
        self.t = max(self.t, t + self.late)


class Recorder:
    """A sink and hook that keeps commands and steps."""

    def __init__(self) -> None:
        self.sent: list[tuple[float, Command]] = []
        self.steps = []

    def send(self, t: float, command: Command) -> None:
        self.sent.append((t, command))

    def __call__(self, step) -> None:
        self.steps.append(step)


class Camera:
    """An image every second step, its sequence counted from 0."""

    def next_image(self, t: float) -> Image:
        number = round(t / 0.05) // 2
        return Image(number, 0.1 * number, np.full((4, 6, 3), number % 256, np.uint8))


class Still:
    """A constant state."""

    def state_at(self, t: float) -> State:
        return STATE


class Pilot:
    """A constant answer, except in the steps given."""

    mode = "cruise"

    def __init__(self, **at_step) -> None:
        self.at_step, self.observations = at_step, []

    def act(self, observation):
        self.observations.append(observation)
        what = self.at_step.get(f"step{len(self.observations) - 1}", Command(0.5, 0.1, -0.2, 0.3))
        return what() if callable(what) else what


def test_the_pilot_is_told_what_a_sink_sent_in_its_place():
    """A person flies the first three steps; the pilot's command goes out from the fourth on."""
    sticks, recorder, pilot = Command(0.7, -0.4, 0.2, 0.0), Recorder(), Pilot()

    class Port:
        def send(self, t, command):
            return sticks if t < 0.14 else None

    Loop(pilot, Port(), Camera(), hooks=[recorder], clock=HandClock()).run(0.3)
    told = [observation.past_commands[-1].tolist() for observation in pilot.observations]
    assert told == [[0.0] * 4, *[[0.7, -0.4, 0.2, 0.0]] * 3, *[[0.5, 0.1, -0.2, 0.3]] * 2]
    assert [step.command.vector.tolist() for step in recorder.steps[:-1]] == told[1:]
    assert [step.command.image_sequence for step in recorder.steps] == [0, 0, 1, 1, 2, 2]


def test_deadlines_do_not_drift():
    """10,000 steps, each 0.7 ms late: the last deadline is 9,999 * 50 ms, not 7 s later."""
    clock, seen = HandClock(late=0.0007), []
    for k, lateness in deadlines(clock, 500.0):
        seen.append((k, clock.now(), lateness))
        clock.t += 0.013  # the work of a step
    assert [k for k, *_ in seen] == list(range(10_000))
    assert seen[-1][1] == pytest.approx(9_999 * 0.05 + 0.0007, abs=1e-9)
    assert max(abs(late - 0.0007) for *_, late in seen) < 1e-9


@pytest.mark.parametrize(
    ("work", "flown"),
    [
        (0.049, [0, 1, 2, 3, 4]),  # done before the next deadline
        (0.070, [0, 1, 2, 3, 4]),  # 20 ms late: flown at once, late
        (0.080, [0, 2, 3, 4]),  # 30 ms late, more than half a period: step 1 is left out
        (0.210, [0, 4]),  # steps 1 to 3 are gone; 4 is 10 ms late
    ],
)
def test_a_step_that_is_too_late_is_skipped(work, flown):
    """Deadlines by hand; only the first step works that long. Steps are at least half a period
    apart.
    """
    clock, seen = HandClock(), []
    for k, _ in deadlines(clock, 0.25):
        seen.append((k, clock.now()))
        clock.t += work if k == 0 else 0.001
    assert [k for k, _ in seen] == flown
    assert min(np.diff([t for _, t in seen])) >= 0.025


def test_skipped_steps_and_jitter_are_counted():
    """One step of 180 ms in a second: deadlines 1 to 3 pass (3 by 30 ms), 17 steps of 20 remain."""
    clock = HandClock(late=0.002)

    def dawdle():
        clock.t += 0.178
        return SAFE_COMMAND

    flight = Loop(Pilot(step0=dawdle), Recorder(), clock=clock).run(1.0)
    assert (len(flight.t), flight.skipped, flight.reason) == (17, 3, "duration")
    assert flight.milliseconds("lateness") == pytest.approx((2.0, 2.0))
    assert flight.rate_hz == pytest.approx(16 / 0.95)


def test_simulated_time_is_exact_and_wall_time_is_not_early():
    """20 steps a second and the safe command at 1.0 s; a real clock may be late, never early."""
    sink = Recorder()
    flight = Loop(Pilot(), sink).run(1.0)
    assert [t for t, _ in sink.sent] == pytest.approx(0.05 * np.arange(21), abs=1e-12)
    assert flight.t == pytest.approx(0.05 * np.arange(20), abs=1e-12)
    assert flight.lateness.max() == 0.0
    real = Loop(Pilot(), Recorder(), clock=WallClock(), period=0.01).run(0.05)
    assert real.lateness.min() >= 0.0


def test_log_holds_every_step_and_commands_name_their_image(tmp_path):
    """Ten steps, an image every second one: 10 commands and states, 5 images, answers 0 0 1 1 ...

    The safe command after them answers no image.
    """
    with FlightLogWriter(tmp_path / "flight.mcap") as log:
        Loop(Pilot(), Recorder(), images=Camera(), states=Still(), log=log).run(0.5)
    read = read_flight_log(tmp_path / "flight.mcap")
    assert read.warnings == ()
    assert read.command_sequences.tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, -1]
    assert read.state_sequences.tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    assert read.image_sequences.tolist() == [0, 1, 2, 3, 4]
    assert read.states[3].vector == pytest.approx(STATE.vector)
    table = to_flight_table(read)
    assert len(table.t) == 5
    assert table.commands[2] == pytest.approx([0.5, 0.1, -0.2, 0.3])


def test_pilot_gets_its_past_commands_the_image_and_the_state():
    """After two steps the last two of the 30 rows are the commands sent, the others zero."""
    pilot = Pilot()
    Loop(pilot, Recorder(), images=Camera(), states=Still()).run(0.15)
    last = pilot.observations[-1]
    assert last.past_commands.shape == (30, 4)
    assert last.past_commands[:28] == pytest.approx(0.0)
    assert last.past_commands[28:] == pytest.approx(np.tile([0.5, 0.1, -0.2, 0.3], (2, 1)))
    assert (last.image.sequence, last.t) == (1, pytest.approx(0.1))
    assert last.state is STATE


@pytest.mark.parametrize(
    "nonsense",
    [
        lambda: 1 / 0,
        None,
        (0.5, 0.0, 0.0, 0.0),
        Command(float("nan"), 0.0, 0.0, 0.0),
        Command("full", 0.0, 0.0, 0.0),
    ],
    ids=["raises", "none", "tuple", "nan", "text"],
)
def test_an_invalid_answer_of_the_pilot_becomes_the_safe_command(nonsense, tmp_path):
    """Neutral and idle in that step only; an event has the reason; the flight continues."""
    sink = Recorder()
    with FlightLogWriter(tmp_path / "flight.mcap") as log:
        flight = Loop(Pilot(step2=nonsense), sink, log=log).run(0.25)
    assert [k for k, (_, command) in enumerate(sink.sent) if not command.vector.any()] == [
        2,
        5,
    ]  # 5: the flight's end
    assert (flight.faults, flight.reason, len(flight.t)) == (1, "duration", 5)
    events = read_flight_log(tmp_path / "flight.mcap").events
    assert [event.name for event in events] == ["mode", "pilot failed", "ended"]
    assert events[1].t == pytest.approx(0.1)


def test_commands_beyond_their_limits_are_clipped_and_marked():
    """Throttle 1.5 becomes 1, aileron -3 becomes -1, saturated is True."""
    sink = Recorder()
    Loop(Pilot(step0=Command(1.5, -3.0, 0.0, 0.0)), sink).run(0.1)
    assert sink.sent[0][1] == Command(1.0, -1.0, 0.0, 0.0, saturated=True)
    assert not sink.sent[1][1].saturated


def test_a_pilot_that_never_recovers_ends_the_flight():
    """Three consecutive faults are allowed; a good step between faults resets the count."""
    failing = {f"step{k}": None for k in (1, 2, 3, 5, 6, 7, 8)}
    flight = Loop(Pilot(**failing), Recorder(), faults_allowed=3).run(5.0)
    assert (flight.reason, len(flight.t), flight.faults) == ("pilot failed", 9, 7)


def test_a_hook_that_raises_is_dropped_and_the_flight_goes_on():
    """The other hook gets all five steps, the broken one is called once."""
    calls, sink = [], Recorder()

    def broken(step):
        calls.append(step.t)
        raise OSError("the browser is gone")

    flight = Loop(Pilot(), sink, states=Still(), hooks=(broken, sink)).run(0.25)
    assert calls == [0.0]
    assert [step.mode for step in sink.steps] == ["cruise"] * 5
    (dropped,) = (event for event in flight.events if event.name == "hook dropped")
    assert "the browser is gone" in dropped.details["error"]


def test_a_change_of_mode_is_logged_once():
    """A hook sets the mode of the next step: "approach" from t = 0.05 on, "flare" after t = 0.2."""
    pilot = Pilot()
    flight = Loop(
        pilot, Recorder(), hooks=(lambda step: setattr(pilot, "mode", MODES[step.t > 0.19]),)
    ).run(0.5)
    modes = [(event.t, event.details["mode"]) for event in flight.events if event.name == "mode"]
    assert modes == [
        (0.0, "cruise"),
        (pytest.approx(0.05), "approach"),
        (pytest.approx(0.25), "flare"),
    ]


def test_ctrl_c_ends_the_flight_with_the_log_whole(tmp_path):
    """A real interrupt in step 3: the step is finished, the safe command follows, the log is
    readable.
    """
    sink = Recorder()

    def interrupt():
        signal.raise_signal(signal.SIGINT)
        return Command(0.5, 0.1, -0.2, 0.3)

    with FlightLogWriter(tmp_path / "flight.mcap") as log:
        flight = Loop(Pilot(step3=interrupt), sink, images=Camera(), log=log).run(5.0)
    assert (flight.reason, len(flight.t)) == ("interrupted", 4)
    assert sink.sent[-1][1] == SAFE_COMMAND
    read = read_flight_log(tmp_path / "flight.mcap")
    assert read.warnings == ()
    assert len(read.commands) == 5
    assert [event.name for event in read.events] == ["mode", "interrupted", "ended"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_second_ctrl_c_does_not_wait_for_a_pilot_that_hangs():
    """Two interrupts within one step: the second raises immediately."""

    def hang():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        pytest.fail("still hanging")

    assert Loop(Pilot(step1=hang), Recorder()).run(5.0).reason == "interrupted"


def test_a_source_that_breaks_ends_the_flight_safely():
    """The camera is unplugged: the safe command is sent and the error raised."""

    class Unplugged:
        def next_image(self, t):
            if t > 0.12:
                raise OSError("no camera")

    sink = Recorder()
    with pytest.raises(OSError, match="no camera"):
        Loop(Pilot(), sink, images=Unplugged()).run(5.0)
    assert len(sink.sent) == 4
    assert sink.sent[-1][1] == SAFE_COMMAND


def test_a_full_disk_costs_the_log_and_not_the_flight(monkeypatch, tmp_path):
    """The third command cannot be written: a warning; all ten steps are flown to the end."""
    sink, written = Recorder(), []

    def refuse(self, t, command, image=None):
        written.append(t)
        if len(written) == 3:
            raise InputError("flight.mcap: the disk is full")

    monkeypatch.setattr(FlightLogWriter, "command", refuse)
    with (
        FlightLogWriter(tmp_path / "flight.mcap") as log,
        pytest.warns(UserWarning, match="goes on without a log"),
    ):
        Loop(Pilot(), sink, log=log).run(0.5)
    assert len(written) == 3
    assert len(sink.sent) == 11 and sink.sent[-1][1] == SAFE_COMMAND


def test_a_flight_ends_by_its_stop_condition():
    """Called after every step: at t = 0.2 the reason is returned, after five steps."""
    flight = Loop(Pilot(), Recorder()).run(5.0, lambda step: "landed" if step.t > 0.19 else "")
    assert (flight.reason, len(flight.t)) == ("landed", 5)


@pytest.mark.parametrize(
    ("stop_condition", "reason", "t"),
    [
        (lambda step: "", "duration", 0.22),
        (lambda step: "landed" * (step.t > 0.14), "landed", 0.15),
    ],
)
def test_the_last_command_of_a_flight_is_the_safe_one(stop_condition, reason, t, tmp_path):
    """A sink holds the last command, which must not be an open throttle. Sent once, and logged.

    At 0.22 s the fifth step's command has been held to the end; a reason ends the fourth step, at
    0.15 s.
    """
    sink = Recorder()
    with FlightLogWriter(tmp_path / "flight.mcap") as log:
        flight = Loop(Pilot(), sink, log=log).run(0.22, stop_condition)
    assert (flight.reason, flight.faults) == (reason, 0)
    assert sink.sent[-1] == (pytest.approx(t), SAFE_COMMAND)
    assert all(command.throttle == 0.5 for _, command in sink.sent[:-1])
    read = read_flight_log(tmp_path / "flight.mcap")
    assert read.commands == tuple(command for _, command in sink.sent)
    assert read.command_times == pytest.approx([t for t, _ in sink.sent])


def test_a_sink_that_fails_at_the_safe_command_raises():
    """The link breaks after five steps: the caller gets the error."""

    class Broken(Recorder):
        def send(self, t, command):
            if len(self.sent) == 5:
                raise OSError("no link")
            super().send(t, command)

    with pytest.raises(OSError, match="no link"):
        Loop(Pilot(), Broken()).run(0.25)


def test_a_mode_that_raises_is_dropped_and_the_flight_goes_on():
    """Read in the first step only; all five commands are the pilot's."""

    class Speechless(Pilot):
        asked = 0

        @property
        def mode(self):
            self.asked += 1
            raise RuntimeError("lost for words")

    pilot, sink = Speechless(), Recorder()
    flight = Loop(pilot, sink, hooks=(sink,)).run(0.25)
    assert (flight.reason, flight.faults, pilot.asked) == ("duration", 0, 1)
    assert [step.mode for step in sink.steps] == [""] * 5
    assert [command.throttle for _, command in sink.sent] == [0.5] * 5 + [0.0]
    (dropped,) = (event for event in flight.events if event.name == "mode dropped")
    assert "lost for words" in dropped.details["error"]


def test_a_duration_that_is_not_positive_is_refused():
    """Zero, negative, nan."""
    for duration in (0.0, -1.0, float("nan")):
        with pytest.raises(InputError, match="duration"):
            Loop(Pilot(), Recorder()).run(duration)
