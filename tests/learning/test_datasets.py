"""Datasets: what is written is read, as LeRobot's format has it; nothing half-written counts."""

import json
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from falconwing_kit.core.checks import InputError
from falconwing_kit.learning import datasets
from falconwing_kit.learning.datasets import (
    Dataset,
    DatasetRecord,
    Episode,
    append_episodes,
    begin_dataset,
)
from falconwing_kit.learning.flights import AUXILIARY
from falconwing_kit.learning.learner import Flown

LENGTHS = (5, 7, 6)


def record(flights=3, task="follow", **changes):
    given = {"width": 8, "height": 6, "focal": 0.62, "options": {"seed": 0, "scene": "hall"}}
    return DatasetRecord(task, flights=flights, **(given | changes))


def episode(length, seed, task="follow"):
    """Random images and numbers that float32 holds exactly."""
    rng = np.random.default_rng(seed)

    def numbers(*shape):
        return rng.integers(-64, 64, shape) / 64.0

    images = torch.from_numpy(rng.integers(0, 256, (length, 3, 6, 8), dtype=np.uint8))
    masks = torch.from_numpy(rng.integers(0, 256, (length, 6, 8), dtype=np.uint8))
    poses = np.tile(np.eye(4), (length, 1, 1))
    poses[:, :3] = numbers(length, 3, 4)
    flown = Flown(
        images, masks if task == "follow" else None, numbers(length, 4), numbers(length, 4),
        numbers(length, AUXILIARY), numbers(3),
    )  # fmt: skip
    return Episode(flown, poses, seed, {"contact": "", "success": seed % 2 == 0})


@pytest.fixture
def folder(tmp_path):
    """Three flights in two files."""
    folder = tmp_path / "flights"
    begin_dataset(folder, record())
    append_episodes(folder, [episode(LENGTHS[0], 70), episode(LENGTHS[1], 71)])
    append_episodes(folder, [episode(LENGTHS[2], 72)])
    return folder


def test_what_is_written_is_read(folder):
    """Images to the byte, numbers to the bit, seeds and outcomes, over two files."""
    dataset = Dataset(folder)
    assert (len(dataset), dataset.frames) == (3, sum(LENGTHS))
    for k, found in enumerate(dataset.read_episodes()):
        expected = episode(LENGTHS[k], 70 + k)
        assert found.seed == 70 + k and found.outcome == expected.outcome
        assert np.array_equal(found.Ts_world_camera, expected.Ts_world_camera)
        assert torch.equal(found.flown.images, expected.flown.images)
        assert torch.equal(found.flown.masks, expected.flown.masks)
        for part in ("sent", "teacher", "auxiliary", "p_body_camera"):
            assert np.array_equal(getattr(found.flown, part), getattr(expected.flown, part))
        assert torch.equal(dataset[k].images, expected.flown.images)
    assert [len(flown.sent) for flown in dataset[0:2]] == list(LENGTHS[:2])


