"""Make data/views.npz: SIMULATED views of the arena with the leader, without it, and half hidden.

python labs/lab09_masks/make_data.py
"""

from pathlib import Path

import numpy as np

from falconwing_kit.core import camera_pose, pose_matrix, rotation_world_body
from falconwing_kit.flight import fpv_camera
from falconwing_kit.scene import MASK_THRESHOLD, leader_at, load_scene, render, visible_alpha_image

SIZE = (64, 48)  # px
LEVELS = 16  # steps between the grey levels that are kept, so that the file stays small
RUNWAY, WINDOWS = (
    (-0.4, 2.2),
    (-2.2, -0.9),
)  # where the follower looks: yaw from and to [rad], nose right positive
KINDS = {  # how many, yaw from and to, with a leader
    "train": (240, RUNWAY, True),
    "seen": (40, RUNWAY, True),
    "unseen": (40, WINDOWS, True),
    "empty": (40, WINDOWS, False),
}


def views(
    count: int, yaws: tuple[float, float], with_leader: bool, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Pictures, poses of the leader in camera axes, and exact masks."""
    hall, leader, camera = (
        leader_at(load_scene("arena"), None),
        load_scene("leader"),
        fpv_camera(*SIZE),
    )
    images, poses, masks = [], [], []
    while len(images) < count:
        yaw = rng.uniform(*yaws)
        p_world = rng.uniform([-14.0, -6.0, 1.0], [6.0, 2.0, 2.5])
        T_world_camera = camera_pose(
            pose_matrix(
                rotation_world_body(rng.uniform(-0.4, 0.4), rng.uniform(-0.1, 0.1), yaw), p_world
            ),
            np.zeros(3),
        )
        ahead = rng.uniform(2.0, 5.0)
        p_camera = ahead * np.array([rng.uniform(-0.55, 0.55), rng.uniform(-0.35, 0.35), 1.0])
        p_leader = T_world_camera[:3, :3] @ p_camera + T_world_camera[:3, 3]
        turned = rotation_world_body(
            rng.uniform(-0.7, 0.7), rng.uniform(-0.2, 0.2), yaw + rng.uniform(-0.6, 0.6)
        )
        T_world_leader = pose_matrix(turned, p_leader)
        if not 0.4 < p_leader[2] < 3.5 or not -11.0 < p_leader[1] < 7.0:
            continue
        placed = leader_at(leader, T_world_leader)
        frame = render([hall, placed] if with_leader else hall, camera, T_world_camera)
        picture = np.asarray(255.0 * frame.rgb + 0.5, np.uint8) // LEVELS * LEVELS + LEVELS // 2
        seen = visible_alpha_image(hall, placed, camera, T_world_camera) >= MASK_THRESHOLD
        if with_leader and not seen.any():
            continue  # behind something
        images.append(picture)
        poses.append(np.linalg.inv(T_world_camera) @ T_world_leader)
        masks.append(seen if with_leader else np.zeros_like(seen))
    return {
        "images": np.array(images),
        "poses": np.array(poses, np.float32),
        "masks": np.array(masks),
    }


def hidden_view() -> dict[str, np.ndarray]:
    """A view in which the marker's board hides a part of the leader, with the hall's depth [m]."""
    hall, leader, camera = (
        leader_at(load_scene("arena"), None),
        load_scene("leader"),
        fpv_camera(*SIZE),
    )
    T_world_camera = camera_pose(
        pose_matrix(np.diag([1.0, -1.0, -1.0]), np.array([-2.2, 0.0, 0.6])), np.zeros(3)
    )
    T_world_leader = pose_matrix(rotation_world_body(0.5, 0.1, 0.3), np.array([0.9, 0.62, 0.8]))
    placed = leader_at(leader, T_world_leader)
    frame = render([hall, placed], camera, T_world_camera)
    return {
        "images": np.asarray(255.0 * frame.rgb + 0.5, np.uint8)[None],
        "poses": (np.linalg.inv(T_world_camera) @ T_world_leader)[None].astype(np.float32),
        "masks": (visible_alpha_image(hall, placed, camera, T_world_camera) >= MASK_THRESHOLD)[
            None
        ],
        "depth": render(hall, camera, T_world_camera).depth[None].astype(np.float16),
    }


def main() -> None:
    """Render and write."""
    rng, arrays = np.random.default_rng(0), {}
    for kind, (count, yaws, with_leader) in KINDS.items():
        arrays |= {
            f"{kind}_{name}": values
            for name, values in views(count, yaws, with_leader, rng).items()
        }
        print(kind, f"{arrays[f'{kind}_masks'].sum(axis=(1, 2)).mean():.0f} px of leader a view")
    arrays |= {f"hidden_{name}": values for name, values in hidden_view().items()}
    file = Path(__file__).parent / "data" / "views.npz"
    file.parent.mkdir(exist_ok=True)
    np.savez_compressed(file, **arrays)


if __name__ == "__main__":
    main()
