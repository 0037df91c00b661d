"""Fuzzing: 10,800 damaged scenes go through the readers; each is read or refused in one sentence,
in little memory.

Damage outside hits the file as it lies on the disk, where checksums catch most of it. Damage inside
hits the content, and the file is packed again with checksums that fit: what a broken program
writes, or a hostile one.
"""

import tracemalloc
import zipfile
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.scene import GaussianScene
from tests.core.test_fuzz import mutate
from tests.scene.packing import compressed_ply, gzipped, plain_ply, sog_files, spz_payload, zipped
from tests.scene.test_gaussians import fields

FILES = 1200  # of each of the nine kinds
# Readers may unpack a megabyte unasked, which is some 50,000 Gaussians of 200 to 400 bytes while
# they are put together.
BYTES_PER_FILE_BYTE, BYTES_AT_LEAST = 100, 24 * 1024**2


def splat(rng: np.random.Generator) -> bytes:
    """Eight Gaussians of 32 bytes."""
    rows = [
        np.concatenate([rng.normal(size=3), rng.uniform(0.1, 1, 3)]).astype("<f4").tobytes()
        for _ in range(8)
    ]
    return b"".join(row + rng.integers(0, 256, 8, np.uint8).tobytes() for row in rows)


def ply(rng: np.random.Generator) -> bytes:
    """Four Gaussians with SH degree 1."""
    return plain_ply(rng.normal(size=(4, 26)), rest=9)


def packed_ply(rng: np.random.Generator) -> bytes:
    """Four Gaussians with SH degree 1."""
    chunk = [
        *rng.uniform(-2, 0, 3),
        *rng.uniform(0, 1, 3),
        *rng.uniform(-2, 0, 3),
        *rng.uniform(0, 1, 3),
        *[0] * 3,
        *[1] * 3,
    ]
    return compressed_ply(
        [chunk], rng.integers(0, 2**32, (4, 4)), sh=rng.integers(0, 256, (4, 9)).tolist()
    )


def spz(rng: np.random.Generator) -> bytes:
    """Four Gaussians with SH degree 1, not yet zipped."""
    sizes = (36, 4, 12, 12, 16, 36)
    return spz_payload(3, *(rng.bytes(size) for size in sizes), count=4, degree=1)


def native(tmp_path) -> dict[str, bytes]:
    """The arrays of a scene of four by their names in the zip."""
    GaussianScene(**fields(4)).save(tmp_path / "seed.npz")
    with zipfile.ZipFile(tmp_path / "seed.npz") as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Alternately the heavy damage of the flight files' fuzz and up to eight flipped bits."""
    if rng.integers(2):
        return mutate(data, rng)
    flipped = np.frombuffer(data, np.uint8).copy()
    flipped[rng.integers(0, len(data), rng.integers(1, 9))] ^= np.uint8(1) << rng.integers(
        8, dtype=np.uint8
    )
    return flipped.tobytes()


def inside(files: dict[str, bytes]) -> Callable[[np.random.Generator], bytes]:
    """Damage to one member of a zip, which is then made anew."""
    names = sorted(files)

    def damage(rng: np.random.Generator) -> bytes:
        name = names[rng.integers(len(names))]
        return zipped(files | {name: damaged(files[name], rng)})

    return damage


def fuzz(path, damage: Callable[[np.random.Generator], bytes], first: int) -> Counter[str]:
    """Read FILES damaged files, count the outcomes, and watch the memory of every third, for
    watching is slow.
    """
    outcomes: Counter[str] = Counter()
    for number in range(first, first + FILES):
        data = damage(np.random.default_rng(number))
        path.write_bytes(data)
        if number % 3 == 0:
            tracemalloc.start()
        try:
            GaussianScene.load(path)
            outcomes["read"] += 1
        except (InputError, FileNotFoundError) as error:
            sentence = str(error)
            assert len(sentence) < 1000 and "\n" not in sentence, (
                f"mutation {number}: {sentence[:3000]}"
            )
            outcomes["refused"] += 1
        except Exception as error:
            raise AssertionError(f"mutation {number} of {path.name} ends in {error!r}") from error
        finally:
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        assert peak < BYTES_PER_FILE_BYTE * len(data) + BYTES_AT_LEAST, (
            f"mutation {number}: {peak} of {len(data)}"
        )
    assert outcomes["read"] + outcomes["refused"] == FILES
    return outcomes


@pytest.mark.parametrize(
    ("seed", "ending"), [(ply, ".ply"), (packed_ply, ".ply"), (splat, ".splat")]
)
def test_files_without_checksums(tmp_path, seed, ending):
    """Much damage to plain numbers cannot be seen; both outcomes must happen."""
    whole = seed(np.random.default_rng(0))
    (tmp_path / f"a{ending}").write_bytes(whole)
    assert len(GaussianScene.load(tmp_path / f"a{ending}")) > 3
    check_both_happen(fuzz(tmp_path / f"a{ending}", lambda rng: damaged(whole, rng), 0))


@pytest.mark.parametrize("where", ["inside", "outside"])
def test_spz(tmp_path, where):
    """Damage to the payload before it is zipped, and to the gzip file."""
    payload, path = spz(np.random.default_rng(0)), tmp_path / "a.spz"
    whole = gzipped(payload)
    path.write_bytes(whole)
    assert len(GaussianScene.load(path)) == 4
    if where == "inside":
        check_both_happen(fuzz(path, lambda rng: gzipped(damaged(payload, rng)), 10_000))
    else:
        assert fuzz(path, lambda rng: damaged(whole, rng), 20_000)["refused"] > FILES // 2


@pytest.mark.parametrize("where", ["inside", "outside"])
@pytest.mark.parametrize("ending", [".sog", ".npz"])
def test_zips(tmp_path, where, ending):
    """Damage to one file in the zip, and to the zip."""
    files = sog_files(np.random.default_rng(0)) if ending == ".sog" else native(tmp_path)
    whole, path = zipped(files), tmp_path / f"a{ending}"
    path.write_bytes(whole)
    assert len(GaussianScene.load(path)) >= 4
    if where == "inside":
        check_both_happen(fuzz(path, inside(files), 30_000))
    else:
        assert fuzz(path, lambda rng: damaged(whole, rng), 40_000)["refused"] > FILES // 2


def check_both_happen(outcomes: Counter[str]) -> None:
    """A fuzz that only ever refuses, or only ever reads, tests nothing."""
    assert min(outcomes["read"], outcomes["refused"]) > FILES // 100, outcomes
