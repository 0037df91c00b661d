"""Rehearsal: the kit's expert as a SIMULATED pilot with a radio -> sticks at a board's pilot pin,
and the images seen.

So `falconwing record` can be tried without hardware: what it records is an approach, flown by the
sticks it records.
"""

import numpy as np

from falconwing_kit.core.messages import Image, Observation
from falconwing_kit.flight.loop import CONTROL_PERIOD, HISTORY
from falconwing_kit.flight.sources import RenderedView, fpv_camera
from falconwing_kit.flight.tasks import LandingTask, trial_seed
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.tools.bridge.simulated_link import Simulation
from falconwing_kit.trainer_port.ppm import Calibration


class SimulatedManualApproach:
    """A SIMULATED landing by hand: an image source that flies on whenever it is asked, 20 steps a
    second.

    Args:
        simulation: the board whose pilot pin gets the sticks.
        radio: how the simulated pilot's radio puts sticks into microseconds.
        scene: the hall that the camera sees.
        camera: the lens; None takes the aircraft's.
        seed: of the start and the noise, from the frozen list.
    """

    def __init__(
        self,
        simulation: Simulation,
        radio: Calibration,
        scene: GaussianScene,
        camera: PinholeCamera | None = None,
        seed: int = 0,
    ) -> None:
        task = LandingTask()
        trial = task.trial(trial_seed(0, seed))
        self.world, self._pilot = trial.world, task.expert(trial)
        self._view = RenderedView(
            self.world, scene, camera or fpv_camera(), task.airframe.p_body_camera
        )
        self._simulation, self._radio = simulation, radio
        self._past = np.zeros((HISTORY, 4))
        self._step, self._image = -1, Image(0, 0.0, self._view.look())

    @property
    def over(self) -> bool:
        """Has the aircraft come down?"""
        return self.world.contact is not None

    def next_image(self, t: float) -> Image | None:
        """The newest view at time t [s] of the recording; the aircraft is flown there first."""
        step = int(t / CONTROL_PERIOD + 1e-6)
        if step > self._step and not self.over:
            self._step = step
            self._image = self._view.next_image(step * CONTROL_PERIOD)
            command = self._pilot.act(
                Observation(step * CONTROL_PERIOD, self._image, self._past, self.world.measured())
            )
            self._past = np.vstack([self._past[1:], command.vector])
            self.world.send(step * CONTROL_PERIOD, command)
            with self._simulation.pause() as board:
                board.set_pilot(self._radio.channels_us(command))
        return self._image
