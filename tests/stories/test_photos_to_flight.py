"""From photos to a flight table on a CPU, every step in small; mistakes of sign and frame must not
get through.

24 path-traced photos -> poses -> the kit's world -> 2,000 Gaussians at 64 x 48 -> a toy pose net ->
the states of the onboard video that ships. What is checked at the end ties the steps to each other
and to laws of flight, so that a step that is wrong by itself but looks well is found out.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.aircraft.model import rates_model
from falconwing_kit.core.flight_table import FlightTable
from falconwing_kit.core.frames import GRAVITY, R_BODY_CAMERA, pose_matrix, rotation_world_body
from falconwing_kit.data import data_path
from falconwing_kit.learning.pose_net_loop import TrainSchedule
from falconwing_kit.scene import GaussianScene, PinholeCamera, render
from falconwing_kit.scene.edit import move
from falconwing_kit.sysid.forecast import constant_velocity, forecast
from falconwing_kit.tools.capture import pose_net_training
from falconwing_kit.tools.capture.align import transform_reconstruction
from falconwing_kit.tools.capture.fit import FitSettings, fit_scene
from falconwing_kit.tools.capture.photo_files import Reconstruction, write_reconstruction
from falconwing_kit.tools.cli.poses import read_video
from falconwing_kit.vision import (
    HybridSettings,
    PoseNet,
    Video,
    estimate_flight,
    hybrid_state,
    smoother,
)
from tests.scene.hall24 import alignments, reconstruction, survey

ROOM = HybridSettings()
# So few Gaussians cover a hall only if they may be large and need not be faint.
TOY = FitSettings(
    gaussians=2000,
    steps=200,
    sh_degree=0,
    width=64,
    exposures=False,
    minutes=5.0,
    pose_steps=0,
    backend="reference",
    room=(*ROOM.room_low, *ROOM.room_high),
    opacity_cost=0.01,
    scale_cost=0.01,
    largest=0.0,
)
BOX = (-18.0, -6.0, 0.5, -2.0, 8.0, 3.0)  # where the photos look and the video flies [m]
FRAMES = 45  # of the video: the marker is in view in most of them
UPRIGHT, LOOKS = (
    "photos were taken upright in the room",
    "the scene looks like the video from where the flight says",
)
TURNS, FORETOLD = (
    "bank turns the flight path",
    "the model foretells the flight better than a straight line",
)
CAMERA, SMALL = PinholeCamera.from_fov_deg(320, 240, 77.8), PinholeCamera.from_fov_deg(64, 48, 77.8)


@dataclass(frozen=True)
class Walk:
    """What the steps left."""

    poses: Reconstruction
    scene: GaussianScene
    held_out_db: float
    net: PoseNet
    net_off_m: float  # median on renders
    video: Video
    table: FlightTable


@cache
def first_half() -> tuple[Reconstruction, GaussianScene, float, PoseNet, float]:
    """Photos to poses to the world to a scene to a net, once."""
    poses = transform_reconstruction(alignments().best, reconstruction())
    folder = Path(tempfile.mkdtemp())
    write_reconstruction(folder / "aligned", poses)
    done = fit_scene(poses, folder / "fit", TOY, survey(), say=lambda _: None)
    plan = TrainSchedule(steps=150, minutes=2.0, batch=16, fresh=8, pool=400, first=60)
    job = pose_net_training.PoseNetConfig(
        done.path,
        folder / "aligned",
        folder / "net",
        plan=plan,
        width=64,
        features=32,
        layers=2,
        heads=2,
        box=BOX,
    )
    report = pose_net_training.train_pose_net(job)
    net = PoseNet.load(folder / "net" / "pose_net.safetensors")
    return (
        poses,
        done.scene,
        done.figures["held_out"]["psnr_db"],
        net,
        report["renders"]["position_m"]["median"],
    )


def walk() -> Walk:
    """All steps; the flight is read off the video afresh, so that what a test planted in there
    acts.
    """
    poses, scene, db, net, off = first_half()
    video = read_video(data_path("case02_calm.csv").parent / "hall_clip")
    video = replace(video, t=video.t[:FRAMES], commands=video.commands[:FRAMES])
    flight = estimate_flight(video, CAMERA, net)
    return Walk(poses, scene, db, net, off, video, flight.table)


def problems(seen: Walk) -> set[str]:
    """The checks that fail, by name."""
    checks: dict[str, Callable[[Walk], bool]] = {
        UPRIGHT: upright_in_the_room,
        "the scene looks like photos kept back": lambda w: w.held_out_db > 17.0,
        "the net knows the room": lambda w: w.net_off_m < 0.7 * guess_off(),
        "the flight is known": lambda w: int(w.table.has_pose.sum()) >= 25,
        LOOKS: lambda w: likeness(w) > 0.4,
        TURNS: lambda w: bank_turns(w.table) > 0.8,
        FORETOLD: foretold,
    }
    return {name for name, holds in checks.items() if not holds(seen)}


def upright_in_the_room(seen: Walk) -> bool:
    """Every camera in the room, its image's down pointing down."""
    T = seen.poses.T_world_camera
    inside = (T[:, :3, 3] > ROOM.room_low) & (T[:, :3, 3] < ROOM.room_high)
    return bool(inside.all() and (T[:, 2, 1] < -0.5).all())


