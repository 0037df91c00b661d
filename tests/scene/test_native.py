"""The kit's files: full precision returns every bit, quantised half a step; neither is trusted."""

import io
import pickle
import zipfile

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene import GaussianScene
from falconwing_kit.scene.native import read_named_points, write_quantised
from tests.scene.packing import zipped
from tests.scene.test_gaussians import fields

SCENE = GaussianScene(
    **fields(40, 9),
    labels=np.arange(40) % 2,
    label_names=("arena", "Landefläche"),
    source="by Åse, CC-BY-4.0\nsimulated",
)


def members(tmp_path):
    """The arrays of a saved scene by their names in the zip."""
    SCENE.save(tmp_path / "whole.npz")
    with zipfile.ZipFile(tmp_path / "whole.npz") as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def load(tmp_path, files, method=zipfile.ZIP_STORED):
    path = tmp_path / "a.npz"
    path.write_bytes(zipped(files, method))
    return GaussianScene.load(path)


def npy(array):
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()


def test_there_and_back_to_the_last_bit(tmp_path):
    """Nothing is calculated on the way, so nothing may change; NumPy itself reads the file too."""
    SCENE.save(tmp_path / "a.npz")
    back = GaussianScene.load(tmp_path / "a.npz")
    for name in ("means", "quaternions", "scales", "opacities", "sh", "labels"):
        assert np.array_equal(getattr(back, name), getattr(SCENE, name)), name
        assert getattr(back, name).flags.writeable, name  # torch takes no others without a warning
    assert back.label_names == SCENE.label_names and back.source == SCENE.source
    with np.load(tmp_path / "a.npz", allow_pickle=False) as arrays:
        assert np.array_equal(arrays["means"], SCENE.means)


def test_scene_without_a_source_comes_back(tmp_path):
    """An empty source is a source too."""
    GaussianScene(**fields(1, 1)).save(tmp_path / "a.npz")
    assert GaussianScene.load(tmp_path / "a.npz").source == ""


def test_squeezed_files_are_read(tmp_path):
    """NumPy's savez_compressed deflates the same arrays."""
    assert np.array_equal(load(tmp_path, members(tmp_path), zipfile.ZIP_DEFLATED).sh, SCENE.sh)


def test_same_scene_gives_the_same_bytes(tmp_path):
    """No time of day or name of a machine goes into the file."""
    SCENE.save(tmp_path / "a.npz")
    SCENE.save(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


class Bomb:
    """What unpickling would run."""

    def __reduce__(self):
        return (pytest.fail, ("a pickle was opened",))


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("means.npy", None, "the array means, which is missing"),
        ("means.npy", b"not an array", "expected means as the kit saves it"),
        ("means.npy", npy(np.zeros((40, 3), "<i4")), "expected means as the kit saves it"),
        ("means.npy", npy(np.zeros((40, 3, 1), "<f4")), "expected means .* with 2 axes"),
        ("means.npy", npy(np.zeros((40, 3), "<f4"))[:-4], "expected means"),
        ("means.npy", npy(np.zeros((40, 3), "<f4")) + b"more", "expected means"),
        (
            "means.npy",
            npy(np.zeros((40, 3), "<f4")).replace(b"(40, 3)", b"(99, 3)"),
            "expected means",
        ),
        (
            "means.npy",
            npy(np.zeros((40, 3), "<f4")).replace(b"(40, 3)", b"(-4, 3)"),
            "expected means",
        ),
        ("means.npy", npy(np.asfortranarray(np.zeros((40, 3), "<f4"))), "expected means"),
        ("means.npy", npy(np.zeros((39, 3), "<f4")), "quaternions: expected shape"),
        ("labels.npy", npy(np.full(40, 7, np.uint8)), "labels: expected 0 to 1"),
        ("label_names.npy", npy(np.array([Bomb()], object)), "expected label_names as"),
        ("source.npy", pickle.dumps(Bomb()), "expected source as"),
        (
            "source.npy",
            npy(np.array("abc")).replace(b"c\0\0\0", b"\xff\xff\xff\xff"),
            "expected words in label_names and source",
        ),
    ],
)
def test_each_damage_gets_its_sentence(tmp_path, name, content, sentence):
    """Nothing is unpickled, and a header that promises more than its bytes is refused."""
    files = members(tmp_path)
    if content is None:
        del files[name]
    else:
        assert content != files[name]
        files[name] = content
    with pytest.raises(InputError, match=rf"/a\.npz: .*({sentence})"):
        load(tmp_path, files)


