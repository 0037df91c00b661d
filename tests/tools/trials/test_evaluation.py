"""Evaluation: what a pilot is given, what is kept, and what is counted, by hand and with toys."""

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.messages import Command, Image
from falconwing_kit.flight import pilots
from falconwing_kit.flight.pilots import PilotEntry
from falconwing_kit.flight.sources import MeasuredStates
from falconwing_kit.flight.trial import trial_seed
from falconwing_kit.flight.world import SimulatedWorld
from falconwing_kit.scene import load_scene
from falconwing_kit.tools.trials import evaluation
from falconwing_kit.tools.trials.evaluation import (
    Cell,
    SilentSupervisor,
    count_go_arounds,
    fly_cell_trial,
    fly_cells,
    make_scene,
    read_records,
    summarise_cell,
)
from falconwing_kit.tools.trials.evaluation_page import evaluation_tables, write_evaluation
from falconwing_kit.tools.trials.worlds import UNSEEN, WORLDS

TINY = (32, 24)


class Cheat:
    """Dives, and notes what it was given."""

    seen: ClassVar[list] = []  # of all flights

    def __init__(self) -> None:
        self.mode, self.resets = "cheat", 0

    def reset(self) -> None:
        self.resets += 1

    def act(self, observation) -> Command:
        self.seen.append(observation)
        return Command(0.0, 0.0, -1.0, 0.0)


@pytest.fixture
def cheat(monkeypatch):
    """A pilot by images named `student`, in the table of pilots and at its door."""
    pilot, asked = Cheat(), []
    Cheat.seen.clear()
    entry = PilotEntry("a toy", ("landing", "follow"), False)
    monkeypatch.setitem(pilots.PILOTS, "student", entry)

    def load(name, task, scene, camera, p_body_camera_m, **more):
        asked.append((name, task, scene, camera.width, more))
        return pilot

    monkeypatch.setattr(evaluation, "load_pilot", load)
    evaluation._load.cache_clear()
    yield SimpleNamespace(pilot=pilot, asked=asked)
    evaluation._load.cache_clear()


@pytest.mark.parametrize("task", ["landing", "follow"])
def test_a_pilot_by_images_gets_images_and_nothing_else(task, cheat, monkeypatch):
    """The simulated state lies, and would be a fault if it were read: no observation has one, the
    pilot was loaded without a leader, by its name alone, and began anew.
    """

    def lie(self, t):
        raise AssertionError("a state was read")

    monkeypatch.setattr(MeasuredStates, "state_at", lie)
    world = "wide" if task == "landing" else "training"
    record = fly_cell_trial((Cell("student", task, WORLDS[world], TINY), 1))
    assert {observation.state for observation in Cheat.seen} == {None}
    assert all(o.image.pixels.shape == (24, 32, 3) for o in Cheat.seen)
    assert cheat.asked == [("student", task, "hall", 32, {})] and cheat.pilot.resets == 1
    assert not record["success"] and record["faults"] == 0
    assert record["seed"] == trial_seed(1) and record["cpu_ms_median"] >= 0.0


def test_a_state_that_leaks_would_be_seen(cheat, monkeypatch):
    """Planted: the table says that the same pilot reads the state. Its observations have one."""
    monkeypatch.setitem(pilots.PILOTS, "student", PilotEntry("a toy", ("landing",), True))
    fly_cell_trial((Cell("student", "landing", WORLDS["paper"], TINY), 0))
    assert all(observation.state is not None for observation in Cheat.seen)


def test_a_flight_that_overflows_is_a_failure(cheat, monkeypatch):
    """The world raises in its fifth step: a record with the error as reason; a pilot that cannot be
    made is an error of the whole run.
    """

    def explode(self, t, command):
        if t > 0.19:
            raise OverflowError("state")

    monkeypatch.setattr(SimulatedWorld, "send", explode)
    cell = Cell("student", "landing", WORLDS["paper"], TINY)
    record = fly_cell_trial((cell, 0))
    assert record["reason"] == "simulation ended: state" and not record["success"]
    assert summarise_cell([record])["successes"] == 0
    json.dumps(record, allow_nan=False)
    monkeypatch.setattr(Cheat, "reset", lambda self: explode(self, 1.0, None))
    with pytest.raises(OverflowError):
        fly_cell_trial((cell, 0))