def guess_off() -> float:
    """Median distance [m] of places in the box from its middle: what no image is needed for."""
    low, high = np.reshape(BOX, (2, 3))
    places = np.random.default_rng(0).uniform(low, high, (2000, 3))
    return float(np.median(np.linalg.norm(places - 0.5 * (low + high), axis=1)))


def likeness(seen: Walk) -> float:
    """Correlation of colours between the video in small and the scene from where the marker says it
    was taken.
    """
    import cv2

    drawn, seen_px = [], []
    for row in np.flatnonzero(np.array(seen.table.labels["source"]) == "marker")[::2]:
        R = rotation_world_body(*seen.table.attitude[row])
        frame = render(
            seen.scene,
            SMALL,
            pose_matrix(R @ R_BODY_CAMERA, seen.table.p_world[row] + R @ [0.2, 0.0, 0.0]),
        )
        image = cv2.resize(
            seen.video.image(int(row)), (SMALL.width, SMALL.height), interpolation=cv2.INTER_AREA
        )
        covered = frame.alpha > 0.85  # 24 photos show a part of the hall only
        drawn.append(frame.rgb[covered].ravel())
        seen_px.append(image[covered].ravel())
    return float(np.corrcoef(np.concatenate(drawn), np.concatenate(seen_px))[0, 1])


def bank_turns(table: FlightTable) -> float:
    """Correlation of the turn rate to the right with that of a level turn, (g / V) tan(roll)."""
    seen = table.has_pose
    vx, vy = table.extra["vx"][seen], table.extra["vy"][seen]
    turn = np.gradient(
        -np.unwrap(np.arctan2(vy, vx)), table.t[seen]
    )  # from above, clockwise is right
    level = GRAVITY / np.hypot(vx, vy) * np.tan(table.attitude[seen, 0])
    return float(np.sum(turn * level) / np.sqrt(np.sum(turn**2) * np.sum(level**2)))


def foretold(seen: Walk) -> bool:
    """Half a second ahead, on the pilot's commands alone: attitude and place both nearer than going
    straight on.
    """
    model, straight = forecast(rates_model(), seen.table, 0.5), constant_velocity(seen.table, 0.5)
    return (
        model.position_m < 0.8 * straight.position_m
        and model.attitude_deg < 0.8 * straight.attitude_deg
    )


@pytest.fixture(scope="module")
def straight():
    """The walk without mistakes."""
    return walk()


def test_every_step_fits_the_others(straight):
    """No check fails; the frames without the marker were given to the toy net."""
    assert problems(straight) == set()
    assert (
        {"marker", "network"}
        <= set(straight.table.labels["source"])
        <= {"marker", "bridged", "network", "none"}
    )


@pytest.mark.parametrize(
    ("signs", "failing"),
    [((1, 1, -1), {LOOKS, FORETOLD}), ((-1, 1, 1), {LOOKS, TURNS})],
    ids=["yaw", "roll"],
)
def test_an_angle_with_the_other_sign_is_seen(signs, failing, straight, monkeypatch):
    """The estimator counts yaw to the left, or roll with the left wing down, throughout: the scene,
    seen from there, is another picture than the video; the wrong roll does not go with the turn;
    neither foretells where the aircraft is.
    """
    rightly = hybrid_state.euler_from_rotation

    def wrongly(R):
        return tuple(sign * angle for sign, angle in zip(signs, rightly(R), strict=True))

    def turned(*angles):
        return rotation_world_body(*(s * a for s, a in zip(signs, angles, strict=True)))

    monkeypatch.setattr(hybrid_state, "euler_from_rotation", wrongly)
    monkeypatch.setattr(smoother, "rotation_world_body", turned)
    assert failing <= problems(walk())


def test_a_world_with_x_and_y_turned_round_is_seen(straight):
    """What a fit on poses that were turned by half a turn about the vertical gives: a scene that
    looks as well on its own photos, but not from where the marker says that the video was taken.
    """
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    scene = move(straight.scene, np.ones(len(straight.scene), bool), half_turn)
    poses = replace(straight.poses, T_world_camera=half_turn @ straight.poses.T_world_camera)
    assert LOOKS in problems(replace(straight, scene=scene, poses=poses))


def test_camera_axes_of_another_convention_are_seen(straight):
    """y up and z back, as in nerfstudio's files, taken for OpenCV's: the cameras stand on their
    heads.
    """
    T = straight.poses.T_world_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
    assert problems(replace(straight, poses=replace(straight.poses, T_world_camera=T))) == {UPRIGHT}
