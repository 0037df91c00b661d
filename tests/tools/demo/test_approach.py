"""The demo's approach: what its log holds, that it lands, its figures, and what is left when the
disk is full.
"""

import contextlib
import itertools
import os
import re
import signal
import time
import weakref
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image as Picture

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_log import FlightLogWriter, read_flight_log, to_flight_table
from falconwing_kit.core.messages import Command, Image, State
from falconwing_kit.flight.loop import PacedClock
from falconwing_kit.scene.arena import load_scene
from falconwing_kit.tools.demo import approach as module
from falconwing_kit.tools.demo.approach import (
    FIGURES,
    approach_record,
    approach_section,
    draw_approach,
    draw_film,
    draw_flight,
    fly_approach,
    is_simulated,
    mode_at,
    speeds,
)


@pytest.fixture(scope="module")
def steps():
    """What a hook was shown."""
    return []


@pytest.fixture(scope="module")
def approach(tmp_path_factory, steps):
    """One landing for all tests."""
    return fly_approach(
        load_scene("arena"), tmp_path_factory.mktemp("flown") / "approach.mcap", (steps.append,)
    )


@pytest.fixture(scope="module")
def figures(approach):
    """Its figures."""
    return draw_flight(approach.log, approach.log.parent)


@contextlib.contextmanager
def small_disk(size):
    """A disk that refuses files above a size, by the kernel's own limit."""
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_log_holds_every_step_as_it_was_shown(approach, steps):
    """One image, state and command for each step, 50 ms apart, and each command names the image
    that it answers.

    After them the motor is idle.
    """
    log = read_flight_log(approach.log)
    *commands, last = log.commands
    assert len(steps) == len(commands) == len(log.states) == len(log.image_times) > 40
    assert not last.vector.any()
    assert np.diff(log.state_times) == pytest.approx(0.05, abs=1e-6)
    assert [s.command.image_sequence for s in steps] == list(log.image_sequences)
    for seen, command, state in zip(steps, commands, log.states, strict=True):
        assert np.array_equal(seen.command.vector, command.vector)
        assert np.array_equal(seen.state.vector, state.vector)
    assert is_simulated(log) and log.warnings == ()
    assert (log.metadata["task"], log.metadata["scene"]) == ("landing", "arena")


def test_log_tells_the_modes(approach, steps):
    """At every step the mode that the hook was shown."""
    log = read_flight_log(approach.log)
    assert [mode_at(log, s.t) for s in steps] == [s.mode for s in steps]
    assert steps[0].mode == "approach" and len({s.mode for s in steps}) > 1
    assert mode_at(log, -1.0) == ""


@pytest.mark.parametrize("start", [0.0, 300.0, 1.7e9])
def test_modes_are_told_from_the_start_of_the_log(tmp_path, start):
    """By hand: approach at once, flare 0.10 s later, for any clock at the log's start."""
    with FlightLogWriter(tmp_path / "own.mcap") as log:
        for k in range(4):
            log.command(start + 0.05 * k, Command(0.5, 0.0, 0.0, 0.0))
        log.event(start, "mode", {"mode": "approach"})
        log.event(start + 0.10, "mode", {"mode": "flare"})
    own = read_flight_log(tmp_path / "own.mcap")
    assert [mode_at(own, 0.05 * k) for k in range(-1, 4)] == [
        "",
        "approach",
        "approach",
        "flare",
        "flare",
    ]


def test_it_ends_on_the_pad(approach, steps):
    """By the logged poses, not by the judge: over the pad, and no higher than the aircraft stands,
    0.2 m and noise.
    """
    x, y, z = steps[-1].state.p_world
    pad = LandingPad()
    assert pad.x_start < x < pad.x_start + pad.length
    assert abs(y - pad.y_centre) < pad.width / 2.0
    assert z < pad.height + 0.2
    assert approach.result["success"] and approach.flight.reason == "touched pad"


def test_images_show_the_pad_growing(steps):
    """The blue share of the lower half of the view grows from under 2 % at 20 m to over 10 % at the
    threshold.
    """

    def blue(step):
        r, g, b = (step.image.pixels[120:, :, k].astype(int) for k in range(3))
        return float(((b > 90) & (b > 2 * r) & (b > g + 40)).mean())

    threshold = next(s for s in steps if s.state.p_world[0] > LandingPad().x_start - 1.0)
    assert 0.0 < blue(steps[0]) < 0.02
    assert blue(threshold) > 0.10


def test_figures_are_whole_and_the_film_is_short(approach, figures):
    """Complete PNG files; ten images a second of flight, less than 4 MB, and none of them like the
    one before.
    """
    assert [path.name for path in figures] == list(FIGURES)
    for path in figures:
        content = path.read_bytes()
        assert content.startswith(b"\x89PNG\r\n\x1a\n") and content[-8:-4] == b"IEND", path.name
    film = Picture.open(figures[-1])
    assert film.n_frames == pytest.approx(10.0 * approach.flight.t[-1], abs=2)
    assert film.info["duration"] == 100
    assert figures[-1].stat().st_size < 4e6
    frames = []
    for number in range(film.n_frames):
        film.seek(number)
        frames.append(np.asarray(film.convert("RGB")).astype(int)[:, :320])  # the view
    assert min(np.abs(a - b).mean() for a, b in itertools.pairwise(frames)) > 1.0