def test_an_ended_run_goes_on_where_it_was(tmp_path, cheat):
    """Three trials, the last line cut by a kill: the next run flies that one and two more. Records
    of other weights are refused.
    """
    cell = Cell("student", "landing", WORLDS["paper"], TINY)
    first = fly_cells([cell], 3, tmp_path)
    path = tmp_path / "trials.jsonl"
    path.write_text(path.read_text()[:-20])
    flown = []
    again = fly_cells([cell], 5, tmp_path, progress=lambda d, of, r: flown.append((d, of, r)))
    assert [(done, of) for done, of, _ in flown] == [(2, 5), (3, 5), (4, 5), (5, 5)]
    assert [record["trial"] for record in again] == [0, 1, 2, 3, 4]
    assert [r["path_m"] for r in again[:3]] == [r["path_m"] for r in first]
    assert fly_cells([cell], 5, tmp_path) == again
    lines = path.read_text().splitlines()
    assert len(lines) == 6
    path.write_text("\n".join([json.dumps({"kit": "0", "weights": "other"}), *lines[1:]]) + "\n")
    with pytest.raises(InputError, match="choose another folder"):
        read_records(tmp_path)
    path.write_text(lines[0] + "\nnot a record\n")
    with pytest.raises(InputError, match="damaged"):
        read_records(tmp_path)


def test_no_trial_begins_after_the_time_is_up(tmp_path, cheat):
    """A thousandth of a second: one trial is flown, and kept."""
    cell = Cell("student", "landing", WORLDS["paper"], TINY)
    assert len(fly_cells([cell], 4, tmp_path, minutes=1e-5)) == 1
    assert len(read_records(tmp_path)) == 1


def test_worlds_are_apart_in_the_records(tmp_path):
    """Another world, image size, list, scene, pilot or weights is another trial."""
    cell = Cell("expert", "landing", WORLDS["paper"])
    changes = ({"world": WORLDS["curved"]}, {"pilot": "expert_pid"}, {"size": TINY}, {"seed": 1},
               {"scene": "arena"}, {"weights_digest": "1"})  # fmt: skip
    others = [replace(cell, **change) for change in changes]
    assert len({one.key for one in (cell, *others)}) == 7
    assert replace(cell, weights="elsewhere/policy.safetensors").key == cell.key
    assert cell.key == Cell("expert", "landing", WORLDS["paper"]).key


def test_turns_back_are_counted():
    """Along the runway: straight; one turn of 3 m or more and back; two; 2 m back are none."""
    assert count_go_arounds(np.arange(-20.0, 3.0)) == 0
    once = [*range(-20, 5), *range(4, -18, -1), *range(-17, 4)]
    assert count_go_arounds(np.array(once, float)) == 1
    twice = [*once, *range(3, -18, -1), *range(-17, 4)]
    assert count_go_arounds(np.array(twice, float)) == 2
    assert count_go_arounds(np.array([-20.0, -10.0, -12.0, -5.0, -7.0, 3.0])) == 0


def test_the_supervisor_notes_and_does_not_act():
    """Identical images: five in a row are a fault at the fifth (t = 0.2 s), and the answer is
    empty; its reason stays although the images then move again.
    """
    supervisor, command = SilentSupervisor(by_images=True), Command(0.5, 0.0, 0.0, 0.0)
    rng = np.random.default_rng(1)
    for k in range(10):
        pixels = np.full((24, 32, 3), 128, np.uint8)
        if k > 6:
            pixels = rng.integers(0, 255, (24, 32, 3)).astype(np.uint8)
        supervisor.see(Image(k, 0.05 * k, pixels), 0.05 * k)
        answer = supervisor.check(0.05 * k, Command(*command.vector, image_sequence=k), None, 99.0)
        assert answer == ""
    assert supervisor.record["reason"] != "" and supervisor.record["t_s"] <= 0.2 + 1e-9


