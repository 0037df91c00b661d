"""The session on simulated time: take-over, silence, effects and the log of a scripted student."""

import math
import threading
import time

import numpy as np
import pytest

from falconwing_kit.aircraft.effects import CATALOGUE
from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_log import read_flight_log
from falconwing_kit.core.messages import Command, State
from falconwing_kit.flight.loop import SimulatedClock
from falconwing_kit.flight.tasks import LandingTask, trial_seed
from falconwing_kit.tools.classroom.channel import HOLDERS, SticksMessage, unpack_state
from falconwing_kit.tools.classroom.envelope import envelope_problem, room_ahead
from falconwing_kit.tools.classroom.hands import Hands
from falconwing_kit.tools.classroom.results import judge, model_with_effects
from falconwing_kit.tools.classroom.session import (
    ClassClock,
    Session,
    SessionSettings,
    class_effects,
    draw_effect,
    make_task,
)
from falconwing_kit.tools.classroom.supervise import AutopilotSupervisor

LEVEL = Command(0.55, 0.01, 0.05, -0.02)


class Script:
    """A publisher that notes everything, and after every step acts as the class: {step: action}."""

    def __init__(self, actions):
        self.actions, self.states, self.texts, self.records = actions, [], [], []
        self.now, self.sequence, self.is_holding = 0.0, 0, False
        self.hands = Hands(clock=lambda: self.now)
        self.session = None

    def state(self, data):
        state = unpack_state(data)
        if state.flags & 8:
            return
        self.states.append(state)
        if action := self.actions.get((state.flight, state.step)):
            action(self)
        for _ in range(5):  # 100 Hz
            self.now += 0.01
            if self.is_holding is not None and self.hands.owner:
                self.sequence += 1
                self.hands.sticks(
                    1, SticksMessage(self.is_holding, False, self.sequence, 0, *LEVEL.vector)
                )

    def text(self, kind, **fields):
        self.texts.append((kind, fields))

    def step(self, session, step, truth):
        pass

    def finished(self, record):
        self.records.append(record)

    def kinds(self, kind):
        """The messages of a kind."""
        return [fields for name, fields in self.texts if name == kind]


def hold(value):
    """Press (True), release (False) or fall silent (None)."""
    return lambda script: setattr(script, "is_holding", value)


