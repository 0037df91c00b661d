"""Engagement: logs written by hand -> the state that a repeated flight starts from."""

import numpy as np
import pytest

from falconwing_kit.aircraft.airframe import load_airframe
from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_log import FlightLogWriter
from falconwing_kit.core.frames import camera_pose
from falconwing_kit.core.messages import SAFE_COMMAND, Image, State
from falconwing_kit.flight.sources import fpv_camera
from falconwing_kit.scene import load_scene, render
from falconwing_kit.tools.trials.engagement import state_at_engagement

MODEL, MOUNT = rates_model(), load_airframe().p_body_camera


def at(x: float, **more) -> State:
    return State(np.array([x, -2.0, 1.5]), 0.05, 0.1, -0.1, np.array([7.0, 0.0, 0.0]), **more)


def test_the_flight_begins_where_the_pilot_was_engaged(tmp_path):
    """States at x = -20 + 7 t each 50 ms from 100 s on; engaged at 101.0 s: x = -13, with its
    velocity and rates. Without the event the first state counts.
    """
    for name, events in (("flown", (101.0,)), ("plain", ())):
        with FlightLogWriter(tmp_path / f"{name}.mcap") as log:
            for k in range(60):
                t = 100.0 + 0.05 * k
                if t in events:
                    log.event(t, "engaged", {})
                log.state(t, at(-20.0 + 0.35 * k, rates_body=np.array([0.1, 0.2, 0.3])), -1)
    state = state_at_engagement(tmp_path / "flown.mcap", MODEL, MOUNT)
    assert state.p_world == pytest.approx([-13.0, -2.0, 1.5])
    assert state.rates_body == pytest.approx([0.1, 0.2, 0.3])
    first = state_at_engagement(tmp_path / "plain.mcap", MODEL, MOUNT)
    assert first.p_world == pytest.approx([-20.0, -2.0, 1.5])


def test_without_states_the_pose_network_looks_at_the_image(tmp_path):
    """As in the paper: the image at engagement. Two images of the hall from 15 and 19 m before the
    pad, the first before the engagement: within a metre of the second's pose (the network's mean
    error is 0.36 m), flying at 7 m/s along it.
    """
    hall, camera = load_scene("hall"), fpv_camera()
    with FlightLogWriter(tmp_path / "images.mcap") as log:
        log.event(5.2, "engaged", {})
        for k, x in enumerate((-14.0, -18.0)):
            state = at(x)
            pose = camera_pose(state.pose.T_world_body, MOUNT)
            pixels = np.asarray(255.0 * render(hall, camera, pose, backend="fast").rgb, np.uint8)
            log.command(5.0 + 0.3 * k, SAFE_COMMAND, Image(k, 5.0 + 0.3 * k, pixels))
    state = state_at_engagement(tmp_path / "images.mcap", MODEL, MOUNT)
    assert np.linalg.norm(state.p_world - at(-18.0).p_world) < 1.0
    assert (state.roll, state.pitch, state.yaw) == pytest.approx((-0.1, 0.05, 0.1), abs=0.05)
    assert np.linalg.norm(state.v_world) == pytest.approx(7.0, abs=0.1)
    assert state.v_world[0] > 6.5


def test_a_log_without_either_is_refused(tmp_path):
    """Engaged two seconds after the last state: one sentence."""
    with FlightLogWriter(tmp_path / "late.mcap") as log:
        log.state(1.0, at(-20.0), -1)
        log.event(4.0, "engaged", {})
    with pytest.raises(InputError, match="expected a state, or an image of the hall"):
        state_at_engagement(tmp_path / "late.mcap", MODEL, MOUNT)