def record(trial: int, success: bool, **more) -> dict:
    found = {"key": "k", "trial": trial, "success": success, "faults": 0}
    found |= {"cpu_ms_median": 1.0 + trial, "cpu_ms_p95": 5.0}
    return found | {"supervisor": {"reason": "", "t_s": None}, **more}


def test_rates_and_means_by_hand():
    """9 of 10, of which one missed the pad: ALD of landings only, mean of 1 to 9 cm; Wilson's
    interval of 9 of 10 is 59.6 to 98.2 % [Newcombe 1998's formula, by hand]; two would have been
    ended for the same reason with different numbers.
    """
    records = [record(k, k > 0, **({"ald_m": 0.01 * k} if k else {})) for k in range(10)]
    for k in (3, 4):
        records[k]["supervisor"] = {"reason": f"image of 0.{k} s", "t_s": 1.0}
    found = summarise_cell(records)
    assert (found["successes"], found["trials"]) == (9, 10)
    assert found["success"] == pytest.approx(
        {"rate": 0.9, "low95": 0.5958, "high95": 0.9821}, abs=1e-4
    )
    assert found["ald_m"]["mean"] == pytest.approx(0.05) and found["ald_m"]["of"] == 9
    assert 0.03 < found["ald_m"]["low95"] < 0.05 < found["ald_m"]["high95"] < 0.07
    assert found["cpu_ms_median"] == 5.5 and found["sink_rate_m_s"] is None
    assert found["supervised"]["rate"] == 0.2
    assert found["supervised"]["reasons"] == {"image of #.# s": 2}


def test_tables_stand_beside_the_paper(tmp_path):
    """Rows of three unseen manoeuvres and of all together; the paper's row of RGB: 30 %, 102 cm,
    20 ms [Table I]; files are written, with a curve for a sweep.
    """
    cells = {}
    for name in (*UNSEEN, "scale 0.5", "scale 1", "scale 2"):
        cell = Cell("rgb", "follow", WORLDS[name])
        cells[cell] = [record(k, k % 2 == 0, ate_m=0.4 + 0.1 * k) for k in range(4)]
    paper, other = evaluation_tables(cells)
    rows = {row[1]: row for row in (*paper.rows, *other.rows)}
    assert (len(paper.rows), len(other.rows)) == (4, 3)
    assert rows["three unseen together"][2] == "6 of 12"
    assert rows["three unseen together"][-1] == "30 % of 30, 102 cm, 20 ms"
    assert rows["left turn s descent"][4].startswith("55.0 (") and rows["scale 2"][-1] == "-"
    files = write_evaluation(cells, tmp_path)
    assert files["follow"].read_bytes()[1:4] == b"PNG"
    assert "102 cm" in files["tables"].read_text() and "102 cm" in files["page"].read_text()
    lines = [json.loads(line) for line in files["summary"].read_text().splitlines()]
    assert [line["level"] for line in lines][-3:] == [0.5, 1.0, 2.0]


def test_the_leader_has_the_worlds_look():
    """Twice as large: its Gaussians lie twice as far from its centre of gravity; 30 % of them black
    or white; a red one has no blue and more red. The hall's own are the same.
    """
    plain, hall = load_scene("leader"), load_scene("hall")
    looks = {name: make_scene(Cell("expert", "follow", WORLDS[name]), 3)
             for name in ("scale 2", "salt and pepper 0.3", "leader red")}  # fmt: skip
    leaders = {name: scene.selected(scene.labelled("leader")) for name, scene in looks.items()}
    assert leaders["scale 2"].means == pytest.approx(2.0 * plain.means, abs=1e-6)
    changed = (leaders["salt and pepper 0.3"].sh != plain.sh).any(axis=(1, 2)).mean()
    assert changed == pytest.approx(0.3, abs=0.01)
    red, _, blue = (leaders["leader red"].sh - plain.sh)[:, 0].mean(axis=0)
    assert red > 0.1 > -0.1 > blue
    for scene in looks.values():
        assert np.array_equal(scene.means[: len(hall)], hall.means)
    assert make_scene(Cell("expert", "follow", WORLDS["scale 1"]), 3) is make_scene(
        Cell("expert", "landing", WORLDS["paper"]), 4
    )