def fly(folder, actions, flights=1, **settings):
    """Fly a script on simulated time."""
    script = Script(actions)
    settings = {"laps": 0, "pause_s": 0.0} | settings
    session = Session(
        SessionSettings(folder, **settings), script, script.hands,
        clock=lambda session: SimulatedClock(),
    )  # fmt: skip
    script.session = session
    session.run(flights)
    return script


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Flight 1: the autopilot lands. Flight 2: Mia takes over, drag comes on, she falls silent."""
    return fly(
        tmp_path_factory.mktemp("class"),
        {
            (2, 4): lambda s: s.hands.give(1, "Mia"),
            (2, 6): hold(True),
            (2, 12): lambda s: s.session.request("effect", ("extra_drag", True)),
            (2, 20): hold(None),
        },
        2,
    )


def test_the_autopilot_lands_by_itself(flown):
    """Success by the task's own judge, and the verdict's numbers are those of its record."""
    verdict = flown.kinds("verdict")[0]
    assert verdict["success"] is True and verdict["sentence"].startswith("on the pad")
    assert 0.0 < verdict["numbers"]["sink rate"][0] < 1.0
    assert verdict["holders"] == []


def test_the_student_flies_and_silence_hands_back(flown):
    """Pressed at step 6: five messages at 100 Hz are in before step 7. Silent after step 20: 200 ms
    are four steps.
    """
    holders = [HOLDERS[state.holder] for state in flown.states if state.flight == 2]
    assert holders[:7] == ["autopilot"] * 7
    assert set(holders[7:24]) == {"student"}
    assert set(holders[25:]) == {"autopilot"}
    sent = [state.numbers[9:13] for state in flown.states if state.flight == 2]
    assert sent[10] == pytest.approx(LEVEL.vector, abs=1e-6)
    who = [(fields["holder"], fields["name"]) for fields in flown.kinds("who")]
    assert who == [("student", "Mia"), ("autopilot", "Mia")]


def test_the_log_says_what_happened(flown):
    """Metadata of the contract; changes of hands and the effect as events at their times."""
    log = read_flight_log(flown.records[1].log)
    start = LandingTask().trial(trial_seed(1)).world.state.vector
    assert log.metadata["task"] == "landing" and log.metadata["scene"] == "arena"
    assert int(log.metadata["seed"]) == trial_seed(1) == flown.records[1].seed
    assert np.array(eval(log.metadata["start"])) == pytest.approx(start)
    events = {
        (event.name, event.details.get("holder", event.details.get("on"))): event
        for event in log.events
        if event.name in ("hands", "effect")
    }
    assert list(events) == [("hands", "student"), ("effect", True), ("hands", "autopilot")]
    assert events["effect", True].t == pytest.approx(0.65)  # the step after the request
    assert events["effect", True].details["parameters"] == {"drag_added": 0.02}
    assert "200 ms" in events["hands", "autopilot"].details["reason"]
    assert flown.records[1].holders == ("Mia",) and flown.records[1].effects == ()


def test_requests_end_a_flight_and_change_the_task(tmp_path):
    """Restart flies the same seed again; another task begins at once; a wrong one is refused."""
    script = fly(
        tmp_path,
        {
            (1, 5): lambda s: s.session.request("restart"),
            (2, 5): lambda s: s.session.request("task", ("nonsense", "")),
            (2, 9): lambda s: s.session.request("task", ("follow", "left_turn_s_descent")),
            (3, 9): lambda s: s.session.request("end"),
        },
        9,
    )
    begun = [(fields["task"], fields["seed"]) for fields in script.kinds("flight")]
    assert begun == [
        ("landing", trial_seed(0)), ("landing", trial_seed(0)), ("follow", trial_seed(1)),
    ]  # fmt: skip
    assert any("nonsense" in fields["text"] for fields in script.kinds("error"))
    assert script.states[-1].flags & 1 and math.isfinite(script.states[-1].numbers[13])
    assert script.kinds("verdict") == []


def test_old_logs_go_and_recorded_ones_stay(tmp_path):
    """Keep one: of three flights the first is recorded and stays, the second goes."""
    fly(
        tmp_path,
        {
            (1, 1): lambda s: s.session.request("record", True),
            (2, 1): lambda s: s.session.request("record", False),
        },
        3,
        keep=1,
    )
    assert sorted(path.name for path in tmp_path.glob("*.mcap")) == [
        "flight_0001.mcap", "flight_0003.mcap",
    ]  # fmt: skip


def test_an_autopilot_that_fails_does_not_end_the_class(tmp_path, monkeypatch):
    """Every act raises: the loop sends safe commands and gives up, the verdict says so, and the
    next flight begins.
    """

    def fail(self, observation):
        raise ValueError("broken")

    monkeypatch.setattr(
        "falconwing_kit.tools.classroom.autopilot.LapsAndLanding.act", fail, raising=True
    )
    script = fly(tmp_path, {}, 2, laps=1)
    assert len(script.kinds("flight")) == 2
    assert [fields["success"] for fields in script.kinds("verdict")] == [False, False]


def test_an_autopilot_that_rolls_over_is_handed_back_and_the_class_goes_on(tmp_path, monkeypatch):
    """Full aileron: beyond 80 deg of bank the safe command is the last one; log, news and verdict
    say why, the log judged again says the same, and the next flight begins.
    """
    full = Command(0.6, 1.0, 0.1, 0.0)
    monkeypatch.setattr(
        "falconwing_kit.tools.classroom.autopilot.LapsAndLanding.act", lambda self, seen: full
    )
    script = fly(tmp_path, {}, 2, laps=1)
    first, second = script.kinds("verdict")
    assert second["flight"] == 2 and first["success"] is False
    assert "the supervisor handed back: bank of" in first["sentence"]
    news = [fields["text"] for fields in script.kinds("event") if fields["name"] == "handed back"]
    assert len(news) == 2 and "at most 80 allowed" in news[0]
    log = read_flight_log(script.records[0].log)
    (event,) = [event for event in log.events if event.name == "handed back"]
    assert event.details["reason"] in first["sentence"]
    assert not log.commands[-1].vector.any() and log.commands[-3].aileron == 1.0
    assert abs(script.states[-1].numbers[3]) > math.radians(80.0)
    assert judge(script.records[0]).sentence == first["sentence"]


def test_the_supervisor_judges_the_autopilot_alone():
    """A student at 100 deg of bank is the envelope's; the autopilot that takes over there is
    judged once it was inside 80 deg; the real time of a step is no fault where time stretches.
    """
    is_student = [False]
    supervisor = AutopilotSupervisor(lambda: is_student[0])

    def banked(t, degrees, student, command=LEVEL, pilot_s=0.01):
        is_student[0] = student
        state = State.from_vector(
            np.array([0.0, 0.0, 2.0, 0.0, 0.0, math.radians(degrees), 0.0, 0.0, 0.0])
        )
        return supervisor.check(t, command, state, pilot_s)

    turns = ((0, False), (100, True), (100, False), (90, False), (20, False), (70, False))
    assert [banked(0.05 * k, *turn) for k, turn in enumerate(turns)] == [""] * 6
    assert banked(0.3, 100, True, command=None) == ""
    assert banked(0.35, 20, False, pilot_s=5.0) == ""
    assert "bank of 100 deg" in banked(0.4, 100, False)
    assert "no finite command" in AutopilotSupervisor(lambda: False).check(0.0, None, None, 0.0)


def test_through_the_port_the_board_gets_the_commands(tmp_path):
    """The Python board: the autopilot lands through PPM pulses, and states say that it is there."""
    script = fly(tmp_path, {}, 1, port="sim-python")
    assert script.kinds("verdict")[0]["success"] is True
    assert all(state.flags & 16 for state in script.states)


def test_every_effect_of_the_catalogue_can_be_switched(tmp_path):
    """Each one's plainly visible size changes the model, and is gone without it."""
    model = rates_model()
    names = [effect.name for effect in class_effects()]
    assert set(names) == {effect.name for effect in CATALOGUE if effect.sizes}
    for name in names:
        changed = model_with_effects(model, {name: draw_effect(name, 3)})
        assert len(changed.effects) == 1 and changed.values != model.values
    both = {name: draw_effect(name, 3) for name in ("wind", "extra_drag")}
    assert len(model_with_effects(model, both).effects) == 2
    with pytest.raises(InputError, match="extra_drag"):
        draw_effect("nonsense", 0)
    with pytest.raises(InputError, match="landing"):
        make_task("nonsense")


