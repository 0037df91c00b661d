"""Scenes in whole numbers of few bits: half a step is all that is lost, and nothing in the file is
trusted.
"""

import zipfile

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene import GaussianScene
from falconwing_kit.scene.native import read_named_points, write_quantised
from tests.scene.packing import zipped
from tests.scene.test_gaussians import fields
from tests.scene.test_native import npy

SCENE = GaussianScene(
    **fields(300, 4),
    labels=np.arange(300) % 3,
    label_names=("rest", "floor", "Landefläche"),
    source="simulated",
)


@pytest.fixture
def back(tmp_path):
    write_quantised(tmp_path / "a.npz", SCENE)
    return GaussianScene.load(tmp_path / "a.npz")


@pytest.mark.parametrize("name, bits", [("means", 16), ("opacities", 8)])
def test_values_come_back_within_half_a_step(back, name, bits):
    """By hand: 2^bits - 1 steps from end to end, so half of one is the largest error; float32 adds
    a millionth.
    """
    values = getattr(SCENE, name)
    span = np.ptp(values, axis=0) if name == "means" else 1.0
    off = np.abs(getattr(back, name) - values)
    assert np.all(off <= 0.5 * span / (2**bits - 1) * 1.01 + 1e-6)
    assert off.max() > 0.2 * np.max(span) / (2**bits - 1)  # it was rounded indeed


def test_scales_and_colours_come_back_within_half_a_step(back):
    """By hand: 255 steps of the logarithm of scales and of the further colours, 65535 of the first
    colour.
    """
    logs = np.log(SCENE.scales)
    assert np.abs(np.log(back.scales) - logs).max() <= 0.5 * np.ptp(logs) / 255 * 1.01
    for part, steps in ((slice(0, 1), 65535), (slice(1, None), 255)):
        off = np.abs(back.sh[:, part] - SCENE.sh[:, part]).max()
        assert off <= 0.5 * np.ptp(SCENE.sh[:, part]) / steps * 1.01 + 1e-6


def test_rotations_come_back_within_a_third_of_a_degree(back):
    """By hand: three components in steps of sqrt(2)/1023, each off by half of one, and the fourth,
    at least as large as any, off by at most their sum: |dq| <= sqrt(3 + 9) * 0.5 sqrt(2)/1023 =
    0.0024, and a turn is twice that: 0.27 deg.
    """
    aligned = np.abs((back.quaternions * SCENE.quaternions).sum(axis=1)).clip(max=1.0)
    assert np.degrees(2.0 * np.arccos(aligned)).max() < 0.27
    assert np.allclose(np.linalg.norm(back.quaternions, axis=1), 1.0, atol=1e-6)


def test_labels_names_and_source_are_kept(back):
    """They are not rounded."""
    assert np.array_equal(back.labels, SCENE.labels)
    assert (back.label_names, back.source) == (SCENE.label_names, SCENE.source)


def test_a_scene_without_further_colours_is_kept(tmp_path):
    """Degree 0 has no further coefficients: the array is left out of the file and comes back with
    none.
    """
    write_quantised(tmp_path / "a.npz", GaussianScene(**fields(5, 1)))
    assert GaussianScene.load(tmp_path / "a.npz").sh.shape == (5, 1, 3)


def test_200_000_gaussians_fit_into_8_megabytes(tmp_path):
    """By hand: 6 + 4 + 3 + 1 + 6 + 9 + 1 = 30 bytes each; random numbers do not compress, real ones
    do.
    """
    write_quantised(tmp_path / "a.npz", GaussianScene(**fields(20_000, 4)))
    assert (tmp_path / "a.npz").stat().st_size < 30 * 20_000 * 1.01 + 4000


def test_named_points_are_kept_beside_the_scene(tmp_path):
    """What was written is read; a scene without any has none, and the scene is as without."""
    points = {"nose": np.array([0.2, 0.0, 0.01]), "tail": np.array([-0.34, 0.0, 0.0])}
    write_quantised(tmp_path / "a.npz", SCENE, points)
    read = read_named_points(tmp_path / "a.npz")
    assert list(read) == ["nose", "tail"] and np.allclose(read["nose"], points["nose"], atol=1e-7)
    assert len(GaussianScene.load(tmp_path / "a.npz")) == 300
    SCENE.save(tmp_path / "b.npz")
    assert read_named_points(tmp_path / "b.npz") == {}


@pytest.mark.parametrize(
    "name, content, words",
    [
        ("quantised.npy", npy(np.array([9], np.uint8)), "version 1, got 9"),
        ("quaternions.npy", npy(np.zeros(7, np.uint32)), "fit each other"),
        ("rest.npy", npy(np.zeros((300, 3, 2), np.uint8)), "fit each other"),
        ("scales_range.npy", npy(np.array([0.0, 1e9], np.float32)), "fit each other"),
        ("means_range.npy", npy(np.full((2, 3), np.nan, np.float32)), "fit each other"),
        ("dc_range.npy", npy(np.zeros(3, np.float32)), "fit each other"),
        ("means.npy", npy(np.zeros((300, 3), np.float32)), "as the kit saves it"),
        ("dc.npy", None, "dc, which is missing"),
    ],
)
def test_each_damage_gets_its_sentence(tmp_path, name, content, words):
    """One member is replaced or taken out; the text says which, in one line."""
    write_quantised(tmp_path / "whole.npz", SCENE)
    with zipfile.ZipFile(tmp_path / "whole.npz") as archive:
        files = {member: archive.read(member) for member in archive.namelist()}
    files.pop(name)
    (tmp_path / "a.npz").write_bytes(
        zipped(files | ({name: content} if content else {}), zipfile.ZIP_STORED)
    )
    with pytest.raises(InputError, match=words) as caught:
        GaussianScene.load(tmp_path / "a.npz")
    assert "\n" not in str(caught.value)