def test_film_looks_as_what_the_camera_saw(figures, steps):
    """One palette for all images: mean difference a few of 255 from the first rendered view."""
    first = np.asarray(Picture.open(figures[-1]).convert("RGB")).astype(int)[:, :320]
    assert np.abs(first - steps[0].image.pixels.astype(int)).mean() < 8.0


def test_film_of_a_long_flight_needs_no_more_memory(tmp_path, monkeypatch):
    """A minute at 20 Hz has 1200 images: the film has 200 at most and lasts a minute, and never are
    more than two decoded images or sheets alive at once, the one in work and the one that it
    follows.
    """
    with FlightLogWriter(tmp_path / "long.mcap") as log:
        for k in range(1200):
            pixels = np.full((24, 32, 3), k % 250, np.uint8)
            log.state(
                0.05 * k,
                State(np.array([0.02 * k, 0.0, 1.0]), 0.0, 0.0, 0.0, np.zeros(3)),
                image_sequence=k,
            )
            log.command(0.05 * k, Command(0.5, 0.0, 0.1, 0.0, k), Image(k, 0.05 * k, pixels))
    most = []

    def counted(make):
        def made(*what):
            thing = make(*what)
            marks.append(weakref.ref(thing))
            most.append(sum(mark() is not None for mark in marks))
            return thing

        marks = []
        return made

    for name in ("decode_jpeg", "_film_frame"):
        monkeypatch.setattr(module, name, counted(getattr(module, name)))
    path, flight = tmp_path / "film.png", read_flight_log(tmp_path / "long.mcap")
    draw_film(flight, to_flight_table(flight), path, "FLIGHT")
    film = Picture.open(path)
    assert 150 < film.n_frames <= 200
    assert film.n_frames * film.info["duration"] == pytest.approx(60_000, rel=0.01)
    assert most and max(most) <= 2


def test_page_part_says_simulation_and_where_it_touched_down(approach, figures):
    """Four figures with words for who cannot see them; the record's number in centimetres."""
    text = approach_section(approach, approach.log.parent)
    assert "SIMULATION" in text and text.count("<img ") == 4
    assert f"on the pad {100.0 * approach_record(approach)['ald_m']:.0f} cm beside" in text
    assert (
        "The hall: simulated hall, built from arena.toml" in text
    )  # the scene's own words, so that a hall is named


def test_missed_landing_is_owned_up_to(approach, figures):
    """No centimetres where nothing was touched."""
    missed = SimpleNamespace(
        log=approach.log,
        result={"success": False},
        flight=approach.flight,
        hall="",
        pilot="expert",
        end="why",
        seen=(),
    )
    text = approach_section(missed, approach.log.parent)
    assert "It did not land on the pad</strong> (why)" in text
    assert "beside its centre line" not in text


def test_the_supervisor_ends_an_approach_that_rolls_over(tmp_path, monkeypatch):
    """Full aileron: beyond 80 deg of bank the flight ends; log and words say why."""
    full = Command(0.6, 1.0, 0.1, 0.0)
    pilot = SimpleNamespace(act=lambda observation: full)
    monkeypatch.setattr(module.LandingTask, "expert", lambda task, trial: pilot)
    flown = fly_approach(load_scene("arena"), tmp_path / "rolled.mcap")
    assert re.fullmatch(r"handed back: bank of -?\d+ deg, at most 80 allowed", flown.end)
    assert not flown.result["success"]
    events = [event for event in read_flight_log(flown.log).events if event.name == "handed back"]
    reasons = [event.details["reason"] for event in events if "reason" in event.details]
    assert len(reasons) == 1 and reasons[0] in flown.end  # the port's own event has none


def test_same_seed_flies_the_same(approach, steps, tmp_path):
    """To the last bit of every command; another seed starts elsewhere."""
    again, other = [], []
    fly_approach(load_scene("arena"), tmp_path / "a.mcap", (again.append,))
    fly_approach(load_scene("arena"), tmp_path / "b.mcap", (other.append,), seed=1)
    assert all(
        np.array_equal(a.command.vector, b.command.vector)
        for a, b in zip(steps, again, strict=True)
    )
    assert np.abs(other[0].state.p_world - steps[0].state.p_world).max() > 0.05


