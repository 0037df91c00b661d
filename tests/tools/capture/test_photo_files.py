"""Photos with poses: transforms.json, point clouds, COLMAP; against hand, OpenCV, pycolmap."""

import json
import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene import PinholeCamera
from falconwing_kit.tools.capture.colmap import read_colmap
from falconwing_kit.tools.capture.photo_files import (
    Reconstruction,
    read_photo,
    read_reconstruction,
    undistort,
    write_reconstruction,
)
from falconwing_kit.tools.capture.points import read_points

CAMERA = PinholeCamera(200.0, 210.0, 80.0, 60.0, 160, 120)
# A level camera at (1, 2, 3) that looks along world x: its right is world -y, its down is world -z.
LEVEL = np.array(
    [[0.0, 0.0, 1.0, 1.0], [-1.0, 0.0, 0.0, 2.0], [0.0, -1.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]]
)


def two_photos(folder, **changes):
    """Two photos from two places, with two points."""
    other = LEVEL.copy()
    other[:3, 3] = (-1.0, 0.5, 2.0)
    points, colours = (
        np.array([[5.0, 2.0, 3.0], [6.0, 1.0, 2.0]]),
        np.array([[255, 0, 7], [1, 2, 3]], np.uint8),
    )
    made = Reconstruction(
        CAMERA, ("a.png", "b.png"), folder, np.stack([LEVEL, other]), points, colours
    )
    return replace(made, **changes)


def test_writing_and_reading_gives_the_same(tmp_path):
    """Inverse of each other; points are kept as float32, so to 1e-6 of their size."""
    made = two_photos(
        tmp_path / "photos", k1=-0.05, aligned=True, report={"registered": 2, "total": 3}
    )
    write_reconstruction(tmp_path / "out", made)
    found = read_reconstruction(tmp_path / "out")
    assert (found.names, found.folder, found.camera, found.k1) == (
        made.names,
        made.folder,
        made.camera,
        made.k1,
    )
    assert found.aligned and found.report == made.report
    assert np.allclose(found.T_world_camera, made.T_world_camera, atol=1e-12)
    assert (
        np.allclose(found.points, made.points, rtol=1e-6) and (found.colours == made.colours).all()
    )


def test_file_has_opengl_axes(tmp_path):
    """By hand: OpenGL's camera has x right, y up, z back.

    For a level camera along world x these are -y, z and -x.
    """
    path = write_reconstruction(tmp_path / "out", two_photos(tmp_path / "photos"))
    matrix = json.loads(path.read_text())["frames"][0]["transform_matrix"]
    assert np.allclose(
        matrix, [[0, 0, -1, 1], [-1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]], atol=1e-12
    )


def test_photos_move_along_with_the_folder_that_names_them(tmp_path):
    """Photos beside the folder are named relative to it; photos elsewhere in full."""
    path = write_reconstruction(
        tmp_path / "hall" / "poses", two_photos(tmp_path / "hall" / "photos")
    )
    assert json.loads(path.read_text())["frames"][0]["file_path"] == "../photos/a.png"
    (tmp_path / "hall").rename(tmp_path / "gym")
    assert read_reconstruction(tmp_path / "gym" / "poses").folder == tmp_path / "gym" / "photos"
    path = write_reconstruction(tmp_path / "gym" / "poses", two_photos(tmp_path / "elsewhere"))
    assert (
        json.loads(path.read_text())["frames"][0]["file_path"]
        == (tmp_path / "elsewhere" / "a.png").as_posix()
    )


def test_projection_bends_as_opencv_bends_it(tmp_path):
    """OpenCV's projectPoints with its k1; the principal point hides where its pixels begin."""
    made = two_photos(tmp_path, k1=-0.2)
    p_world = np.array([[5.0, 3.0, 3.5], [4.0, 1.2, 2.0], [9.0, 2.0, 3.0]])
    T = np.linalg.inv(LEVEL)
    expected, _ = cv2.projectPoints(
        p_world, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], CAMERA.K, np.array([-0.2, 0, 0, 0, 0])
    )
    assert np.allclose(made.project(p_world, 0), expected[:, 0], atol=1e-9)
    rays = made.pixel_directions(made.project(p_world, 0))
    p_camera = (p_world - LEVEL[:3, 3]) @ LEVEL[:3, :3]
    assert np.allclose(rays, p_camera / p_camera[:, 2:], atol=1e-6)  # twenty turns of the iteration


