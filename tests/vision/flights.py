"""Simulated flights as the onboard camera sees them: the expert's landings and chases, rendered in
the arena.
"""

from functools import cache

import numpy as np

from falconwing_kit.flight.loop import Loop
from falconwing_kit.flight.sources import MeasuredStates, RenderedView, fpv_camera
from falconwing_kit.flight.tasks import FlightTask, FollowTask, LandingTask, trial_seed
from falconwing_kit.scene.arena import load_scene

# Ten flights; each but the landings turns, the figure eight without end.
TASKS: tuple[FlightTask, ...] = (
    *(LandingTask() for _ in range(4)),
    *(FollowTask("left_turn_s_descent") for _ in range(2)),
    *(FollowTask("right_turn_s_ascent") for _ in range(2)),
    FollowTask("right_turn_sharp_climb"),
    FollowTask("figure_eight"),
)
PERIOD = 0.05  # s


@cache
def flown(number: int, judging: bool = True, size: tuple[int, int] = (320, 240)) -> np.ndarray:
    """The pictures of one of the ten flights (N, H, W, 3) uint8, 20 a second.

    Args:
        number: in TASKS.
        judging: fly a seed of the list that judges; False for one of those that the monitor's
            settings were tuned on.
        size: of the pictures [px].
    """
    task = TASKS[number]
    trial, camera, pictures = (
        task.trial(trial_seed(number) if judging else number),
        fpv_camera(*size),
        [],
    )
    view = RenderedView(trial.world, load_scene("arena"), camera, task.airframe.p_body_camera)
    judge, pilot = task.judge(trial, camera), task.expert(trial)
    loop = Loop(pilot, trial.world, view, MeasuredStates(trial.world), trial.leader)
    loop.hooks = (lambda step: pictures.append(step.image.pixels),)
    loop.run(trial.duration, judge.watch)
    return np.array(pictures)
