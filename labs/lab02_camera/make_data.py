"""Make lab 2's data again: python labs/lab02_camera/make_data.py

Two views from the kit's simulated hall, as an aircraft on its approach would see it through a lens
that bends straight lines, and the autopilot's log beside each. Needs the kit for its
frames; the lab's exercises stay in the lab.
"""

import json
from pathlib import Path

import numpy as np

from falconwing_kit.core import R_BODY_CAMERA, Array, atomic_write, pose_matrix, rotation_world_body
from falconwing_kit.scene import PinholeCamera, leader_at, load_scene, render

DATA = Path(__file__).parent / "data"
LENS = {"fx": 198.4, "fy": 198.4, "cx": 160.0, "cy": 120.0, "k1": -0.08}
WIDTH, HEIGHT, FINER = 320, 240, 3  # the views are averaged from a picture that many times finer
TILT_DEG, P_BODY_CAMERA = 8.0, (0.2, 0.0, 0.0)
# where the aircraft is in the kit's world [m], roll, pitch, and yaw from the runway [deg]
VIEWS = (
    ((-6.0, -3.2, 1.7), 14.0, 3.0, -7.0),
    ((-5.0, 2.2, 2.4), -18.0, -2.0, 24.0),
)


def bent(image: Array, camera: PinholeCamera) -> Array:
    """The distorted image (H, W, 3) of an undistorted one, at the size of the views."""
    rows, columns = np.mgrid[: FINER * HEIGHT, : FINER * WIDTH]
    x_bent = ((columns + 0.5) / FINER - LENS["cx"]) / LENS["fx"]
    y_bent = ((rows + 0.5) / FINER - LENS["cy"]) / LENS["fy"]
    factor = np.ones_like(x_bent)
    for _ in range(50):  # a fixed point: the slope is known through itself
        factor = 1.0 + LENS["k1"] * (x_bent**2 + y_bent**2) / factor**2
    u = np.floor(camera.fx * x_bent / factor + camera.cx).astype(int)
    v = np.floor(camera.fy * y_bent / factor + camera.cy).astype(int)
    fine = image[v, u].reshape(HEIGHT, FINER, WIDTH, FINER, 3)
    return np.asarray(fine.mean(axis=(1, 3)))


def main() -> None:
    """Write the views and their log."""
    from PIL import Image

    scene = leader_at(load_scene("arena"), None)
    focal, margin = FINER * LENS["fx"], 1.35  # wide enough for what the lens pulls into the corners
    width, height = int(FINER * WIDTH * margin), int(FINER * HEIGHT * margin)
    camera = PinholeCamera(focal, focal, width / 2.0, height / 2.0, width, height)
    tilt = np.radians(TILT_DEG)
    R_body_level = np.array(
        [[np.cos(tilt), 0.0, -np.sin(tilt)], [0.0, 1.0, 0.0], [np.sin(tilt), 0.0, np.cos(tilt)]]
    )
    T_body_camera = pose_matrix(R_body_level @ R_BODY_CAMERA, P_BODY_CAMERA)
    log = []
    for number, (p_world, *attitude_deg) in enumerate(VIEWS):
        T_world_body = pose_matrix(rotation_world_body(*np.radians(attitude_deg)), p_world)
        view = render(scene, camera, T_world_body @ T_body_camera, backend="fast")
        image = bent(view.rgb.astype(float), camera)
        with atomic_write(DATA / f"view{number}.jpg") as file:
            Image.fromarray((255.0 * np.clip(image, 0.0, 1.0)).round().astype(np.uint8)).save(
                file, "JPEG", quality=88
            )
        names = ("roll_deg", "pitch_deg", "off_runway_deg")
        p_map = [-p_world[1], p_world[0], p_world[2]]  # the kit's y points left, the map's x right
        log.append({"p_map": p_map, **dict(zip(names, attitude_deg, strict=True))})
    record = {"lens": LENS, "tilt_deg": TILT_DEG, "p_body_camera": P_BODY_CAMERA, "views": log}
    with atomic_write(DATA / "views.json", text=True) as file:
        file.write(json.dumps(record, indent=2) + "\n")


if __name__ == "__main__":
    main()