def test_straightened_photo_shows_each_ray_where_a_pinhole_does(tmp_path):
    """A photo whose red is its column: undistorted, red is the column of the distorted photo."""
    columns = np.broadcast_to(np.arange(160, dtype=np.uint8), (120, 160))
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), np.stack([columns] * 3, axis=-1))
    straight = undistort(two_photos(tmp_path, k1=-0.2), tmp_path / "straight")
    red = read_photo(straight.path(0))[..., 0].astype(float)
    x, y = (140.5 - 80.0) / 200.0, (100.5 - 60.0) / 210.0
    expected = 200.0 * x * (1.0 - 0.2 * (x * x + y * y)) + 80.0 - 0.5
    assert straight.k1 == 0.0 and red[100, 140] == pytest.approx(
        expected, abs=0.51
    )  # bytes are whole numbers
    assert abs(expected - 140.0) > 0.9


COLMAP_TEXT = {
    "cameras.txt": "# comment\n7 SIMPLE_RADIAL 160 120 200 80 60 -0.1\n",
    # Quarter turn about y as "camera from world", w = y = cos 45 deg; its place is -R^T t, by hand
    # (3, -2, -1).
    "images.txt": "# comment\n"
    "4 0.70710678118654757 0 0.70710678118654757 0 1 2 3 7 b.png\n1.0 2.0 -1\n"
    "2 1 0 0 0 -1 -2 -3 7 a.png\n\n",
    "points3D.txt": "9 0.5 1.5 2.5 10 20 30 0.25 4 0 2 1\n",
}


def write_colmap_text(folder, **changes):
    """A model of two photos and a point."""
    folder.mkdir(exist_ok=True)
    for name, text in (COLMAP_TEXT | changes).items():
        (folder / name).write_text(text)


def write_colmap_binary(folder):
    """The same model as COLMAP's format page lays out its binary files."""
    folder.mkdir()
    half = 0.70710678118654757
    images = struct.pack("<Q", 2)
    images += (
        struct.pack("<i7di", 4, half, 0, half, 0, 1, 2, 3, 7)
        + b"b.png\0"
        + struct.pack("<Qddq", 1, 1.0, 2.0, -1)
    )
    images += struct.pack("<i7di", 2, 1, 0, 0, 0, -1, -2, -3, 7) + b"a.png\0" + struct.pack("<Q", 0)
    points = struct.pack("<QQ3d3BdQiiii", 1, 9, 0.5, 1.5, 2.5, 10, 20, 30, 0.25, 2, 4, 0, 2, 1)
    (folder / "cameras.bin").write_bytes(
        struct.pack("<QiiQQ4d", 1, 7, 2, 160, 120, 200, 80, 60, -0.1)
    )
    (folder / "images.bin").write_bytes(images)
    (folder / "points3D.bin").write_bytes(points)


