"""Packed scenes written: bytes by hand from each format's specification, and round trips through
the kit's readers within the step of each format.
"""

import gzip
import io
import json
import math
import struct
import zipfile

import cv2
import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene import GaussianScene
from falconwing_kit.tools.capture.packed_write import spz_payload, write_packed
from tests.scene.packing import fixed24
from tests.scene.packing import spz_payload as spz_by_hand

HALF, ROOT_PI = math.sqrt(0.5), math.sqrt(math.pi)
ENDINGS = (".splat", ".spz", ".sog")


@pytest.fixture
def rng():
    return np.random.default_rng(11)


def one(**changes):
    """A Gaussian whose numbers are known in every format."""
    fields = {
        "means": [[1.5, 2.0, -0.25]],
        "quaternions": [[HALF, 0, 0, -HALF]],
        "scales": np.exp([[0.0, -4.0, 1.0]]),
        "opacities": [0.2],
        "sh": [[[ROOT_PI, -ROOT_PI, -0.6 * ROOT_PI]]],
    }
    return GaussianScene(**(fields | changes))


def random_scene(rng, count=300, degree=1):
    """Gaussians with numbers that every format holds."""
    quaternions = rng.normal(size=(count, 4))
    return GaussianScene(
        rng.uniform(-20.0, 20.0, (count, 3)),
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        np.exp(rng.uniform(-7.0, 0.0, (count, 3))),
        rng.uniform(0.02, 1.0, count),
        rng.uniform(-0.9, 0.9, (count, (degree + 1) ** 2, 3)),
        rng.integers(0, 2, count),
        ("floor", "wall"),
        "made up",
    )


def test_splat_bytes_by_hand(tmp_path):
    """As in test_packed: 32 bytes, colour 255, 0, 51, opacity 51, rotation bytes 128 + 128 q."""
    scene = one(scales=[[0.1, 0.2, 0.3]])
    write_packed(tmp_path / "a.splat", scene)
    expected = struct.pack("<6f", 1.5, 2.0, -0.25, 0.1, 0.2, 0.3)
    expected += bytes([255, 0, 51, 51, 219, 128, 128, 37])  # 128 + 128 / sqrt(2) = 218.5
    assert (tmp_path / "a.splat").read_bytes() == expected


def test_spz_bytes_by_hand(tmp_path):
    """Half a turn about x: y and z change sign. Position 4096 x; opacity 51; colours 255 (0.15 c +
    1/2) of c = 1, -1, 0; scales 16 (ln s + 10); rotation: z is as large as w, and the first of
    x y z w with the largest value is left out, here z of sign -, turned to +: then w is positive.
    """
    scene = one(sh=[[[1.0, -1.0, 0.0], [0.25, 0, 0], [0, 0.25, 0], [0, 0, -0.25]]])
    write_packed(tmp_path / "a.spz", scene)
    expected = spz_by_hand(
        3,
        fixed24(6144, -8192, 1024),
        [51],
        [166, 89, 128],
        [160, 96, 176],
        struct.pack("<I", 2 << 30 | 511),  # x, y zero; w = sqrt(1/2)
        # harmonics y, z, x: the first two change sign
        [96, 128, 128, 128, 96, 128, 128, 128, 96],
        degree=1,
    )
    assert gzip.decompress((tmp_path / "a.spz").read_bytes()) == expected


