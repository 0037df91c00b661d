"""`falconwing scene`: the steps from nothing or from photos to a scene, one word each."""

from dataclasses import dataclass
from typing import Annotated

import tyro

from falconwing_kit.tools.cli.edit import Edit
from falconwing_kit.tools.cli.fit import Fit
from falconwing_kit.tools.cli.photos import Align, Poses
from falconwing_kit.tools.cli.pose_net import TrainPoseNet
from falconwing_kit.tools.cli.scene import Build, Info


@dataclass(frozen=True)
class Scene:
    """Make and inspect Gaussian scenes; poses, align and fit lead from photos to a scene."""

    step: tyro.conf.OmitSubcommandPrefixes[
        Build
        | Info
        | Poses
        | Align
        | Fit
        | Edit
        | Annotated[TrainPoseNet, tyro.conf.subcommand("pose-net")]
    ]

    def run(self) -> int:
        """Do the chosen step; see its own `run`."""
        return self.step.run()