@pytest.mark.parametrize("kind", ["text", "binary"])
def test_colmap_model_is_read(tmp_path, kind):
    """By hand: photo a looks along world z from (1, 2, 3); photo b along world -x."""
    (write_colmap_text if kind == "text" else write_colmap_binary)(tmp_path / "model")
    found = read_reconstruction(tmp_path / "model")
    assert found.names == ("a.png", "b.png") and found.k1 == -0.1
    assert found.camera == PinholeCamera(200.0, 200.0, 80.0, 60.0, 160, 120)
    a, b = found.T_world_camera
    assert np.allclose(a, [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-12)
    assert np.allclose(b, [[0, 0, -1, 3], [0, 1, 0, -2], [1, 0, 0, -1], [0, 0, 0, 1]], atol=1e-12)
    assert np.allclose(found.points, [[0.5, 1.5, 2.5]]) and found.colours.tolist() == [[10, 20, 30]]
    assert found.report["reprojection_px"] == 0.25 and not found.aligned


@pytest.mark.parametrize("write", ["write_text", "write_binary"])
def test_pycolmap_means_the_same_by_its_files(tmp_path, write):
    """COLMAP's own library makes up a model and says where its cameras are and what they see."""
    import pycolmap

    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_cameras_per_rig=1, num_rigs=1, num_frames_per_rig=4, num_points3D=20
    )
    model = pycolmap.synthesize_dataset(options)
    getattr(model, write)(str(tmp_path))
    found = read_reconstruction(tmp_path)
    assert len(found) == 4 and len(found.points) == 20
    for number, name in enumerate(found.names):
        image = model.find_image_with_name(name)
        assert np.allclose(
            found.T_world_camera[number, :3, 3], image.projection_center(), atol=1e-9
        )
        pixel = image.project_point(found.points[3])
        assert np.allclose(found.project(found.points[3:4], number)[0], pixel, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"cameras.txt": "7 OPENCV_FISHEYE 160 120 1 1 1 1 0 0 0 0\n"},
            "undistort the photos first",
        ),
        (
            {"cameras.txt": "7 OPENCV 160 120 200 200 80 60 0 0.5 0 0\n"},
            "further terms move the corner",
        ),
        ({"cameras.txt": "7 PINHOLE 160 120 200\n"}, "damaged"),
        ({"images.txt": "2 1 0 0 0 -1 -2 -3 8 a.png\n\n"}, "known cameras"),
        ({"images.txt": "2 0 0 0 0 -1 -2 -3 7 a.png\n\n"}, "finite poses"),
        ({"images.txt": "2 1e200 0 0 0 -1 -2 -3 7 a.png\n\n"}, "finite poses"),
        ({"images.txt": "2 1 0 0 0 -1 -2 7 a.png\n\n"}, "damaged"),
        ({"images.txt": ""}, "expected a model with images"),
        ({"points3D.txt": "9 0.5 nan\n"}, "damaged"),
    ],
)
def test_colmap_models_that_cannot_be_used_are_refused_in_words(tmp_path, changes, words):
    """One sentence each."""
    write_colmap_text(tmp_path / "model", **changes)
    with pytest.raises(InputError, match=words):
        read_reconstruction(tmp_path / "model")


def test_cut_binary_model_is_refused(tmp_path):
    """At every length: a cut file never hangs, never passes for a whole one."""
    write_colmap_binary(tmp_path / "model")
    whole = (tmp_path / "model" / "images.bin").read_bytes()
    for length in range(0, len(whole), 7):
        (tmp_path / "model" / "images.bin").write_bytes(whole[:length])
        with pytest.raises(InputError, match="damaged"):
            read_colmap(tmp_path / "model")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda r: r.pop("frames"), "without 'frames'"),
        (lambda r: r.update(frames=[]), "expected nerfstudio"),
        (lambda r: r["frames"][0].update(fl_x=300.0), "one camera for all photos"),
        (lambda r: r.update(k2=0.5), "undistort"),
        (lambda r: r.update(camera_model="OPENCV_FISHEYE"), "expected a pinhole camera"),
        (
            lambda r: r["frames"][0].update(transform_matrix=np.ones((4, 4)).tolist()),
            "rotations with places",
        ),
        (lambda r: r["frames"][1].update(file_path=r["frames"][0]["file_path"]), "a name twice"),
    ],
)
def test_transforms_that_cannot_be_used_are_refused_in_words(tmp_path, change, words):
    """One sentence each."""
    path = write_reconstruction(tmp_path, two_photos(tmp_path))
    record = json.loads(path.read_text())
    change(record)
    path.write_text(json.dumps(record))
    with pytest.raises(InputError, match=words):
        read_reconstruction(tmp_path)


def test_text_point_cloud_is_read(tmp_path):
    """By hand; MeshLab and Open3D write such files too."""
    path = tmp_path / "points.ply"
    head = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(
        f"property double {axis}\n" for axis in "xyz"
    )
    path.write_text(head + "end_header\n1 2 3\n4 5 6\n")
    points, colours = read_points(path)
    assert points.tolist() == [[1, 2, 3], [4, 5, 6]] and (colours == 128).all()
    path.write_text(head + "end_header\n1 2 3\n4 5\n")
    with pytest.raises(InputError, match="2 lines of 3 numbers"):
        read_points(path)


def test_missing_things_are_named(tmp_path):
    """A folder without poses, and no folder."""
    with pytest.raises(InputError, match="found neither"):
        read_reconstruction(tmp_path)
    with pytest.raises(FileNotFoundError):
        read_reconstruction(tmp_path / "nowhere.json")
    (tmp_path / "broken.jpg").write_bytes(b"no image")
    with pytest.raises(InputError, match="expected a photo"):
        read_photo(tmp_path / "broken.jpg")