def test_sog_images_by_hand(tmp_path):
    """Three Gaussians with x of 0, 1 and 3: ln(1 + x) is 0, 1/2 and 1 of ln 4, so 16-bit fractions
    0, 32768 (32767.5 to even) and 65535; two scales and a code book of them; opacity 51.
    """
    scene = GaussianScene(
        [[0, 0, 0], [1, 0, 0], [3, 0, 0]],
        [[1, 0, 0, 0], [0, 1, 0, 0], [HALF, 0, HALF, 0]],
        np.exp([[-2, -2, -2], [-1, -2, -2], [-1, -1, -1]]),
        [0.2, 0.4, 1.0],
        [[[0.5, 0.5, 0.5]], [[0.5, 1.5, 0.5]], [[1.5, 0.5, 0.5]]],
    )
    write_packed(tmp_path / "a.sog", scene)
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files["meta.json"])
    assert (meta["version"], meta["count"]) == (2, 3)
    assert meta["means"]["mins"] == [0, 0, 0]
    assert np.allclose(meta["means"]["maxs"], [math.log(4.0), 0.0, 0.0])
    assert np.allclose(meta["scales"]["codebook"], [-2.0, -1.0])

    def texels(name):
        bgra = cv2.imdecode(np.frombuffer(files[name], np.uint8), cv2.IMREAD_UNCHANGED)
        return bgra.reshape(-1, bgra.shape[2])[:3][:, [2, 1, 0, 3][: bgra.shape[2]]].tolist()

    low, high = (np.array(texels(f"means_{end}.webp"))[:, 0] for end in "lu")
    assert (low + 256 * high).tolist() == [0, 32768, 65535]
    assert [row[:3] for row in texels("scales.webp")] == [[0, 0, 0], [1, 0, 0], [1, 1, 1]]
    assert texels("sh0.webp") == [[0, 0, 0, 51], [0, 1, 0, 102], [1, 0, 0, 255]]
    # w, then x left out; the last has w = y: the first is left out, y is sqrt(1/2): 255
    assert texels("quats.webp") == [[128] * 3 + [252], [128] * 3 + [253], [128, 255, 128, 252]]


@pytest.mark.parametrize("ending", ENDINGS)
def test_round_trip_is_within_the_steps_of_the_format(ending, tmp_path, rng):
    """Half a step of each number, from the specifications: bytes of rotation and colour, SPZ's
    1/4096 m and 1/16 of a logarithm, SOG's 16 bits of ln(1 + x) and its code books of 256.
    """
    scene = random_scene(rng)
    write_packed(tmp_path / f"a{ending}", scene)
    back = GaussianScene.load(tmp_path / f"a{ending}")
    place, log_scale, turn, colour = {
        ".splat": (0.0, 1e-6, 0.02, 0.51 / 255 * 2 * ROOT_PI),
        ".spz": (0.51 / 4096, 0.51 / 16, 0.004, 0.51 / 255 / 0.15),
        ".sog": (21 * 2 * math.log(21) / 65535, 7.1 / 250, 0.012, 1.9 / 100),
    }[ending]
    assert np.abs(back.means - scene.means).max() <= place
    assert np.abs(np.log(back.scales / scene.scales)).max() <= log_scale
    same = np.abs(np.einsum("ij,ij->i", back.quaternions, scene.quaternions))
    assert np.sqrt(2.0 - 2.0 * same.clip(0, 1)).max() <= turn
    assert np.abs(back.opacities - scene.opacities).max() <= 0.51 / 255
    assert np.abs(back.sh[:, 0] - scene.sh[:, 0]).max() <= colour
    if ending == ".splat":
        assert back.sh.shape[1] == 1
    else:
        assert np.abs(back.sh[:, 1:] - scene.sh[:, 1:]).max() <= 1.0 / 64


@pytest.mark.parametrize("degree", [0, 2, 3])
@pytest.mark.parametrize("ending", [".spz", ".sog"])
def test_every_degree_is_read_as_written(ending, degree, tmp_path, rng):
    """The coefficients come back in their places: far apart from each other, within 1/20."""
    scene = random_scene(rng, 40, degree)
    write_packed(tmp_path / f"a{ending}", scene)
    back = GaussianScene.load(tmp_path / f"a{ending}")
    assert back.sh.shape == scene.sh.shape and np.abs(back.sh - scene.sh).max() < 0.05