def test_the_layout_is_lerobots(folder):
    """Names of files, columns and their types as the documentation of version 3.0 lists them."""
    info = json.loads((folder / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["fps"] == 20
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 18, 1)
    assert info["splits"] == {"train": "0:3"}
    assert info["data_path"] == "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    features = info["features"]
    assert features["observation.images.nose"] == {
        "dtype": "image", "shape": [6, 8, 3], "names": ["height", "width", "channels"],
    }  # fmt: skip
    assert features["action"]["shape"] == [4] and features["action"]["dtype"] == "float32"
    table = pq.read_table(folder / info["data_path"].format(chunk_index=0, file_index=0))
    assert set(table.column_names) == set(features)
    image = table.schema.field("observation.images.nose").type
    assert image == pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    assert table["timestamp"].to_pylist()[:3] == pytest.approx([0.0, 0.05, 0.1])
    assert table["frame_index"].to_pylist() == [*range(5), *range(7)]
    assert table["episode_index"].to_pylist() == [0] * 5 + [1] * 7
    assert table["next.done"].to_pylist() == [*[False] * 4, True, *[False] * 6, True]
    second = pq.read_table(folder / info["data_path"].format(chunk_index=0, file_index=1))
    assert second["index"].to_pylist() == [*range(12, 18)]
    rows = pq.read_table(folder / "meta/episodes/chunk-000/file-001.parquet").to_pylist()
    place = [rows[0][f"{part}/{kind}_index"] for part in ("data", "meta/episodes")
             for kind in ("chunk", "file")]  # fmt: skip
    assert place == [0, 1, 0, 1] and rows[0]["tasks"] == ["follow the leader"]
    assert (rows[0]["dataset_from_index"], rows[0]["dataset_to_index"]) == (12, 18)
    tasks = pq.read_table(folder / "meta/tasks.parquet")
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    assert tasks.to_pylist() == [{"task_index": 0, "task": "follow the leader"}]


def test_statistics_are_those_of_all_frames_together(folder):
    """By NumPy over the flights in one array; images per channel, in 0..1."""
    stats = json.loads((folder / "meta/stats.json").read_text())
    flights = [episode(length, 70 + k).flown for k, length in enumerate(LENGTHS)]
    sent = np.concatenate([flown.sent for flown in flights])
    images = np.concatenate([flown.images.numpy() for flown in flights]) / 255.0
    for kind in ("min", "max", "mean", "std"):
        assert stats["action"][kind] == pytest.approx(getattr(sent, kind)(0).tolist())
        expected = getattr(images, kind)((0, 2, 3))
        found = np.array(stats["observation.images.nose"][kind])
        assert found.shape == (3, 1, 1) and found[:, 0, 0] == pytest.approx(expected)
    assert stats["action"]["count"] == [18]


def test_a_pilot_may_read_only_what_it_did_itself(folder):
    """`observation.state` is the command before and the camera's place: nothing of the truth."""
    table = pq.read_table(folder / "data/chunk-000/file-000.parquet")
    state = np.array(table["observation.state"].to_pylist())
    flown = episode(LENGTHS[0], 70).flown
    assert np.array_equal(state[1:5, :4], flown.sent[:-1]) and not state[0, :4].any()
    assert np.array_equal(state[:5, 4:], np.tile(flown.p_body_camera, (5, 1)))
    observed = [name for name in table.column_names if name.startswith("observation.")]
    assert sorted(observed) == ["observation.images.nose", "observation.state"]


def test_a_write_that_fails_costs_only_its_own_file(folder, monkeypatch):
    """The disk fills while the third file is written: the two before are whole, no rest is left,
    and going on gives what an undisturbed collection gives.
    """
    undisturbed = folder.with_name("undisturbed")
    shutil.copytree(folder, undisturbed)
    for each in (folder, undisturbed):
        (each / "meta/falconwing.json").write_text(json.dumps(record(4).__dict__))
    append_episodes(undisturbed, [episode(8, 73)])
    with monkeypatch.context() as patch:
        patch.setattr(datasets.pq.ParquetWriter, "write_table", _full_disk)
        with pytest.raises(InputError, match="disk is full"):
            append_episodes(folder, [episode(8, 73)])
    assert not list(folder.rglob("*.part")) and not list(folder.rglob("file-002*"))
    with pytest.raises(InputError, match=r"of 4 flights, got the first 3; give the same falcon"):
        Dataset(folder)
    assert begin_dataset(folder, record(4)) == 3
    append_episodes(folder, [episode(8, 73)])
    assert content(folder) == content(undisturbed)


def test_data_that_no_flight_counts_are_written_again(folder, monkeypatch):
    """Ended between the data and info.json: the next file takes the same name."""
    (folder / "meta/falconwing.json").write_text(json.dumps(record(4).__dict__))
    with monkeypatch.context() as patch:
        patch.setattr(datasets, "_write_info", _full_disk)
        with pytest.raises(OSError):
            append_episodes(folder, [episode(8, 99)])
    assert begin_dataset(folder, record(4)) == 3
    append_episodes(folder, [episode(8, 73)])
    assert Dataset(folder)[3].sent == pytest.approx(episode(8, 73).flown.sent)
    assert len(list(folder.rglob("data/*/*.parquet"))) == 3


def _full_disk(*_, **__):
    raise OSError(28, "No space left on device")


def content(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*.*")}


def cut(path):
    path.write_bytes(path.read_bytes()[:-200])


def flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 0xFF
    path.write_bytes(data)


def replace_text(before, after):
    return lambda path: path.write_text(path.read_text().replace(before, after))


@pytest.mark.parametrize(
    ("name", "damage", "sentence"),
    [
        ("data/chunk-000/file-001.parquet", cut, "damaged or cut short"),
        ("data/chunk-000/file-000.parquet", flip, "damaged or cut short"),
        ("data/chunk-000/file-000.parquet", lambda path: path.unlink(), "got none"),
        ("meta/episodes/chunk-000/file-000.parquet", cut, "damaged or cut short"),
        ("meta/info.json", replace_text("v3.0", "v2.1"), "format v3.0, got 'v2.1'"),
        ("meta/info.json", replace_text("{", ""), "expected the description of a LeRobot dataset"),
        ("meta/info.json", replace_text('episodes": 3', 'episodes": 2'), "of 3 flights, got the"),
        ("meta/falconwing.json", replace_text('version": 1', 'version": 7'), "version 1, got 7"),
        ("meta/falconwing.json", replace_text('"width": 8', '"width": 9'), "damaged or cut short"),
        ("meta/falconwing.json", cut, "expected the record of a dataset, got a damaged file"),
    ],
)  # fmt: skip
def test_a_damaged_dataset_is_one_sentence(folder, name, damage, sentence):
    """Cut short, a flipped byte, a missing file, another version: never other data in silence."""
    damage(folder / name)
    with pytest.raises(InputError, match=sentence):
        list(Dataset(folder).read_episodes())


def test_a_folder_of_something_else_is_left_alone(tmp_path, folder):
    """Other files, a file, other options; and no dataset to read."""
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.txt").write_text("1")
    with pytest.raises(InputError, match="got other files"):
        begin_dataset(tmp_path / "thesis", record())
    with pytest.raises(InputError, match="got a file"):
        begin_dataset(tmp_path / "thesis" / "chapter.txt", record())
    with pytest.raises(InputError, match="got one of other flights"):
        begin_dataset(folder, record(9))
    with pytest.raises(InputError, match="got one of other scene"):
        begin_dataset(folder, record(options={"seed": 0, "scene": "arena"}))
    with pytest.raises(FileNotFoundError, match="expected a dataset of falconwing collect"):
        Dataset(tmp_path / "thesis")


def test_decoded_images_are_kept_within_a_limit(folder, monkeypatch):
    """With room for one flight, each is still read right, and the last one is kept."""
    monkeypatch.setattr(datasets, "CACHE_BYTES", 7 * 3 * 6 * 8)
    dataset = Dataset(folder)
    for k in (0, 1, 2, 0):
        assert torch.equal(dataset[k].images, episode(LENGTHS[k], 70 + k).flown.images)
    assert dataset[0] is dataset[0] and len(dataset._cache) == 1
