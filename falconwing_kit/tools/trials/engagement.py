"""Engagement: a flight log -> the state in which its pilot took over, to repeat the flight from it.

The paper repeats each of its ten real landings in simulation from the pose at which the autonomous
mode was engaged, which its pose network estimates from the image of that moment. A log of the kit
has states where its pilot had some; otherwise the pose network is asked here too.
"""

from pathlib import Path

import numpy as np

from falconwing_kit.aircraft.model import Model
from falconwing_kit.control.expert import landing_speed
from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.files import short_name
from falconwing_kit.core.flight_log import FlightLog, read_flight_log
from falconwing_kit.core.frames import camera_pose, euler_from_rotation
from falconwing_kit.core.messages import CONTROL_PERIOD_S, State
from falconwing_kit.flight.sources import decode_jpeg, fpv_camera, log_start_time
from falconwing_kit.flight.trial import state_at_pose

ENGAGED = "engaged"  # the event of the trainer port
MAX_SIGMA = 1.0  # of a position that is taken [m]
MAX_WAIT_S = 1.0  # after the engagement, for a state or a pose


def state_at_engagement(path: str | Path, model: Model, p_body_camera: Array) -> State:
    """The state in which a log's pilot took over.

    The engagement is the first event of that name, or the log's start. The state is the first one
    logged from then on; without states it is the pose that the hall's pose network finds in the
    first image where it is certain enough, with a trimmed flight's velocity along it.

    Args:
        path: an MCAP log.
        model: the aircraft, for the velocity.
        p_body_camera: (3,) the camera in body axes [m].

    Raises:
        FileNotFoundError: there is no log.
        InputError: within a second of the engagement there is neither a state nor an image in which
            the network finds a pose.
    """
    log = read_flight_log(path)
    engaged = [event.t for event in log.events if event.name == ENGAGED]
    begin = engaged[0] if engaged else log_start_time(log)
    for t, state in zip(log.state_times, log.states, strict=True):
        if _is_soon(float(t), begin) and np.isfinite(state.vector[:6]).all():
            if np.isfinite(state.vector).all():
                return state
            attitude = (state.roll, state.pitch, state.yaw)
            return state_at_pose(model, state.p_world, attitude, landing_speed(model))
    found = _pose_of_images(log, begin, p_body_camera)
    if found is None:
        raise InputError(
            f"{short_name(path)}: expected a state, or an image of the hall, within"
            f" {MAX_WAIT_S:g} s of the engagement, got none; use x,y,z,roll,pitch,yaw"
        )
    return state_at_pose(model, *found, speed=landing_speed(model))


def _is_soon(t: float, begin: float) -> bool:
    """Whether a time is that of the engagement or within a second of it."""
    return -0.5 * CONTROL_PERIOD_S <= t - begin <= MAX_WAIT_S


def _pose_of_images(
    log: FlightLog, begin: float, p_body_camera: Array
) -> tuple[Array, tuple[float, float, float]] | None:
    """Position and roll, pitch, yaw of the aircraft by the pose network; None without."""
    if not any(_is_soon(float(t), begin) for t in log.image_times):
        return None
    from falconwing_kit.vision.pose_net import PoseNet

    net = PoseNet.load("hall")
    T_body_camera = camera_pose(np.eye(4), p_body_camera)
    for image in log.images():
        if not _is_soon(image.t, begin):
            continue
        pixels = decode_jpeg(image)
        pose = net.estimate(pixels, fpv_camera(pixels.shape[1], pixels.shape[0]))
        if np.max(pose.sigma_position) <= MAX_SIGMA:
            T_world_body = pose.T_world_camera @ np.linalg.inv(T_body_camera)
            roll, pitch, yaw = map(float, euler_from_rotation(T_world_body[:3, :3]))
            return T_world_body[:3, 3], (roll, pitch, yaw)
    return None
