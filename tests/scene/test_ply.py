"""PLY files: Gaussians packed by hand, there and back, and false headers."""

import math
import struct

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene import GaussianScene
from tests.scene.packing import ROW, compressed_ply, plain_ply, ply_bytes
from tests.scene.test_gaussians import fields

# A Gaussian as trainers export it: log scales, logit opacity, a quaternion that is not of length 1.
HAND = [
    1.0,
    2.0,
    -3.0,
    0,
    0,
    0,
    0.1,
    0.2,
    0.3,
    math.log(0.25 / 0.75),
    0.0,
    math.log(0.5),
    -2.0,
    2.0,
    0.0,
    0.0,
    2.0,
]
HALF = math.sqrt(0.5)


def load(tmp_path, data):
    path = tmp_path / "a.ply"
    path.write_bytes(data)
    return GaussianScene.load(path)


def test_plain_gaussian_by_hand(tmp_path):
    """exp of the scales, logistic function of the opacity, quaternion over its length; float32
    rounding.
    """
    scene = load(tmp_path, plain_ply([HAND]))
    assert scene.means.tolist() == [[1.0, 2.0, -3.0]]
    assert np.allclose(scene.scales, [[1.0, 0.5, math.exp(-2.0)]], rtol=1e-6)
    assert np.allclose(scene.opacities, [0.25], rtol=1e-6)
    assert np.allclose(scene.quaternions, [[HALF, 0, 0, HALF]], rtol=1e-6)
    assert np.allclose(scene.sh, [[[0.1, 0.2, 0.3]]], rtol=1e-6)
    assert scene.source.endswith("/a.ply")


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_higher_colours_are_all_red_then_all_green_then_all_blue(tmp_path, degree):
    """Inria's export writes channel by channel: f_rest_k is coefficient k mod (K - 1) of channel k
    div (K - 1).
    """
    higher = (degree + 1) ** 2 - 1
    rest = [float(k) for k in range(3 * higher)]
    scene = load(tmp_path, plain_ply([HAND[:9] + rest + HAND[9:]], rest=len(rest)))
    assert scene.sh.shape == (1, higher + 1, 3)
    for channel in range(3):
        assert scene.sh[0, 1:, channel].tolist() == rest[channel * higher : (channel + 1) * higher]


def test_order_types_and_further_properties_do_not_matter(tmp_path):
    """A PLY names its properties; here they stand backwards, as doubles, beside an
    unknown one.
    """
    names = [*ROW[::-1], "mood"]
    row = struct.pack(f"<{len(names)}d", *HAND[::-1], 7.0)
    data = ply_bytes(
        [("camera", 1, [("uchar", "id")]), ("vertex", 1, [("double", n) for n in names])],
        b"\x05" + row,
    )
    scene, expected = load(tmp_path, data), load(tmp_path, plain_ply([HAND]))
    for name in ("means", "quaternions", "scales", "opacities", "sh"):
        assert np.allclose(getattr(scene, name), getattr(expected, name), rtol=1e-6), name


@pytest.mark.parametrize("basis", [1, 4, 9, 16])
def test_there_and_back(tmp_path, basis):
    """Writing and reading are inverse: exact where nothing is calculated; log, exp and logit in
    float32 give 2e-6.
    """
    scene = GaussianScene(
        **fields(300, basis), source="made in  a test\n\nunder no licence, by Åse"
    )
    scene.save(tmp_path / "b.ply")
    back = GaussianScene.load(tmp_path / "b.ply")
    assert np.array_equal(back.means, scene.means) and np.array_equal(back.sh, scene.sh)
    assert np.array_equal(back.quaternions, scene.quaternions)
    assert np.allclose(back.scales, scene.scales, rtol=2e-6, atol=0)
    assert np.allclose(back.opacities, scene.opacities, rtol=0, atol=2e-6)
    assert back.source == "made in  a test\n\nunder no licence, by \\xc5se"