def test_bombs_and_torn_zips_are_refused(tmp_path):
    """Zeros deflate to a thousandth: 16 MB in 16 kB are over the limit of 200 times. A cut zip has
    no directory.
    """
    with pytest.raises(InputError, match="members of the sizes in its directory"):
        load(tmp_path, members(tmp_path) | {"means.npy": bytes(16_000_000)}, zipfile.ZIP_DEFLATED)
    with pytest.raises(
        InputError, match="expected stored or deflated members"
    ):  # Python unpacks LZMA without a limit
        load(tmp_path, members(tmp_path), zipfile.ZIP_LZMA)
    whole = zipped(members(tmp_path))
    for damaged in (whole[:-30], b"PK\x03\x04" + whole[40:], whole[:200] + bytes(8) + whole[208:]):
        (tmp_path / "a.npz").write_bytes(damaged)
        with pytest.raises(InputError, match=r"/a\.npz: expected"):
            GaussianScene.load(tmp_path / "a.npz")


SMALL_SCENE = GaussianScene(
    **fields(300, 4),
    labels=np.arange(300) % 3,
    label_names=("rest", "floor", "Landefläche"),
    source="simulated",
)


@pytest.fixture
def restored(tmp_path):
    write_quantised(tmp_path / "a.npz", SMALL_SCENE)
    return GaussianScene.load(tmp_path / "a.npz")


@pytest.mark.parametrize("name, bits", [("means", 16), ("opacities", 8)])
def test_values_come_back_within_half_a_step(restored, name, bits):
    """By hand: 2^bits - 1 steps from end to end, so half of one is the largest error; float32 adds
    a millionth.
    """
    values = getattr(SMALL_SCENE, name)
    span = np.ptp(values, axis=0) if name == "means" else 1.0
    off = np.abs(getattr(restored, name) - values)
    assert np.all(off <= 0.5 * span / (2**bits - 1) * 1.01 + 1e-6)
    assert off.max() > 0.2 * np.max(span) / (2**bits - 1)  # it was rounded indeed


def test_scales_and_colours_come_back_within_half_a_step(restored):
    """By hand: 255 steps of the logarithm of scales and of the further colours, 65535 of the first
    colour.
    """
    logs = np.log(SMALL_SCENE.scales)
    assert np.abs(np.log(restored.scales) - logs).max() <= 0.5 * np.ptp(logs) / 255 * 1.01
    for part, steps in ((slice(0, 1), 65535), (slice(1, None), 255)):
        off = np.abs(restored.sh[:, part] - SMALL_SCENE.sh[:, part]).max()
        assert off <= 0.5 * np.ptp(SMALL_SCENE.sh[:, part]) / steps * 1.01 + 1e-6


def test_rotations_come_back_within_a_third_of_a_degree(restored):
    """By hand: three components in steps of sqrt(2)/1023, each off by half of one, and the fourth,
    at least as large as any, off by at most their sum: |dq| <= sqrt(3 + 9) * 0.5 sqrt(2)/1023 =
    0.0024, and a turn is twice that: 0.27 deg.
    """
    aligned = np.abs((restored.quaternions * SMALL_SCENE.quaternions).sum(axis=1)).clip(max=1.0)
    assert np.degrees(2.0 * np.arccos(aligned)).max() < 0.27
    assert np.allclose(np.linalg.norm(restored.quaternions, axis=1), 1.0, atol=1e-6)


def test_labels_names_and_source_are_kept(restored):
    """They are not rounded."""
    assert np.array_equal(restored.labels, SMALL_SCENE.labels)
    assert (restored.label_names, restored.source) == (SMALL_SCENE.label_names, SMALL_SCENE.source)


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
    write_quantised(tmp_path / "a.npz", SMALL_SCENE, points)
    read = read_named_points(tmp_path / "a.npz")
    assert list(read) == ["nose", "tail"] and np.allclose(read["nose"], points["nose"], atol=1e-7)
    assert len(GaussianScene.load(tmp_path / "a.npz")) == 300
    SMALL_SCENE.save(tmp_path / "b.npz")
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
def test_each_damage_of_a_quantised_file_gets_its_sentence(tmp_path, name, content, words):
    """One member is replaced or taken out; the text says which, in one line."""
    write_quantised(tmp_path / "whole.npz", SMALL_SCENE)
    with zipfile.ZipFile(tmp_path / "whole.npz") as archive:
        files = {member: archive.read(member) for member in archive.namelist()}
    files.pop(name)
    (tmp_path / "a.npz").write_bytes(
        zipped(files | ({name: content} if content else {}), zipfile.ZIP_STORED)
    )
    with pytest.raises(InputError, match=words) as caught:
        GaussianScene.load(tmp_path / "a.npz")
    assert "\n" not in str(caught.value)
