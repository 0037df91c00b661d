"""Packed formats: Gaussians by hand from the specifications, a trained scene, and bombs."""

import json
import math
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene import GaussianScene
from tests.scene.packing import fixed24, gzipped, sog_files, spz_payload, webp, zipped

TRAINED = Path(__file__).resolve().parents[4] / "shared/data/splat"
HALF, ROOT_PI = math.sqrt(0.5), math.sqrt(math.pi)
ONE = (
    fixed24(6144, -8192, 1024),
    [51],
    [255, 0, 51],
    [160, 96, 176],
)  # position, opacity, colour, scale of an SPZ


def load(tmp_path, ending, data):
    path = tmp_path / f"a{ending}"
    path.write_bytes(data)
    return GaussianScene.load(path)


def test_splat_by_hand(tmp_path):
    """Colour 255 is 1, as coefficient (1 - 1/2) 2 sqrt(pi); opacity 51/255.

    Rotation bytes are 128 + 128 q, w first.
    """
    first = struct.pack("<6f8B", 1, 2, -3, 0.1, 0.2, 0.3, 255, 0, 51, 51, 255, 128, 128, 128)
    second = struct.pack("<6f8B", 4, 5, 6, 1, 1, 1, 0, 0, 0, 255, 128, 64, 128, 192)
    scene = load(tmp_path, ".splat", first + second)
    assert np.allclose(scene.means, [[1, 2, -3], [4, 5, 6]])
    assert np.allclose(scene.scales, [[0.1, 0.2, 0.3], [1, 1, 1]])
    assert np.allclose(scene.opacities, [0.2, 1.0])
    assert np.allclose(scene.sh[0, 0], [ROOT_PI, -ROOT_PI, -0.6 * ROOT_PI], rtol=1e-6)
    assert np.allclose(scene.quaternions, [[1, 0, 0, 0], [0, -HALF, 0, HALF]], atol=1e-6)


@pytest.mark.parametrize(
    ("version", "rotation", "expected", "atol"),
    [
        (
            2,
            [128, 128, 218],
            [HALF, 0, 0, -HALF],
            6e-3,
        ),  # x y z as 127.5 (1 + q); a step is 1 / 127.5
        (
            3,
            struct.pack("<I", 3 << 30 | 511),
            [HALF, 0, 0, -HALF],
            1e-6,
        ),  # w left out; x, y = 0; z = sqrt(1/2)
        (
            3,
            struct.pack("<I", 0 << 30 | 0x3FF << 20),
            [0, HALF, HALF, 0],
            1e-6,
        ),  # x left out; y = -sqrt(1/2)
        (
            3,
            struct.pack("<I", 1 << 30 | 511 << 20),
            [0, HALF, -HALF, 0],
            1e-6,
        ),  # y left out; x = sqrt(1/2)
        (
            3,
            struct.pack("<I", 2 << 30 | 0x3FF),
            [HALF, 0, 0, HALF],
            1e-6,
        ),  # z left out; w = -sqrt(1/2)
    ],
)
def test_spz_by_hand(tmp_path, version, rotation, expected, atol):
    """SPZ has y up and z back: half a turn about x changes the signs of y and z.

    Positions are in 1/4096: 6144, -8192, 1024 are 1.5, -2, 0.25. Opacity is 51/255, a colour
    (byte/255 - 1/2) / 0.15. Scales are exp(byte/16 - 10): 160, 96, 176 are 1, exp(-4), e.
    """
    scene = load(tmp_path, ".spz", gzipped(spz_payload(version, *ONE, rotation)))
    assert scene.means.tolist() == [[1.5, 2.0, -0.25]]
    assert np.allclose(scene.opacities, [0.2])
    assert np.allclose(scene.sh, [[[0.5 / 0.15, -0.5 / 0.15, -2.0]]], rtol=1e-5)
    assert np.allclose(scene.scales, [np.exp([0, -4, 1])], rtol=1e-5)
    turned = scene.quaternions * np.sign(
        scene.quaternions[0] @ expected
    )  # q and -q are one rotation
    assert np.allclose(turned, [expected], atol=atol)


def test_spz_version_1_has_half_floats(tmp_path):
    """Three 16-bit floats a position; 1.5, -2 and 0.25 are exact in them."""
    data = spz_payload(1, np.array([1.5, -2.0, 0.25], "<f2").tobytes(), *ONE[1:], [128, 128, 218])
    assert load(tmp_path, ".spz", gzipped(data)).means.tolist() == [[1.5, 2.0, -0.25]]


def harmonics(directions):
    """(N, 16) real harmonics up to degree 3 without their constants, which do not affect signs."""
    x, y, z = directions.T
    one = np.ones_like(x)
    return np.stack(
        [
            *(one, y, z, x),
            *(x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y),
            *(
                y * (3 * x * x - y * y),
                x * y * z,
                y * (5 * z * z - 1),
                z * (5 * z * z - 3),
                x * (5 * z * z - 1),
            ),
            *(z * (x * x - y * y), x * (x * x - 3 * y * y)),
        ],
        axis=1,
    )