def test_an_effect_acts_from_its_switch_on(tmp_path):
    """Much more drag slows the aircraft: the same start and seed with and without."""
    drag = {(1, 2): lambda s: s.session.request("effect", ("extra_drag", True))}
    plain, slowed = fly(tmp_path / "", {}, 1), None
    (tmp_path / "b").mkdir()
    slowed = fly(tmp_path / "b", drag, 1)
    speed = [np.linalg.norm(script.states[25].numbers[6:9]) for script in (plain, slowed)]
    same = [script.states[2].numbers[:9] for script in (plain, slowed)]
    assert same[0] == same[1]
    assert plain.states[25].numbers[9] < slowed.states[25].numbers[9] or speed[1] < speed[0]


def state(x, y, z, course_deg=0.0, roll_deg=0.0):
    """An aircraft at 7 m/s, level."""
    course = math.radians(course_deg)
    v = 7.0 * np.array([math.cos(course), -math.sin(course), 0.0])
    return State(np.array([x, y, z]), 0.05, course, math.radians(roll_deg), v)


def test_the_envelope_leaves_room_to_turn():
    """By hand: in the middle of the hall along it there is room; 3 m before the end wall, at its
    side outwards, too high or upside down there is none. Low before the pad the walls do not count.
    """
    assert envelope_problem(state(-10.0, -2.0, 2.0)) == ""
    assert room_ahead(state(-10.0, -2.0, 2.0)) == pytest.approx(27.5)
    assert "wall" in envelope_problem(state(14.5, -2.0, 2.0))
    assert "wall" in envelope_problem(state(0.0, 5.0, 2.0, course_deg=-90.0))
    assert envelope_problem(state(0.0, -9.0, 2.0, course_deg=-90.0)) == ""
    assert "higher" in envelope_problem(state(-10.0, -2.0, 4.4))
    assert "attitude" in envelope_problem(state(-10.0, -2.0, 2.0, roll_deg=120.0))
    assert envelope_problem(state(10.0, -2.0, 0.5)) == ""
    broken = State(np.full(3, np.nan), 0.0, 0.0, 0.0, np.zeros(3))
    assert envelope_problem(broken) and "wall" in envelope_problem(
        state(10.0, -2.0, 0.5), is_landing=False
    )


