"""The lock by the leader's own pixels beside the one by its outline: how often they differ.

    python -m pytest -m benchmark -s tests/benchmarks/bench_lock.py

Views of the leader that ships, alone before a far wall: anywhere in the image, level flights of the
follower; and every frame of expert flights in the hall, where something may hide the leader.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from falconwing_kit.aircraft.airframe import load_airframe
from falconwing_kit.core.messages import State
from falconwing_kit.flight import FollowTask, RenderedView, fpv_camera
from falconwing_kit.flight.judges import LOCK_AREA_PX, is_locked, outline_pixels
from falconwing_kit.flight.loop import LoopStep
from falconwing_kit.scene import load_scene
from falconwing_kit.tools.trials.trials import TrialSettings, fly_trial
from tests.flight.test_judges import plate

pytestmark = pytest.mark.benchmark
VIEWS, FLIGHTS = 400, 2
DISTANCES = ((3.0, 6.0), (6.0, 10.0), (10.0, 16.0), (16.0, 24.0))  # [m]


@pytest.mark.parametrize("size", [(320, 240), (160, 120)])
def test_views_of_the_leader(size, capsys):
    """By distance: locked by pixels, by the outline, and by one of them only."""
    rng, airframe, camera = np.random.default_rng(3), load_airframe(), fpv_camera(*size)
    level = State.from_vector(np.zeros(9))
    world = SimpleNamespace(state=level, leader_state=level)
    view = RenderedView(world, plate((0.0, 0.02, 0.02), "hall"), camera, (-60.0, 0.0, 0.0))
    for low, high in DISTANCES:
        both = np.zeros((2, 2), int)
        for _ in range(VIEWS):
            ahead = rng.uniform(low, high)
            p = np.array([ahead, *(ahead * rng.uniform(-0.55, 0.55, 2))]) - (60.0, 0.0, 0.0)
            roll, pitch, yaw = np.radians((60.0, 30.0, 45.0)) * rng.uniform(-1.0, 1.0, 3)
            leader = State(p, pitch, yaw, roll, np.zeros(3))
            world.leader_state = leader
            T, share = view.T_world_camera, view.leader_share
            by_outline = is_locked(camera, T, leader, airframe)
            both[int(is_locked(camera, T, leader, airframe, share)), int(by_outline)] += 1
        with capsys.disabled():
            print(
                f"\n{size[0]}x{size[1]}, {low:g} to {high:g} m: of {VIEWS} views both {both[1, 1]},"
                f" outline only {both[0, 1]}, pixels only {both[1, 0]}", end="",
            )  # fmt: skip


def test_flights_of_the_expert(capsys):
    """In the hall: frames locked by pixels, by the outline whatever hides it, and by one only."""
    hall, camera = load_scene("hall"), fpv_camera()
    for manoeuvre in ("left_turn_s_descent", "right_turn_s_ascent", "right_turn_sharp_climb"):
        task, both = FollowTask(manoeuvre), np.zeros((2, 2), int)
        for number in range(FLIGHTS):
            judges = []

            def watch(step: LoopStep, judges=judges, both=both, task=task) -> None:
                view, leader = judges[0].view, judges[0].leader.state_at(step.t)
                T, share = view.T_world_camera, view.leader_share
                outline = outline_pixels(camera, T, leader, task.airframe) >= LOCK_AREA_PX
                pixels = is_locked(camera, T, leader, task.airframe, share)
                both[int(pixels), int(outline)] += 1

            class Watched(FollowTask):
                """The task, whose evaluator is kept."""

                def judge(self, *arguments, judges=judges):
                    judges.append(super().judge(*arguments))
                    return judges[0]

            watched = Watched(manoeuvre)
            setting = TrialSettings(scene=hall, camera=camera, hooks=(watch,))
            fly_trial(watched, watched.expert, number, 0, setting)
        with capsys.disabled():
            print(
                f"\n{manoeuvre}, {FLIGHTS} flights: of {both.sum()} frames both {both[1, 1]},"
                f" outline only {both[0, 1]}, pixels only {both[1, 0]}", end="",
            )  # fmt: skip
