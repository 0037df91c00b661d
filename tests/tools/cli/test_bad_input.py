"""Bad input at the doors: one sentence and exit code 2, for a part of the table (all: a benchmark).

Also the last door for errors that no verb expects, and options out of their range.
"""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import read_text
from falconwing_kit.tools.cli.main import main, sentence_of
from falconwing_kit.vision import images
from falconwing_kit.vision.images import decode_image, read_image
from tests.tools.cli.bad_input import CASES, DAMAGED, fault, write_damaged

EVERY = 11  # coprime to the number of files, so that each file and each door comes up


def test_damaged_files_end_in_one_sentence(tmp_path: Path):
    """Every eleventh case of the product; `bench_bad_input` runs all."""
    files = write_damaged(tmp_path)
    chosen = CASES[::EVERY]
    assert len({slot for slot, _ in chosen}) > 25 and len({name for _, name in chosen}) > 35
    faults = [f"{s} < {n}: {why}" for s, n in chosen if (why := fault(s, files[n], tmp_path))]
    assert not faults, "\n".join(faults)


@pytest.mark.parametrize(
    ("error", "word"),
    [
        (MemoryError(), "memory is full"),
        (RecursionError(), "nested too deeply"),
        (UnicodeDecodeError("utf-8", b"\xe9", 0, 1, "invalid byte"), "save it as UTF-8"),
        (np.linalg.LinAlgError("Singular matrix"), "cannot be solved"),
        (OSError(40, "Too many levels of symbolic links", "a"), "a: Too many levels"),
        (ModuleNotFoundError("x", name="cv2"), "the library cv2 is not installed"),
        (ImportError("cannot allocate memory"), "a library cannot be loaded"),
        (Image.DecompressionBombError("256 million pixels"), "an image is too large"),
    ],
)
def test_the_last_door_has_a_sentence(error, word):
    """For files, memory and numbers; a fault of the kit itself keeps its traceback."""
    assert word in sentence_of(error)
    assert sentence_of(TypeError("fault of the kit")) == ""


def test_text_in_another_encoding_or_too_large_is_refused(tmp_path):
    """Latin-1, UTF-16, and a file larger than allowed, which is not read; a mark is left out."""
    (tmp_path / "a.csv").write_bytes("é".encode("latin-1"))
    (tmp_path / "b.csv").write_bytes("student".encode("utf-16"))
    (tmp_path / "c.csv").write_bytes(b"\xef\xbb\xbfstudent")
    for name in ("a.csv", "b.csv"):
        with pytest.raises(InputError, match="expected text in UTF-8"):
            read_text(tmp_path / name)
    assert read_text(tmp_path / "c.csv") == "student"
    with pytest.raises(InputError, match="at most 0 MiB"):
        read_text(tmp_path / "c.csv", max_bytes=5)
    with (tmp_path / "big.csv").open("wb") as file:
        file.truncate(20 * 1024**3)  # sparse
    with pytest.raises(InputError, match="got 20480 MiB"):
        read_text(tmp_path / "big.csv")


def test_a_huge_image_is_not_decoded(tmp_path, monkeypatch):
    """16,000 pixels a side; red stays red, and bytes of another kind are None."""
    import cv2

    (tmp_path / "bomb.png").write_bytes(DAMAGED["png_huge"])
    with pytest.raises(InputError, match=r"bomb.png: image: expected at most 120 million pixels"):
        read_image(tmp_path / "bomb.png")
    red = np.zeros((4, 6, 3), np.uint8)
    red[..., 2] = 255  # OpenCV's order: blue, green, red
    decoded = decode_image(cv2.imencode(".png", red)[1].tobytes())
    assert decoded.shape == (4, 6, 3) and decoded[0, 0].tolist() == [255, 0, 0]
    assert decode_image(b"") is None and decode_image(b"no image at all") is None
    monkeypatch.setattr(images, "MAX_FILE_BYTES", 10)
    with pytest.raises(InputError, match="expected an image of at most"):
        read_image(tmp_path / "bomb.png")


@pytest.mark.parametrize(
    "words",
    [
        ["size", "--mass-g", "1e300"],
        ["size", "--mass-g", "1e-300"],
        ["size", "--hall-width-m", "1e200"],
        ["size", "--bank-deg", "90"],
        ["labs", "release", ""],
    ],
)
def test_absurd_options_are_refused(words, capsys):
    """One sentence, exit code 2."""
    assert main(words) == 2
    assert capsys.readouterr().err.startswith("falconwing: ")