def test_the_clock_of_a_class_slows_pauses_and_says_how_late_it_is(monkeypatch):
    """On a watch that only sleeping moves: steps of 0.1 s at half speed are due every 0.2 s; one
    that took 0.5 s delays the others by 0.3 s, a third of a second, and time has stretched.
    """
    watch, due = [10.0], []
    monkeypatch.setattr("time.perf_counter", lambda: watch[0])
    clock = ClassClock()
    monkeypatch.setattr(
        clock._hurried, "wait", lambda seconds: watch.append(watch.pop() + seconds) or False
    )
    clock.speed = 0.5
    clock.start()
    for k, work in enumerate((0.0, 0.05, 0.5, 0.0, 0.0)):
        clock.wait_until(0.1 * k)
        due.append(watch[0])
        watch[0] += work
    assert due == pytest.approx([10.0, 10.2, 10.4, 10.9, 11.1])
    assert clock.stretch() == pytest.approx(1.0 / 0.7)
    clock.paused, waits = True, []

    def on_wait():
        waits.append(clock.now())
        clock.paused = len(waits) < 3

    clock._on_wait = on_wait
    clock.wait_until(0.5)
    assert waits == [0.4] * 3 and clock.now() == 0.5


def test_a_hurried_step_comes_at_once_and_the_next_a_period_later():
    """A step due in 5 s is flown when it is hurried, from another thread; the next takes its 0.1 s
    from there, on the machine's own clock.
    """
    clock = ClassClock()
    clock.start()
    clock.wait_until(0.0)
    begin = time.perf_counter()
    threading.Timer(0.05, clock.hurry).start()
    clock.wait_until(5.0)
    hurried = time.perf_counter()
    assert 0.04 < hurried - begin < 2.0 and clock.now() == 5.0
    clock.wait_until(5.1)
    assert 0.09 < time.perf_counter() - hurried < 2.0 and clock.stretch() < 1.5


def test_without_an_autopilot_the_flight_waits_for_a_student(tmp_path):
    """Nothing falls to the floor while no one holds: the first step flown is the student's."""
    script = Script({})
    settings = SessionSettings(tmp_path, pilot="manual", pause_s=0.0)
    script.hands = Hands(False, clock=lambda: script.now)
    session = Session(settings, script, script.hands, clock=lambda session: SimulatedClock())
    script.hands.give(1, "Mia")
    for k, is_pressed in enumerate((False, *[True] * 5)):
        script.now += 0.01
        script.hands.sticks(1, SticksMessage(is_pressed, False, k + 1, 0, *LEVEL.vector))
    script.sequence, script.is_holding = 6, True
    session.run(1)
    assert script.states[0].step == 0 and HOLDERS[script.states[0].holder] == "student"
    assert script.kinds("verdict")[0]["holders"] == ["Mia"]
    idle, ended = Script({}), []
    idle.hands = Hands(False, clock=lambda: 0.0)
    waiting = Session(settings, idle, idle.hands, clock=lambda session: SimulatedClock())
    idle.state = lambda data: ended.append(data) or (len(ended) > 3 and waiting.request("end"))
    (tmp_path / "flight_0001.mcap").unlink()
    waiting.run(1)
    assert unpack_state(ended[0]).step == 0 and unpack_state(ended[0]).holder == 3