def test_spz_colours_turn_with_the_axes(tmp_path):
    """A law: turning the scene and the eye alike changes no colour.

    The eye turns as (x, y, z) -> (x, -y, -z).
    """
    rng = np.random.default_rng(3)
    raw = rng.integers(0, 256, 45)
    scene = load(
        tmp_path, ".spz", gzipped(spz_payload(3, *ONE, bytes(4), raw.astype(np.uint8), degree=3))
    )
    directions = rng.normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = harmonics(directions)[:, 1:] @ ((raw.reshape(15, 3) - 128) / 128)
    after = harmonics(directions * [1, -1, -1])[:, 1:] @ scene.sh[0, 1:]
    assert np.allclose(after, before, atol=1e-5)
    assert (
        scene.sh[0, 3].tolist() == ((raw.reshape(15, 3)[2] - 128) / 128).tolist()
    )  # x does not turn


def test_spz_arrays_of_many_stand_one_after_the_other(tmp_path):
    """By hand: two Gaussians, all positions first, then all opacities and so on."""
    two = spz_payload(
        3, fixed24(4096, 0, 0, 8192, 0, 0), [0, 255], bytes(6), bytes(6), bytes(8), count=2
    )
    scene = load(tmp_path, ".spz", gzipped(two))
    assert scene.means[:, 0].tolist() == [1.0, 2.0] and scene.opacities.tolist() == [0.0, 1.0]


GOOD = spz_payload(3, *ONE, bytes(4))


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (GOOD, "got version 4 or later"),  # not gzipped, as version 4 is
        (b"hello", "got other or damaged bytes"),
        (gzipped(b"hello"), "got another gzip file"),
        (gzipped(b"x" * 99), "got another gzip file"),
        (gzipped(GOOD[:4] + b"\x04" + GOOD[5:]), "version 1 to 3, got 4"),
        (gzipped(GOOD[:12] + b"\x04" + GOOD[13:]), "of degree 4"),
        (gzipped(GOOD[:13] + b"\x20" + GOOD[14:]), "32 bits"),
        (gzipped(GOOD[:14] + b"\x02" + GOOD[15:]), "without vendor extensions"),
        (gzipped(GOOD[:8] + bytes(4) + GOOD[12:]), "got 0 of degree 0"),
        (gzipped(GOOD[:-1]), "got fewer or more"),
        (gzipped(GOOD + b"x"), "got fewer or more"),
        (gzipped(GOOD)[:-3], "got fewer or more"),
        (gzipped(GOOD)[:-8] + bytes(8), "damaged"),  # the checksum
        (gzipped(GOOD[:8] + b"\xff" * 4 + GOOD[12:]), "got one of 4294967295 Gaussians"),
        (
            gzipped(GOOD[:8] + struct.pack("<I", 10**6) + bytes(20 * 10**6)),
            "got one of 1000000 Gaussians",
        ),
    ],
)
def test_each_bad_spz_gets_its_sentence(tmp_path, data, sentence):
    """The last one is a bomb: 20 MB of zeros in 20 kB, refused before they are unpacked."""
    with pytest.raises(InputError, match=rf"/a\.spz: .*{sentence}"):
        load(tmp_path, ".spz", data)


def check_hand_packed(scene):
    """The Gaussian of `sog_files`.

    Means: fractions 1, 0 and 32768/65535 between mins and maxs, then sign(n) (exp|n| - 1): exp(ln
        4) - 1 = 3,
    -(exp(ln 2) - 1) = -1 and nearly 0. Quaternion: alpha 252 leaves w out, 255 is sqrt(1/2), 127
    and 128 are one step of 0.003 about 0. Scales and colours are numbers of their code books;
    palette entry 65 + 256 holds the rest.
    """
    assert np.allclose(scene.means, [[3.0, -1.0, 1 / 65535]], atol=1e-6)
    assert np.allclose(scene.quaternions, [[HALF, HALF, 0, 0]], atol=4e-3)
    assert np.allclose(scene.scales, [np.exp([-2, 0, 1])], rtol=1e-6)
    assert np.allclose(scene.opacities, [0.2])
    assert scene.sh.tolist() == [[[2, -1, 0], [-0.5, 0, 0], [0, 0.25, 0], [0, 0, 0.75]]]


def test_sog_by_hand_in_folder_and_zip(tmp_path):
    """The same files beside each other, by the name of meta.json, and in a zip."""
    files = sog_files()
    folder = tmp_path / "scene"
    folder.mkdir()
    for name, data in files.items():
        (folder / name).write_bytes(data)
    check_hand_packed(GaussianScene.load(folder))
    check_hand_packed(GaussianScene.load(folder / "meta.json"))
    check_hand_packed(load(tmp_path, ".sog", zipped(files)))
    (folder / "sh0.webp").unlink()
    with pytest.raises(FileNotFoundError, match=r"sh0\.webp"):
        GaussianScene.load(folder)