def test_paced_clock_waits_for_a_slow_machine(monkeypatch):
    """By hand, on a watch that only sleeping moves: steps of 0.1 s at half speed are due every 0.2
    s; one that took 0.5 s is followed at once, and those after it again 0.2 s apart. The flight's
    own time misses nothing.
    """
    watch, due = [10.0], []
    monkeypatch.setattr(time, "perf_counter", lambda: watch[0])
    monkeypatch.setattr(time, "sleep", lambda seconds: watch.append(watch.pop() + seconds))
    clock = PacedClock(0.5)
    clock.start()
    for k, work in enumerate((0.0, 0.05, 0.5, 0.0, 0.0)):
        clock.wait_until(0.1 * k)
        due.append(watch[0])
        assert clock.now() == pytest.approx(0.1 * k)
        watch[0] += work
    assert due == pytest.approx([10.0, 10.2, 10.4, 10.9, 11.1])


def test_flight_in_real_time_is_that_in_simulated_time(approach, steps, tmp_path):
    """To the last bit of every command, also where this machine is too slow for real time."""
    again = []
    fly_approach(load_scene("arena"), tmp_path / "a.mcap", (again.append,), PacedClock(2.0))
    assert len(again) == len(steps)
    assert all(
        np.array_equal(a.command.vector, b.command.vector)
        for a, b in zip(steps, again, strict=True)
    )


def test_ctrl_c_ends_more_than_the_approach(tmp_path):
    """Ctrl-C in the third step: whoever called is told, the older log is as it was and nothing is
    beside it.
    """
    (tmp_path / "approach.mcap").write_text("of yesterday")
    steps = []

    def third(step):
        steps.append(step)
        if len(steps) == 3:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        fly_approach(load_scene("arena"), tmp_path / "approach.mcap", (third,))
    assert len(steps) == 3
    assert os.listdir(tmp_path) == ["approach.mcap"]
    assert (tmp_path / "approach.mcap").read_text() == "of yesterday"


def test_full_disk_keeps_the_log_of_before(tmp_path):
    """The new log does not fit: one sentence, the older one as it was, and nothing half-written
    beside it.
    """
    (tmp_path / "approach.mcap").write_text("of yesterday")
    with (
        small_disk(50_000),
        pytest.raises(InputError, match="the disk is full"),
        pytest.warns(UserWarning),
    ):
        fly_approach(load_scene("arena"), tmp_path / "approach.mcap")
    assert os.listdir(tmp_path) == ["approach.mcap"]
    assert (tmp_path / "approach.mcap").read_text() == "of yesterday"


def test_flight_without_images_has_no_view_to_draw(tmp_path):
    """An own log of poses and sticks: path and sticks are drawn, nothing else."""
    with FlightLogWriter(tmp_path / "own.mcap") as log:
        for k in range(40):
            log.state(
                0.05 * k,
                State(np.array([0.2 * k, 0.0, 1.0]), 0.0, 0.0, 0.0, np.array([4.0, 0.0, 0.0])),
            )
            log.command(0.05 * k, Command(0.5, 0.0, 0.1, 0.0))
    assert [path.name for path in draw_flight(tmp_path / "own.mcap", tmp_path)] == list(
        FIGURES[1:3]
    )
    assert not is_simulated(read_flight_log(tmp_path / "own.mcap"))


def test_flight_without_poses_is_one_sentence(tmp_path):
    """Images and sticks alone give nothing to draw a path from."""
    with FlightLogWriter(tmp_path / "blind.mcap") as log:
        for k in range(5):
            log.command(
                0.05 * k,
                Command(0.5, 0.0, 0.1, 0.0, k),
                Image(k, 0.05 * k, np.zeros((8, 8, 3), np.uint8)),
            )
    with pytest.raises(InputError, match="expected a log with at least two poses"):
        draw_flight(tmp_path / "blind.mcap", tmp_path)


@pytest.mark.parametrize(
    "extra", [{}, {"vx": np.full(9, 3.0), "vy": np.full(9, 4.0), "vz": np.zeros(9)}]
)
def test_speed_of_a_straight_line(extra):
    """By hand: 3 and 4 m/s along x and y are 5 m/s, from positions and from logged velocities."""
    t = 0.1 * np.arange(9)
    table = SimpleNamespace(t=t, p_world=np.stack([3.0 * t, 4.0 * t, 0.0 * t], axis=1), extra=extra)
    assert speeds(table) == pytest.approx(5.0, rel=1e-12)


def test_the_trained_hall_is_landed_in_by_images_alone(tmp_path):
    """The log names the pilot, and its commands answer images; the page says what it sees."""
    flown = fly_approach(load_scene("hall"), tmp_path / "hall.mcap", scene_name="hall")
    assert flown.result["success"] and flown.result["ald_m"] < 0.25
    log = read_flight_log(flown.log)
    assert (log.metadata["pilot"], log.metadata["port"]) == ("student", "sim-python")
    answered = [command.image_sequence for command in log.commands]
    assert answered[:60] == list(range(60))
    assert approach_record(flown)["pilot"] == "student"
    t = [t for t, _ in flown.seen]
    assert t == pytest.approx(flown.flight.t[: len(t)]) and len(t) > 60
    assert (tmp_path / "flight_seen.png") in draw_approach(flown, tmp_path)
    assert "Where the pilot looks" in approach_section(flown, tmp_path)
