"""Rehearsal of a recording: the expert as a SIMULATED pilot -> pilot pin of a board, and images.

`falconwing record` can thus be tried without hardware: it records an approach flown by the expert.
"""

import numpy as np

from falconwing_kit.core.messages import CONTROL_PERIOD_S, Image, Observation
from falconwing_kit.flight.loop import HISTORY
from falconwing_kit.flight.metadata import flight_metadata
from falconwing_kit.flight.sources import RenderedView, fpv_camera
from falconwing_kit.flight.tasks import LandingTask, trial_seed
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.tools.bridge.open_port import Simulation
from falconwing_kit.trainer_port.ppm import Calibration


class SimulatedManualApproach:
    """A SIMULATED manual landing as an image source: each call advances the flight, at 20 Hz.

    Args:
        simulation: the board whose pilot pin receives the control inputs.
        radio: calibration of the simulated pilot's radio.
        scene: to render.
        camera: None for the aircraft's.
        seed: of the initial state and the noise, from the frozen list.
        scene_name: of the scene, for the log.
    """

    def __init__(
        self,
        simulation: Simulation,
        radio: Calibration,
        scene: GaussianScene,
        camera: PinholeCamera | None = None,
        seed: int = 0,
        scene_name: str = "arena",
    ) -> None:
        task = LandingTask()
        trial = task.trial(trial_seed(0, seed))
        # The recording says itself which board it came through.
        self.metadata = flight_metadata(
            task, trial, scene=scene_name, pilot="expert, as a SIMULATED pilot at the radio"
        )
        self.world, self._pilot = trial.world, task.expert(trial)
        self._view = RenderedView(
            self.world, scene, camera or fpv_camera(), task.airframe.p_body_camera
        )
        self._simulation, self._radio = simulation, radio
        self._past = np.zeros((HISTORY, 4))
        self._step, self._image = -1, Image(0, 0.0, self._view.look())

    @property
    def over(self) -> bool:
        """Whether the aircraft has touched down."""
        return self.world.contact is not None

    def next_image(self, t: float) -> Image | None:
        """The newest image at time t [s] of the recording, after the aircraft is advanced to it."""
        step = int(t / CONTROL_PERIOD_S + 1e-6)
        if step > self._step and not self.over:
            self._step = step
            self._image = self._view.next_image(step * CONTROL_PERIOD_S)
            command = self._pilot.act(
                Observation(step * CONTROL_PERIOD_S, self._image, self._past, self.world.measured())
            )
            self._past = np.vstack([self._past[1:], command.vector])
            self.world.send(step * CONTROL_PERIOD_S, command)
            with self._simulation.pause() as board:
                board.set_pilot(self._radio.channels_us(command))
        return self._image