def edited(**parts):
    """A meta.json with some of its parts replaced."""
    return {"meta.json": json.dumps(json.loads(sog_files()["meta.json"]) | parts).encode()}


def with_pixel(name, pixel, shape=(2, 4)):
    return {name: webp(np.full((*shape, 4), pixel, np.uint8))}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"meta.json": b"[" * 100_000}, "the meta.json of SOG version 2"),
        ({"meta.json": b"{}"}, "the meta.json of SOG version 2"),
        (edited(version=1), "the meta.json of SOG version 2"),
        (edited(count=0), "a positive count"),
        (edited(count=True), "a positive count"),
        (edited(count=9), "a pixel for each of 9 Gaussians, got 8"),
        (edited(means=3), "2 plain file names for means"),
        (edited(quats={"files": ["../quats.webp"]}), "1 plain file names for quats"),
        (edited(quats={"files": ["/etc/passwd"]}), "1 plain file names for quats"),
        (edited(quats={"files": ["none.webp"]}), "expected none.webp in the zip, which is missing"),
        (
            edited(sh0={"files": ["sh0.webp"], "codebook": [0.0, math.nan, 1.0]}),
            "finite numbers for sh0 codebook",
        ),
        (edited(sh0={"files": ["sh0.webp"], "codebook": [0.0, 1.0]}), "codes below 2, .*got 2"),
        (
            edited(scales={"files": ["scales.webp"], "codebook": [0.0, 1.0, 999.0]}),
            "scales: expected finite numbers",
        ),
        (
            edited(means={"files": ["means_l.webp"] * 2, "mins": [0, 0], "maxs": [1, 1, 1]}),
            "three mins and three maxs",
        ),
        (
            edited(shN={"bands": 4, "codebook": [0.0], "files": ["centroids.webp", "labels.webp"]}),
            "1 to 3 bands",
        ),
        (
            edited(shN={"bands": 2, "codebook": [0.0], "files": ["centroids.webp", "labels.webp"]}),
            "2 bands, 192 pixels",
        ),
        (with_pixel("labels.webp", (128, 1, 255, 255)), "labels below 384, .*got 384"),
        (
            with_pixel("quats.webp", (128, 128, 128, 251)),
            "252 to 255 in the alpha of the quaternions, got 251",
        ),
        ({"quats.webp": b"GIF89a" + bytes(50)}, "a lossless WebP image"),
        ({"quats.webp": sog_files()["quats.webp"][:-9]}, "a whole WebP image"),
    ],
)
def test_each_bad_sog_gets_its_sentence(tmp_path, change, sentence):
    """Names that leave the folder, numbers that point nowhere, images that are none."""
    with pytest.raises(InputError, match=rf"/a\.sog: .*{sentence}"):
        load(tmp_path, ".sog", zipped(sog_files() | change))


def test_image_bomb_is_refused_before_it_is_decoded(tmp_path):
    """A WebP of one colour, 16000 x 16000, is a few hundred bytes and would be a gigabyte.

    Only its header is made.
    """
    image = bytearray(sog_files()["quats.webp"])
    image[21:25] = struct.pack("<I", 15999 | 15999 << 14 | 1 << 28)
    with pytest.raises(InputError, match="images of at most 200 times their files, got 256"):
        load(tmp_path, ".sog", zipped(sog_files() | {"quats.webp": bytes(image)}))
    assert zlib.crc32(image)  # the zip itself was whole: its checksums fit the changed image


@pytest.mark.parametrize(
    ("folder", "count"), [("playbot_lod2_125k", 125_000), ("playbot_lod3_31k", 31_000)]
)
def test_trained_scene_is_read(folder, count):
    """Recorded data (PLAYBOT by Stephane Agullo, CC-BY-4.0): SOURCE.txt has the count and degree 2.

    The model is a figure about 2 m wide: its meta.json has mins and maxs of -0.71..0.71 in x as
        logarithms, and
    exp(0.71) - 1 is 1.03. Most Gaussians of a trained surface are small beside it, and colours lie
    about 0..1.
    """
    path = TRAINED / folder
    if not path.is_dir():
        pytest.skip(
            "the trained scene does not ship with the kit and is not beside this checkout: "
            f"{path} is missing"
        )
    scene = GaussianScene.load(path)
    assert len(scene) == count and scene.sh.shape == (count, 9, 3)
    assert np.allclose(np.abs(scene.means).max(axis=0)[[0, 2]], 1.03, atol=0.02)
    assert 1e-4 < np.median(scene.scales) < 0.02 and scene.scales.max() < 1.0
    base = 0.5 + 0.2821 * scene.sh[:, 0]
    assert ((base > -0.2) & (base < 1.2)).mean() > 0.95
    assert 0.3 < scene.opacities.mean() < 0.95
    assert np.allclose(np.linalg.norm(scene.quaternions, axis=1), 1.0, atol=1e-6)
