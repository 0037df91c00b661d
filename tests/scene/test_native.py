"""The kit's own file: every bit comes back, and nothing in it is trusted."""

import io
import pickle
import zipfile

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene import GaussianScene
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
    """No words are words too."""
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
