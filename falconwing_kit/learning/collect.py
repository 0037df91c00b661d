"""Collecting: situations -> flights with images, by the expert with noise or by a policy that the
expert labels.

Noise on the expert's commands leads flights off the path, where its answers show how to come back
[DART, Laskey et al. 2017]; flights by a policy go where that policy goes [DAgger, Ross, Gordon &
Bagnell 2011]. The label of every image is the expert's command on the true state.
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch

from falconwing_kit.core.checks import Array
from falconwing_kit.core.messages import CONTROL_PERIOD_S, Image, Observation
from falconwing_kit.flight.pilots import ReadyPilot
from falconwing_kit.learning.datasets import Episode
from falconwing_kit.learning.flights import PAST, Fleet, Job
from falconwing_kit.learning.learner import Flown
from falconwing_kit.learning.policy_views import PolicyViews
from falconwing_kit.learning.situations import Situation
from falconwing_kit.vision.images import Pixels
from falconwing_kit.vision.policy import CONTROLS

MEMORY = 0.8  # of the noise from one step to the next; its correlation time is 0.2 s
LOW, HIGH = np.array([0.0, -1.0, -1.0, -1.0]), np.ones(CONTROLS)
MakePilot = Callable[[Array], ReadyPilot]  # camera in body axes (3,) -> a pilot by images


def fly_episodes(
    fleet: Fleet, views: PolicyViews, jobs: Sequence[Job], noise: float,
    make_pilot: MakePilot | None = None,
) -> list[Episode]:  # fmt: skip
    """Fly the situations of some jobs to their ends.

    Args:
        fleet: flies them side by side.
        views: what the cameras see.
        jobs: one for each flight.
        noise: most standard deviation of the noise on the commands, in shares of full travel; each
            flight draws its own between zero and this.
        make_pilot: makes the pilot of each flight; None for the expert.

    Returns:
        The flights in the order of the jobs.
    """
    fleet.prepare(jobs)
    situations = fleet.begin()
    recorders = [Recorder(situation, noise, make_pilot) for situation in situations]
    fleet.send(None)
    while True:
        now = fleet.snapshot()
        rows = np.flatnonzero(now.flies)
        if not len(rows):
            break
        commands = np.zeros((len(situations), CONTROLS))
        for row, image, mask in _seen(
            views, situations, rows.tolist(), now.Ts_world_camera, now.Ts_world_leader
        ):
            pose, teacher, auxiliary = (
                part[row] for part in (now.Ts_world_camera, now.teacher, now.auxiliary)
            )
            commands[row] = recorders[row].step(image, mask, pose, teacher, auxiliary)
        fleet.send(commands)
    outcomes = fleet.outcomes()
    return [
        recorder.episode(outcome) for recorder, outcome in zip(recorders, outcomes, strict=True)
    ]


class Recorder:
    """One flight: chooses its commands and keeps what was seen, done and taught."""

    def __init__(self, situation: Situation, noise: float, make_pilot: MakePilot | None) -> None:
        self._situation = situation
        self._pilot = None if make_pilot is None else make_pilot(situation.p_body_camera)
        if self._pilot is not None:
            self._pilot.reset()
        self._rng = np.random.default_rng([situation.seed, 23])
        self._sigma, self._drift = self._rng.uniform(0.0, noise), np.zeros(CONTROLS)
        self._images: list[torch.Tensor] = []
        self._masks: list[torch.Tensor] = []
        self._rows: list[tuple[Array, ...]] = []  # pose, sent, teacher, auxiliary

    def step(
        self, image: torch.Tensor, mask: torch.Tensor | None, T_world_camera: Array,
        teacher: Array, auxiliary: Array,
    ) -> Array:  # fmt: skip
        """The command (4,) to send at this moment.

        Args:
            image: (3, h, w) bytes.
            mask: (h, w) bytes of the leader, or None.
            T_world_camera: (4, 4) where the image was taken.
            teacher: (4,) what the expert would do.
            auxiliary: (AUXILIARY,) of the true state.
        """
        self._images.append(image)
        if mask is not None:
            self._masks.append(mask)
        command = teacher if self._pilot is None else self._by_pilot(self._pilot)
        # a random walk that forgets, of standard deviation sigma
        white = self._rng.normal(size=CONTROLS) * self._sigma
        self._drift = MEMORY * self._drift + np.sqrt(1.0 - MEMORY**2) * white
        sent = np.clip(command + self._drift, LOW, HIGH)
        self._rows.append((T_world_camera, sent, teacher, auxiliary))
        return sent

    def episode(self, outcome: dict[str, object]) -> Episode:
        """What was kept."""
        poses, sent, teacher, auxiliary = (np.array(part) for part in zip(*self._rows, strict=True))
        masks = torch.stack(self._masks) if self._masks else None
        mount = self._situation.p_body_camera
        flown = Flown(torch.stack(self._images), masks, sent, teacher, auxiliary, mount)
        return Episode(flown, poses, self._situation.seed, dict(outcome))

    def _by_pilot(self, pilot: ReadyPilot) -> Array:
        """The pilot's command on the newest image that was delivered; it is given no state."""
        k = len(self._images) - 1
        newest = int(self._situation.newest[min(k, len(self._situation.newest) - 1)])
        image = None
        if newest >= 0:
            pixels = self._pixels(newest)
            image = Image(newest, newest * CONTROL_PERIOD_S, pixels)
        past = np.zeros((PAST, CONTROLS))
        sent = np.array([row[1] for row in self._rows[-PAST:]]).reshape(-1, CONTROLS)
        past[PAST - len(sent) :] = sent
        return pilot.act(Observation(k * CONTROL_PERIOD_S, image, past, None)).vector

    def _pixels(self, frame: int) -> Pixels:
        pixels = self._images[frame].permute(1, 2, 0).cpu().numpy()
        return pixels * np.uint8(not self._situation.black[frame])


def _seen(
    views: PolicyViews, situations: Sequence[Situation], rows: Sequence[int],
    Ts_world_camera: Array, Ts_world_leader: Array,
) -> Iterator[tuple[int, torch.Tensor, torch.Tensor | None]]:  # fmt: skip
    """Row, image and mask of each flight; those of odd seeds are averaged from twice the size."""
    for fine in (False, True):
        some = [int(row) for row in rows if situations[row].seed % 2 == fine]
        if some:
            images, masks = views.render(Ts_world_camera[some], Ts_world_leader[some], fine)
            for k, row in enumerate(some):
                yield row, images[k], None if masks is None else masks[k]
