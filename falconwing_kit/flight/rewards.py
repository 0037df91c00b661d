"""Rewards: the truth of a flight and its verdict -> the reward of each step, for learning.

    reward = outcome(verdict) at the end + lock each step + discount potential(s') - potential(s)

The last two are potential-based shaping, which leaves the best policy as it is: the potential of an
end by contact is zero, so over a flight the shaping adds up to minus the potential of its start,
whatever was flown [Ng, Harada & Russell 1999, Policy invariance under reward transformations].
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from falconwing_kit.aircraft.airframe import Airframe
from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.control.expert import AIM, landing_path
from falconwing_kit.core.checks import Array
from falconwing_kit.core.messages import State

DISCOUNT = 0.99  # of a step of 50 ms; an agent should have the same
# Deviations that lower a landing's potential by one
TO_GO, ACROSS, ABOVE, ANGLE = 20.0, 2.0, 1.0, 1.0  # [m], [m], [m], [rad]
HARD = 1.0  # sink rate at which nothing is left for softness [m/s]
FOLLOW_ERROR = 4.0  # off its station that lowers a follower's potential by one [m]
LOCK_REWARD = 0.05  # of a step with the leader in view: 1 a second


class LandingReward:
    """Outcome of a landing, and a potential that rises along the glide path to the touchdown."""

    def __init__(self, airframe: Airframe, pad: LandingPad) -> None:
        path, _ = landing_path(airframe, pad)
        self._x, self._z, self._pad = path.p_world[:, 0], path.p_world[:, 2], pad
        self._aim = pad.x_start + AIM

    def potential(self, x: Array) -> Array:
        """2 less the distance to go / 20 m, off the centre line / 2 m, off the glide path / 1 m,
        |roll| / 1 rad and |yaw| / 1 rad.

        Args:
            x: (..., 12) true states in the order of STATE_NAMES, SI.

        Returns:
            (...) potentials.
        """
        to_go = np.maximum(self._aim - x[..., 0], 0.0) / TO_GO
        across = np.abs(x[..., 1] - self._pad.y_centre) / ACROSS
        above = np.abs(x[..., 2] - np.interp(x[..., 0], self._x, self._z)) / ABOVE
        turned = (np.abs(x[..., 4]) + np.abs(x[..., 5])) / ANGLE
        return np.asarray(2.0 - to_go - across - above - turned)

    def outcome(self, result: Mapping[str, Any]) -> float:
        """3 for a wheel on the pad, less up to 1 for the offset and up to 1 for the sink rate.

        Args:
            result: of `LandingEvaluator`.

        Returns:
            1 to 3, or 0 for anything but a landing.
        """
        if not result["success"]:
            return 0.0
        offset = abs(result["lateral_offset_m"]) / max(self._pad.width / 2.0, 1e-9)
        return 3.0 - min(offset, 1.0) - min(max(result["sink_rate_m_s"] / HARD, 0.0), 1.0)


class FollowReward:
    """A reward for each step with the leader in view, and a potential about the station."""

    def __init__(self, behind: float) -> None:
        """behind: of the station, along the leader's course [m]."""
        self._behind = behind

    def potential(self, own: State, leader: State) -> float:
        """1 less the distance to the station behind the leader / 4 m, from the true states."""
        ahead = leader.v_world / max(float(np.linalg.norm(leader.v_world)), 1e-9)
        error = np.linalg.norm(leader.p_world - self._behind * ahead - own.p_world)
        return float(1.0 - error / FOLLOW_ERROR)