def test_header_is_that_of_the_usual_exporters(tmp_path):
    """Inria's and nerfstudio's exports list position, normal, colour, opacity, scale, rotation, all
    as float.
    """
    GaussianScene(**fields(2, 1)).save(tmp_path / "b.ply")
    header = (tmp_path / "b.ply").read_bytes().split(b"end_header\n")[0].decode().splitlines()
    assert header[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 2"]
    assert header[3:] == [f"property float {name}" for name in ROW]


def test_opacity_of_none_and_all_survives(tmp_path):
    """Their logits are infinite, so they move by 2e-9 at most: the logistic function of 20."""
    scene = GaussianScene(**(fields(2) | {"opacities": np.array([0.0, 1.0])}))
    scene.save(tmp_path / "b.ply")
    assert np.allclose(
        GaussianScene.load(tmp_path / "b.ply").opacities, [0.0, 1.0], rtol=0, atol=3e-9
    )


CHUNK = [
    0,
    0,
    0,
    2047,
    1023,
    2047,
    -4,
    -2,
    0,
    0,
    2,
    4,
    0,
    0,
    -1,
    1,
    2,
    1,
]  # least and greatest: means, log scales, colours


def test_compressed_gaussian_by_hand(tmp_path):
    """With a chunk from 0 to 2047, 1023, 2047 the packed position is the position itself.

    Scales: 0 of -4..0, 1023 of -2..2 and 2047 of 0..4 are exp(-4), exp(2), exp(4). Rotation: the
        word's two top bits
    say that y (place 2 of w x y z) is left out; 1023 is sqrt(1/2), 512 is 0.0007, so w = y = 0.7071
    within that step. Colours: 255 of 0..1 is 1, or (1 - 1/2) 2 sqrt(pi) = sqrt(pi) as coefficient;
    51 of 0..2 is 0.4.
    """
    words = (
        5 << 21 | 6 << 11 | 7,
        2 << 30 | 1023 << 20 | 512 << 10 | 512,
        1023 << 11 | 2047,
        0xFF3300CC,
    )
    scene = load(tmp_path, compressed_ply([CHUNK], [words]))
    assert np.allclose(scene.means, [[5.0, 6.0, 7.0]], rtol=1e-5)
    assert np.allclose(scene.scales, [np.exp([-4.0, 2.0, 4.0])], rtol=1e-5)
    assert np.allclose(scene.quaternions, [[HALF, 0.0, HALF, 0.0]], atol=1e-3)
    root_pi = math.sqrt(math.pi)
    assert np.allclose(scene.sh, [[[root_pi, -0.2 * root_pi, -3.0 * root_pi]]], rtol=1e-5)
    assert np.allclose(scene.opacities, [0.8], rtol=1e-6)


@pytest.mark.parametrize("place", [0, 1, 2, 3])
def test_the_left_out_component_goes_to_its_place(tmp_path, place):
    """By hand: with 1023, 512, 512 for the others the first of them and the left out one are
    sqrt(1/2).
    """
    words = (0, place << 30 | 1023 << 20 | 512 << 10 | 512, 0, 0xFFFFFFFF)
    expected = np.zeros(4)
    expected[[place, 1 if place == 0 else 0]] = HALF
    assert np.allclose(
        load(tmp_path, compressed_ply([CHUNK], [words])).quaternions, [expected], atol=1e-3
    )


def test_every_256_gaussians_have_their_own_chunk(tmp_path):
    """By hand: 300 Gaussians at the least corner of two chunks that begin at x = 0 and x = 100."""
    chunks = [CHUNK, [100, *CHUNK[1:]]]
    scene = load(tmp_path, compressed_ply(chunks, [(0, 0, 0, 0xFFFFFFFF)] * 300))
    assert scene.means[:, 0].tolist() == [0.0] * 256 + [100.0] * 44


def test_compressed_colours_without_a_range_lie_in_0_to_1(tmp_path):
    """Older files have 12 numbers per chunk: 255 is 1, 0 is 0, or plus and minus sqrt(pi) as
    coefficients.
    """
    scene = load(tmp_path, compressed_ply([CHUNK[:12]], [(0, 0, 0, 0xFF00FFFF)], colors=False))
    assert np.allclose(scene.sh[0, 0], math.sqrt(math.pi) * np.array([1, -1, 1]), rtol=1e-5)


def test_compressed_higher_colours_by_hand(tmp_path):
    """Bytes stand for -4..4: 0 and 255 are the ends, 128 the middle of its step, 8 (128.5 / 256) -
    4 = 1/64.
    """
    rest = [0, 255, 128, 128, 128, 128, 128, 128, 64]
    scene = load(tmp_path, compressed_ply([CHUNK], [(0, 0, 0, 0xFFFFFFFF)], sh=[rest]))
    assert scene.sh[0, 1:, 0].tolist() == [-4.0, 4.0, 1 / 64]  # the first three are red
    assert scene.sh[0, 3, 2] == 8 * 64.5 / 256 - 4


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"solid cube\n", "got another kind of file"),
        (b"ply\nformat binary_little_endian 1.0\n", "a PLY header without its end"),
        (plain_ply([HAND], format_line="format ascii 1.0"), "got ascii; save it again as binary"),
        (plain_ply([HAND], format_line="format binary_big_endian 1.0"), "got binary_big_endian"),
        (plain_ply([HAND])[:-1], "expected 1 rows of 68 bytes for vertex, got 67 bytes"),
        (
            plain_ply([HAND]).replace(b"vertex 1", b"vertex 999999999999"),
            "the file was cut|it was cut",
        ),
        (plain_ply([HAND]).replace(b"vertex 1", b"vertex -1"), "got the line 'element vertex -1'"),
        (
            plain_ply([HAND]).replace(b"vertex", b"points"),
            "expected an element called vertex, found points",
        ),
        (plain_ply([HAND]).replace(b"float rot_3", b"float spin_"), "rot_3 is missing"),
        (
            plain_ply([HAND]).replace(b"float rot_3", b"float rot_2"),
            "every property once, got 'rot_2' twice",
        ),
        (
            plain_ply([HAND]).replace(b"float rot_3", b"list uchar int rot_3"),
            "got the line 'property list",
        ),
        (
            plain_ply([HAND]).replace(b"float nx", b"float f_rest_0"),
            "0, 9, 24 or 45 properties from f_rest_0 .*, got 1",
        ),
        (
            plain_ply([HAND[:9] + [0.0] * 72 + HAND[9:]], rest=72),
            "0, 9, 24 or 45 properties from f_rest_0 .*, got 72",
        ),
        (plain_ply([]), "expected at least one Gaussian"),
        (plain_ply([[*HAND[:10], math.inf, *HAND[11:]]]), "scales: expected finite numbers"),
        (plain_ply([[math.nan, *HAND[1:]]]), "means: expected finite numbers"),
        (plain_ply([[*HAND[:13], 0.0, 0.0, 0.0, 0.0]]), "quaternions: expected rotations"),
        (compressed_ply([CHUNK], [(0, 0, 0, 0)] * 257), "a chunk for each 256"),
        (
            compressed_ply([CHUNK], [(0, 0, 0, 0)], sh=[[0] * 10]),
            "0, 9, 24 or 45 properties from f_rest_0 .*, got 10",
        ),
        (
            compressed_ply([CHUNK], [(0, 0, 0, 0)], sh=[[0] * 9]).replace(b"rest_6", b"rest_9"),
            "got f_rest_9",
        ),
        (compressed_ply([CHUNK], [(0, 0, 0, 0)], sh=[[0] * 9] * 2), "a row of bytes in sh"),
        (
            compressed_ply([CHUNK], [(0, 0, 0, 0)]).replace(b"max_scale_z", b"top_scale_z"),
            "max_scale_z is missing",
        ),
    ],
)
def test_each_bad_file_gets_its_sentence(tmp_path, data, sentence):
    """The file's name, expected and got."""
    with pytest.raises(InputError, match=rf"/a\.ply: .*({sentence})"):
        load(tmp_path, data)
