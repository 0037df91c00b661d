"""Scenes: what they refuse, selecting, joining, and the reader of each ending."""

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene import GaussianScene


def fields(count=3, basis=4, seed=0):
    """Random numbers of a scene, as keyword arguments."""
    rng = np.random.default_rng(seed)
    return {
        "means": rng.normal(size=(count, 3)),
        "quaternions": rng.normal(size=(count, 4)),
        "scales": rng.uniform(0.01, 1.0, (count, 3)),
        "opacities": rng.uniform(0.0, 1.0, count),
        "sh": rng.normal(size=(count, basis, 3)),
    }


def changed(name, index, value):
    """Fields with one number replaced."""
    numbers = fields()
    numbers[name][index] = value
    return numbers


def test_numbers_are_float32_and_rotations_have_length_one():
    """The length is 1 by definition; (0, 0, 0, 2) turns as (0, 0, 0, 1) does, so tolerance is
    float32 rounding.
    """
    scene = GaussianScene(**changed("quaternions", 1, (0, 0, 0, 2)))
    for name in ("means", "quaternions", "scales", "opacities", "sh"):
        assert getattr(scene, name).dtype == np.float32
    assert np.allclose(np.linalg.norm(scene.quaternions, axis=1), 1.0, atol=2e-7)
    assert scene.quaternions[1].tolist() == [0, 0, 0, 1]
    assert len(scene) == 3 and scene.labels.tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("numbers", "sentence"),
    [
        (fields(count=0), "scene: expected at least one Gaussian, got none"),
        (changed("means", (1, 2), np.nan), "means: expected finite numbers, got others in 1 of 3"),
        (changed("sh", (0, 0, 0), np.inf), "sh: expected finite"),
        (changed("means", (0, 0), 1e300), "means: expected finite"),  # too large for float32
        (changed("quaternions", 0, 0.0), "quaternions: expected rotations other than"),
        (changed("scales", (2, 0), -0.1), "scales: expected numbers > 0"),
        (changed("scales", (2, 0), 0.0), "scales: expected numbers > 0"),
        (changed("opacities", 0, 1.5), "opacities: expected numbers in 0..1"),
        (fields(basis=5), "sh: expected 1, 4, 9 or 16 coefficients"),
        (fields(basis=25), "sh: expected 1, 4, 9 or 16 coefficients"),
        (fields() | {"means": np.zeros((3, 2))}, "means: expected shape"),
        (fields() | {"quaternions": np.ones((4, 4))}, "quaternions: expected shape"),
        (fields() | {"opacities": np.ones((3, 1))}, "opacities: expected shape"),
        (fields() | {"sh": np.ones((3, 3))}, "sh: expected shape"),
        (fields() | {"scales": "small"}, "scales: expected an array of numbers"),
        (fields() | {"means": [[1, 2], [3]]}, "means: expected an array of numbers"),
        (fields() | {"labels": np.array([0, 1, 0])}, "labels: expected 0 to 0"),
        (fields() | {"labels": np.array([0, -1, 0])}, "labels: expected 0 to 0"),
        (fields() | {"labels": np.zeros(2, int)}, "labels: expected"),
        (fields() | {"labels": np.zeros(3)}, "labels: expected"),
        (fields() | {"label_names": ()}, "label_names: expected 1 to 256"),
        (fields() | {"label_names": ("pad", "pad")}, "label_names: expected every name once"),
        (fields() | {"label_names": ("pad", "")}, "label_names: expected"),
    ],
)
def test_each_mistake_gets_one_sentence(numbers, sentence):
    """Name, expected and got, on one line."""
    with pytest.raises(InputError, match=f"^{sentence}") as refusal:
        GaussianScene(**numbers)
    assert "\n" not in str(refusal.value)


def test_selecting_keeps_rows_and_their_order():
    """By hand: the first and third row stay, with their labels."""
    scene = GaussianScene(
        **fields(), labels=np.array([0, 1, 1]), label_names=("arena", "pad"), source="by hand"
    )
    part = scene.selected(np.array([True, False, True]))
    for name in ("means", "quaternions", "scales", "opacities", "sh", "labels"):
        assert np.array_equal(getattr(part, name), getattr(scene, name)[[0, 2]])
    assert part.label_names == ("arena", "pad") and part.source == "by hand"
    assert scene.labelled("pad").tolist() == [False, True, True]
    assert scene.labelled("pad", "arena").all()


@pytest.mark.parametrize("mask", [[True, False], [0, 1, 2], [False] * 3])
def test_masks_that_mean_nothing_are_refused(mask):
    """Too short, numbers of rows instead of truth, and nothing left."""
    with pytest.raises(InputError, match=r"^mask: expected"):
        GaussianScene(**fields()).selected(np.array(mask))


def test_unknown_label_is_named_with_the_known_ones():
    """The sentence lists what there is."""
    with pytest.raises(InputError, match="expected one of scene, got 'leader'"):
        GaussianScene(**fields()).labelled("leader")


def test_joining_merges_labels_by_name_and_pads_colours():
    """By hand: "pad" is 1 in the first scene and 0 in the second, and stays one label; degree 0
    gets zeros.
    """
    first = GaussianScene(
        **fields(2, 4), labels=np.array([0, 1]), label_names=("arena", "pad"), source="a"
    )
    second = GaussianScene(
        **fields(2, 1, seed=1), labels=np.array([0, 1]), label_names=("pad", "leader"), source="b"
    )
    both = GaussianScene.joined(first, second, second)
    assert both.label_names == ("arena", "pad", "leader")
    assert both.labels.tolist() == [0, 1, 1, 2, 1, 2]
    assert both.source == "a; b"
    assert both.sh.shape == (6, 4, 3) and not both.sh[2:, 1:].any()
    assert np.array_equal(both.sh[2:4, :1], second.sh)
    assert np.array_equal(both.means, np.concatenate([first.means, second.means, second.means]))
    assert np.array_equal(both.quaternions[:2], first.quaternions)


def test_joining_nothing_or_too_many_labels_is_refused():
    """A label is one byte, so 257 names do not fit."""
    with pytest.raises(InputError, match="at least one scene"):
        GaussianScene.joined()
    names = tuple(f"thing {k}" for k in range(256))
    with pytest.raises(InputError, match="label_names: expected 1 to 256"):
        GaussianScene.joined(
            GaussianScene(**fields(), label_names=names), GaussianScene(**fields())
        )


def test_other_endings_and_missing_files_are_said(tmp_path):
    """Reading and saving name the endings; what is not there is not found."""
    (tmp_path / "a.obj").write_bytes(b"")
    with pytest.raises(
        InputError,
        match=r"expected a scene ending in \.ply, \.npz, \.sog, \.splat, \.spz or a SOG folder",
    ):
        GaussianScene.load(tmp_path / "a.obj")
    with pytest.raises(InputError, match=r"ending in \.npz or \.ply"):
        GaussianScene(**fields()).save(tmp_path / "a.spz")
    for ending in (".ply", ".splat", ".spz", ".sog", ".npz"):
        with pytest.raises(FileNotFoundError):
            GaussianScene.load(tmp_path / f"none{ending}")
    with pytest.raises(FileNotFoundError, match=r"meta\.json"):
        GaussianScene.load(tmp_path)


def test_empty_files_are_refused_by_name(tmp_path):
    """Nothing in a file is no scene, in any format."""
    for ending in (".ply", ".splat", ".spz", ".sog", ".npz", ".PLY"):
        (tmp_path / f"a{ending}").write_bytes(b"")
        with pytest.raises(InputError, match=f"a{ending}: .*expected"):
            GaussianScene.load(tmp_path / f"a{ending}")