def test_many_sets_of_harmonics_become_the_nearest(tmp_path, rng):
    """20,000 different sets around eight centres: 16,384 are kept, the error stays within the
    spread of a centre, and the loss is stated.
    """
    scene = random_scene(rng, 20_000)
    centres = rng.uniform(-0.8, 0.8, (8, 3, 3))
    sh = scene.sh.copy()
    sh[:, 1:] = centres[rng.integers(0, 8, 20_000)] + rng.uniform(-0.05, 0.05, (20_000, 3, 3))
    scene = GaussianScene(scene.means, scene.quaternions, scene.scales, scene.opacities, sh)
    lost = write_packed(tmp_path / "a.sog", scene)
    assert any("16384 sets" in sentence for sentence in lost)
    back = GaussianScene.load(tmp_path / "a.sog")
    assert np.abs(back.sh[:, 1:] - sh[:, 1:]).max() < 0.11


@pytest.mark.parametrize("ending", ENDINGS)
def test_what_is_lost_is_said(ending, tmp_path, rng):
    """Labels and source by name; colours by direction in .splat; nothing for a plain scene."""
    lost = " ".join(write_packed(tmp_path / f"a{ending}", random_scene(rng)))
    assert "floor, wall" in lost and "made up" in lost
    assert ("SH degree 0" in lost) == (ending == ".splat")
    plain = GaussianScene([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [1.0], [[[0, 0, 0]]])
    assert write_packed(tmp_path / f"b{ending}", plain) == []


def test_values_beyond_the_range_are_cut_and_counted(tmp_path):
    """A colour of 2.26 = 1/2 + 0.2821 * 6.25 and a deviation of 1 um in SPZ; a colour in .splat."""
    scene = one(sh=[[[6.25, 0, 0]]], scales=[[1e-6, 1, 1]])
    lost = write_packed(tmp_path / "a.spz", scene)
    assert len(lost) == 2 and all("1 Gaussians are cut" in sentence for sentence in lost)
    back = GaussianScene.load(tmp_path / "a.spz")
    assert back.sh[0, 0, 0] == pytest.approx(1.0 / 0.3, rel=1e-6)
    assert back.scales[0, 0] == pytest.approx(math.exp(-10.0), rel=1e-6)
    assert "0..1" in " ".join(write_packed(tmp_path / "a.splat", scene))


def test_a_large_scene_gets_coarser_steps(tmp_path):
    """By hand: 2^23 / 10,000 m = 838, so 9 fractional bits; 8.4 million metres do not fit."""
    payload, _ = spz_payload(one(means=[[10_000.0, 0, 0]]))
    assert payload[13] == 9
    with pytest.raises(InputError, match="within 8388607 m"):
        spz_payload(one(means=[[9e6, 0, 0]]))


def test_coarser_harmonics_are_multiples_of_their_step():
    """5 bits: steps of 8 in a byte, round to nearest; 0.3 is 38.4, the nearest of them 40."""
    scene = one(sh=[[[0, 0, 0], [0.3, 0, 0], [0, 0, 0], [0, 0, 0]]])
    payload, _ = spz_payload(scene, sh_bits=5)
    assert list(payload[-9:]) == [128 - 40, *[128] * 8]


@pytest.mark.parametrize(
    ("name", "error", "text"),
    [
        ("a.ksplat", InputError, ".splat, .spz, .sog"),
        ("a", InputError, "another ending"),
        ("nowhere/a.spz", FileNotFoundError, "nowhere"),
    ],
)
def test_a_name_that_cannot_be_written_is_a_sentence(name, error, text, tmp_path):
    """Nothing is left behind."""
    with pytest.raises(error, match=text):
        write_packed(tmp_path / name, one())
    assert list(tmp_path.iterdir()) == []


def test_the_same_scene_gives_the_same_bytes(tmp_path, rng):
    """No time stamps and no randomness."""
    scene = random_scene(rng, 50)
    for ending in ENDINGS:
        write_packed(tmp_path / f"a{ending}", scene)
        write_packed(tmp_path / f"b{ending}", scene)
        assert (tmp_path / f"a{ending}").read_bytes() == (tmp_path / f"b{ending}").read_bytes()
    assert io.BytesIO((tmp_path / "a.spz").read_bytes()).read(2) == b"\x1f\x8b"
