"""`falconwing scene`: the steps from nothing or from photos to a scene, one word each."""

from dataclasses import dataclass

import tyro

from falconwing_kit.tools.cli.edit import Edit
from falconwing_kit.tools.cli.fit import Fit
from falconwing_kit.tools.cli.photos import Align, Poses
from falconwing_kit.tools.cli.scene import Build, Info


@dataclass(frozen=True)
class Scene:
    """Make and inspect Gaussian scenes: poses, align and fit lead from photos of your own hall to a
    scene of it.
    """

    step: tyro.conf.OmitSubcommandPrefixes[Build | Info | Poses | Align | Fit | Edit]

    def run(self) -> int:
        """Do the chosen step; see its own `run`."""
        return self.step.run()
