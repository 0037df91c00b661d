"""Supervision of a class: each step, and who flies it -> go on, or hand back, and why.

A class is simulated and its time stretches on a busy machine, so the real time that an autopilot
takes for a step is no fault of it here; its images, commands, attitude and height are judged as
those of every autonomous flight.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

from falconwing_kit.core.messages import SAFE_COMMAND, Command, Image, State
from falconwing_kit.flight.supervisor import Supervisor, SupervisorSettings

PACED_LIMITS = SupervisorSettings(max_pilot_s=math.inf)  # where time waits for the pilot


class AutopilotSupervisor:
    """The supervisor over the autopilot's turns; a student's end at the envelope (envelope.py).

    A student may hand back beyond the limits of attitude and height. They count for the autopilot
    from the moment at which the aircraft is inside them again.
    """

    def __init__(self, student_flies: Callable[[], bool], *, by_images: bool = False) -> None:
        """student_flies: whether the present step's command is a student's."""
        self._supervisor = Supervisor(PACED_LIMITS, by_images=by_images)
        self._student_flies, self._was_student = student_flies, False

    @property
    def reason(self) -> str:
        """Why control was handed back; empty while all is well."""
        return self._supervisor.reason

    @property
    def record(self) -> Mapping[str, Any]:
        """Limits and reason, for the log."""
        return self._supervisor.record

    def see(self, image: Image, t: float) -> None:
        """Take note of a new image, whoever flies."""
        self._supervisor.see(image, t)

    def check(self, t: float, command: Command | None, state: State | None, pilot_s: float) -> str:
        """Why control must be handed back; empty to go on, and always while a student flies."""
        if self._student_flies():
            self._was_student = True
            return ""
        if self._was_student and state is not None:
            self._was_student = bool(Supervisor(PACED_LIMITS).check(t, SAFE_COMMAND, state))
        return self._supervisor.check(t, command, None if self._was_student else state, pilot_s)
