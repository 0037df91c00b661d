"""Datasets: flights of an imitation <-> a folder in LeRobot's dataset format v3.0.

    meta/info.json, stats.json, tasks.parquet  what the columns are, their statistics
    meta/episodes/chunk-000/file-000.parquet   a row a flight: seed, outcome, where its frames are
    meta/falconwing.json                       camera, scene and options of the collection
    data/chunk-000/file-000.parquet            a row a frame, images as PNG, a row group a flight

Source: LeRobotDataset v3.0, huggingface.co/docs/lerobot/lerobot-dataset-v3. What a pilot may read
is under `observation.`; `teacher`, `auxiliary`, `camera_pose` and `leader_mask` are labels. Files
are written one after another and each at once, and a flight counts from the moment that info.json
counts it, so an interruption costs at most the flights of one file.
"""

import io
import json
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from numpy.typing import NDArray
from PIL import Image

from falconwing_kit.core.checks import Array, InputError
from falconwing_kit.core.files import atomic_write, read_text, short_name
from falconwing_kit.core.messages import CONTROL_PERIOD_S
from falconwing_kit.learning.flights import AUXILIARY
from falconwing_kit.learning.learner import Flown

VERSION = "v3.0"  # of LeRobot's format
OWN_VERSION = 1  # of meta/falconwing.json
FRAME_RATE_HZ = round(1.0 / CONTROL_PERIOD_S)
FILES_PER_CHUNK = 1000
CACHE_BYTES = 2 * 1024**3  # of images that are kept decoded
INFO, STATS, TASKS, RECORD = (
    "meta/info.json", "meta/stats.json", "meta/tasks.parquet", "meta/falconwing.json",
)  # fmt: skip
DATA = "data/chunk-{chunk:03d}/file-{file:03d}.parquet"
EPISODES = "meta/episodes/chunk-{chunk:03d}/file-{file:03d}.parquet"
TASK_TEXTS = {"landing": "land on the pad", "follow": "follow the leader"}
COMMANDS = ("throttle", "aileron", "elevator", "rudder")
IMAGE, MASK = "observation.images.nose", "leader_mask"
VECTORS = {  # columns of float32, and the names of their numbers
    "observation.state": (
        *(f"last_{name}" for name in COMMANDS),
        "camera_x",
        "camera_y",
        "camera_z",
    ),
    "action": COMMANDS,
    "teacher": COMMANDS,
    "auxiliary": tuple(f"auxiliary_{k}" for k in range(AUXILIARY)),
    "camera_pose": tuple(
        f"T_world_camera_{row}{column}" for row in range(3) for column in range(4)
    ),
}
SCALARS = {
    "next.done": "bool", "timestamp": "float32", "frame_index": "int64", "episode_index": "int64",
    "index": "int64", "task_index": "int64",
}  # fmt: skip
Statistics = dict[str, dict[str, Array]]


@dataclass(frozen=True)
class DatasetRecord:
    """What a dataset was collected for; stored in meta/falconwing.json."""

    task: str  # "landing" or "follow"
    width: int  # of the images [px]
    height: int
    focal: float  # of the camera, in image widths
    flights: int  # in all, when the collection is complete
    options: dict[str, Any]  # of the collection
    version: int = OWN_VERSION


@dataclass(frozen=True, eq=False)
class Episode:
    """One flight and what a dataset keeps beside it."""

    flown: Flown
    Ts_world_camera: Array  # (T, 4, 4)
    seed: int
    outcome: dict[str, Any]  # `contact`, and `landed` or `success`


def begin_dataset(folder: Path, record: DatasetRecord) -> int:
    """Begin a dataset in a folder, or go on with the one that it holds.

    Returns:
        Number of flights that it holds.

    Raises:
        InputError: the folder holds other files, or a dataset of other options.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--out {folder}: expected a folder, got a file; choose another name")
    if (folder / RECORD).is_file():
        before, now = read_record(folder), DatasetRecord(**json.loads(json.dumps(asdict(record))))
        changed = [name for name in asdict(now) if getattr(before, name) != getattr(now, name)]
        if changed:
            raise InputError(
                f"--out {short_name(folder)}: expected an empty folder or a dataset of these"
                f" options, got one of other {_differing(before, now, changed[0])}; take another"
                " folder"
            )
        if (folder / INFO).is_file():
            return int(_read_info(folder)["total_episodes"])
    elif folder.is_dir() and any(folder.iterdir()):
        raise InputError(
            f"--out {short_name(folder)}: expected an empty folder or a dataset, got other files;"
            " take another folder"
        )
    for part in ("meta", "data"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    _write_json(folder / RECORD, asdict(record))
    _write_table(folder / TASKS, _tasks_table(TASK_TEXTS[record.task]))
    _write_info(folder, record, episodes=0, frames=0)
    return 0


def append_episodes(folder: Path, episodes: Sequence[Episode]) -> None:
    """Write the next file of a dataset: flights that follow those that it holds.

    Raises:
        InputError: the disk is full, or the folder may not be written.
    """
    record, info = read_record(folder), _read_info(folder)
    first, frames = int(info["total_episodes"]), int(info["total_frames"])
    rows = _episode_rows(folder, first)
    number = 1 + max((_file_number(row, "data") for row in rows), default=-1)
    chunk, file = divmod(number, FILES_PER_CHUNK)
    parts, described, index = [], [], frames
    for k, episode in enumerate(episodes):
        columns = _columns(episode, first + k, index)
        parts.append(pa.table(_arrow_columns(columns), schema=_schema(record)))
        place = {"chunk": chunk, "file": file, "from": index}
        index += len(columns["index"])
        described.append(_describe(episode, first + k, record, columns, place))
    _write_table(folder / DATA.format(chunk=chunk, file=file), *parts)
    _write_table(folder / EPISODES.format(chunk=chunk, file=file), pa.Table.from_pylist(described))
    _write_info(folder, record, episodes=first + len(episodes), frames=index)
    write_stats(folder)


def write_stats(folder: Path) -> None:
    """Remake meta/stats.json from the statistics of all flights."""
    rows = _episode_rows(folder, int(_read_info(folder)["total_episodes"]))
    if not rows:
        return
    found: dict[str, dict[str, Any]] = {}
    for name in sorted({key.split("/")[1] for key in rows[0] if key.startswith("stats/")}):
        each = {
            kind: np.array([row[f"stats/{name}/{kind}"] for row in rows], np.float64)
            for kind in ("min", "max", "mean", "std", "count")
        }
        found[name] = {kind: x.tolist() for kind, x in _pool(each).items()}
        found[name]["count"] = [int(each["count"].sum())]
    _write_json(folder / STATS, found)


class Dataset(Sequence[Flown]):
    """The flights of a dataset, read from the disk as they are used."""

    def __init__(self, folder: str | Path) -> None:
        """Open a folder and check that it is whole.

        Raises:
            FileNotFoundError: there is no dataset.
            InputError: it is of another version, cut short, or not complete yet.
        """
        self.folder = Path(folder)
        self.record, info = read_record(self.folder), _read_info(self.folder)
        self.episodes = _episode_rows(self.folder, int(info["total_episodes"]))
        if len(self.episodes) < self.record.flights:
            raise InputError(
                f"{short_name(self.folder)}: expected a dataset of {self.record.flights} flights,"
                f" got the first {len(self.episodes)}; give the same falconwing collect again,"
                " which goes on"
            )
        self._files: dict[int, Path] = {}
        self._groups: list[int] = []  # row group of each flight in its file
        self._cache: OrderedDict[int, Flown] = OrderedDict()
        self._cached_bytes = 0
        self._check_files()

    def __len__(self) -> int:
        """Number of flights."""
        return len(self.episodes)

    @overload
    def __getitem__(self, k: int) -> Flown: ...
    @overload
    def __getitem__(self, k: slice) -> list[Flown]: ...
    def __getitem__(self, k: int | slice) -> Flown | list[Flown]:
        """A flight."""
        if isinstance(k, slice):
            return [self[i] for i in range(*k.indices(len(self)))]
        if not -len(self) <= k < len(self):
            raise IndexError(k)
        k = int(k) % len(self)
        if k not in self._cache:
            self._cache[k] = flown = self._read(k).flown
            self._cached_bytes += _image_bytes(flown)
            while self._cached_bytes > CACHE_BYTES and len(self._cache) > 1:
                self._cached_bytes -= _image_bytes(self._cache.popitem(last=False)[1])
        self._cache.move_to_end(k)
        return self._cache[k]

    @property
    def frames(self) -> int:
        """Number of images."""
        return sum(int(row["length"]) for row in self.episodes)

    def read_episodes(self) -> Iterator[Episode]:
        """Every flight with what is kept beside it."""
        for k in range(len(self)):
            yield self._read(k)

    def _check_files(self) -> None:
        """InputError unless each file holds the rows that the flights need, in order."""
        in_file: dict[int, list[int]] = {}
        for row in self.episodes:
            lengths = in_file.setdefault(_file_number(row, "data"), [])
            self._groups.append(len(lengths))
            lengths.append(int(row["length"]))
        for number, lengths in in_file.items():
            path = self.folder / _numbered(DATA, number)
            with _open_parquet(path) as file:
                meta = file.metadata
                groups = [meta.row_group(k).num_rows for k in range(meta.num_row_groups)]
                expected = _schema(self.record)
                if not file.schema_arrow.equals(expected):
                    raise _damaged(path)
            if groups != lengths:
                raise _damaged(path)
            self._files[number] = path

    def _read(self, k: int) -> Episode:
        """A flight from the disk."""
        row = self.episodes[k]
        path = self._files[_file_number(row, "data")]
        try:
            with _open_parquet(path) as file:
                table = file.read_row_group(self._groups[k])
            found = {
                name: np.array(table[name].combine_chunks().flatten(), np.float64).reshape(
                    len(table), len(parts)
                )
                for name, parts in VECTORS.items()
            }
            size = (self.record.width, self.record.height)
            images = torch.from_numpy(_decode(table[IMAGE], "RGB", size)).permute(0, 3, 1, 2)
            masks = None
            if MASK in table.column_names:
                masks = torch.from_numpy(_decode(table[MASK], "L", size))
            is_whole = all(np.isfinite(values).all() for values in found.values())
            is_whole &= set(table["episode_index"].to_pylist()) == {k}
        except InputError:
            raise
        except Exception:  # damaged pages and images fail in many ways
            is_whole = False
        if not is_whole:
            raise _damaged(path)
        Ts_world_camera = np.tile(np.eye(4), (len(images), 1, 1))
        Ts_world_camera[:, :3] = found["camera_pose"].reshape(-1, 3, 4)
        flown = Flown(
            images.contiguous(), masks, found["action"], found["teacher"], found["auxiliary"],
            found["observation.state"][0, len(COMMANDS) :],
        )  # fmt: skip
        return Episode(flown, Ts_world_camera, int(row["seed"]), json.loads(row["outcome"]))


def read_record(folder: Path) -> DatasetRecord:
    """What a dataset was collected for.

    Raises:
        FileNotFoundError: there is no dataset in the folder.
        InputError: its record is damaged or of another version.
    """
    path = Path(folder) / RECORD
    if not path.is_file():
        raise FileNotFoundError(
            f"{folder}: expected a dataset of falconwing collect, found no {RECORD} there; check"
            " the path"
        )
    try:
        values = json.loads(read_text(path))
        record = DatasetRecord(**values)
        numbers = (record.width, record.height, record.flights)
        is_one = record.task in TASK_TEXTS and all(isinstance(n, int) for n in numbers)
    except (ValueError, TypeError):
        raise InputError(
            f"{short_name(path)}: expected the record of a dataset, got a damaged file; collect it"
            " again"
        ) from None
    if record.version != OWN_VERSION or not is_one:
        raise InputError(
            f"{short_name(path)}: expected a dataset of version {OWN_VERSION}, got"
            f" {record.version!r}; collect it again with this version of the kit"
        )
    return record


def _read_info(folder: Path) -> dict[str, Any]:
    """meta/info.json, of the version that is read here."""
    path = folder / INFO
    try:
        info = json.loads(read_text(path))
        version, counts = info["codebase_version"], (info["total_episodes"], info["total_frames"])
        if not all(isinstance(count, int) for count in counts):
            raise TypeError
    except (ValueError, KeyError, TypeError):
        raise InputError(
            f"{short_name(path)}: expected the description of a LeRobot dataset, got a damaged"
            " file; collect it again"
        ) from None
    if version != VERSION:
        raise InputError(
            f"{short_name(path)}: expected LeRobot's dataset format {VERSION}, got {version!r};"
            " collect it again, or convert it with LeRobot"
        )
    return dict(info)


def _episode_rows(folder: Path, count: int) -> list[dict[str, Any]]:
    """The rows of the first `count` flights; InputError if there are fewer."""
    rows: list[dict[str, Any]] = []
    number = 0
    while len(rows) < count:
        path = folder / _numbered(EPISODES, number)
        try:
            with _open_parquet(path) as file:
                more = file.read().to_pylist()
            whole = [row["episode_index"] for row in more] == list(
                range(len(rows), len(rows) + len(more))
            )
            for row in more:
                _file_number(row, "data"), int(row["length"]), int(row["seed"])
        except (KeyError, TypeError, ValueError, pa.ArrowException):
            whole = False
        if not whole or not more:
            raise _damaged(path)
        rows += more
        number += 1
    return rows[:count]


def _columns(episode: Episode, number: int, first: int) -> dict[str, Any]:
    """The columns of a flight as arrays: (T, d) numbers, lists of PNG files, (T,) scalars."""
    flown = episode.flown
    T = len(flown.sent)
    last = np.concatenate([np.zeros((1, len(COMMANDS))), flown.sent])[:-1]
    mount = np.tile(flown.p_body_camera, (T, 1))
    step = np.arange(T)
    columns: dict[str, Any] = {IMAGE: flown.images.permute(0, 2, 3, 1).cpu().numpy()}
    if flown.masks is not None:
        columns[MASK] = flown.masks.cpu().numpy()[..., None]
    return columns | {
        "observation.state": np.hstack([last, mount]),
        "action": flown.sent,
        "teacher": flown.teacher,
        "auxiliary": flown.auxiliary,
        "camera_pose": episode.Ts_world_camera[:, :3].reshape(T, 12),
        "next.done": step == T - 1,
        "timestamp": step * CONTROL_PERIOD_S,
        "frame_index": step,
        "episode_index": np.full(T, number),
        "index": first + step,
        "task_index": np.zeros(T, np.int64),
    }


def _arrow_columns(columns: dict[str, Any]) -> dict[str, pa.Array]:
    """The columns as Arrow holds them."""
    found = {}
    for name, values in columns.items():
        if name in (IMAGE, MASK):
            found[name] = pa.array(
                [{"bytes": _png(image), "path": None} for image in values], _image_type()
            )
        elif name in VECTORS:
            flat = pa.array(np.asarray(values, np.float32).reshape(-1))
            found[name] = pa.FixedSizeListArray.from_arrays(flat, len(VECTORS[name]))
        else:
            found[name] = pa.array(values).cast(_scalar_type(SCALARS[name]))
    return found


def _describe(
    episode: Episode, number: int, record: DatasetRecord, columns: dict[str, Any],
    place: dict[str, int],
) -> dict[str, Any]:  # fmt: skip
    """The row of a flight in meta/episodes."""
    T = len(columns["index"])
    row: dict[str, Any] = {
        "episode_index": number, "tasks": [TASK_TEXTS[record.task]], "length": T,
        "dataset_from_index": place["from"], "dataset_to_index": place["from"] + T,
    }  # fmt: skip
    for part in ("data", "meta/episodes"):
        row |= {f"{part}/chunk_index": place["chunk"], f"{part}/file_index": place["file"]}
    success = episode.outcome.get("landed", episode.outcome.get("success", False))
    row |= {"seed": episode.seed, "success": bool(success)}
    row |= {"outcome": json.dumps(episode.outcome, default=float)}
    for name, values in columns.items():
        for kind, x in _statistics(values, is_image=name in (IMAGE, MASK)).items():
            row[f"stats/{name}/{kind}"] = x.tolist()
    return row


def _statistics(values: NDArray[Any], is_image: bool) -> dict[str, Array]:
    """min, max, mean and std over a flight, (d,) or (channels, 1, 1) in 0..1, and the count."""
    x = np.asarray(values, np.float64)
    if is_image:
        x = x / 255.0
        axes, shape = (0, 1, 2), (x.shape[-1], 1, 1)
    else:
        axes, shape = (0,), (-1,)  # type: ignore[assignment]
    parts = {"min": x.min(axes), "max": x.max(axes), "mean": x.mean(axes), "std": x.std(axes)}
    found = {kind: np.reshape(part, shape) for kind, part in parts.items()}
    return found | {"count": np.array([len(x)])}


def _pool(each: dict[str, Array]) -> dict[str, Array]:
    """Statistics of several parts together; the first axis is that of the parts.

    mean = sum n_i mean_i / n ; var = sum n_i (var_i + (mean_i - mean)^2) / n
    """
    n = each["count"].reshape(-1, *[1] * (each["mean"].ndim - 1))
    mean = (n * each["mean"]).sum(0) / n.sum()
    variance = (n * (each["std"] ** 2 + (each["mean"] - mean) ** 2)).sum(0) / n.sum()
    return {
        "min": each["min"].min(0), "max": each["max"].max(0), "mean": mean,
        "std": np.sqrt(variance),
    }  # fmt: skip


def _features(record: DatasetRecord) -> dict[str, dict[str, Any]]:
    """The columns as info.json describes them."""
    size = ["height", "width", "channels"]
    found: dict[str, dict[str, Any]] = {
        IMAGE: {"dtype": "image", "shape": [record.height, record.width, 3], "names": size}
    }
    if record.task == "follow":
        found[MASK] = {"dtype": "image", "shape": [record.height, record.width, 1], "names": size}
    for name, parts in VECTORS.items():
        found[name] = {"dtype": "float32", "shape": [len(parts)], "names": list(parts)}
    return found | {
        name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in SCALARS.items()
    }


def _schema(record: DatasetRecord) -> pa.Schema:
    """The columns as Parquet has them, with the Hugging Face description of their types."""
    fields: list[pa.Field] = []
    described: dict[str, dict[str, Any]] = {}
    for name, feature in _features(record).items():
        if feature["dtype"] == "image":
            kind = _image_type()
            described[name] = {"_type": "Image"}
        elif name in VECTORS:
            kind = pa.list_(pa.float32(), len(VECTORS[name]))
            described[name] = {"feature": {"dtype": "float32", "_type": "Value"},
                               "length": len(VECTORS[name]), "_type": "Sequence"}  # fmt: skip
        else:
            kind = _scalar_type(feature["dtype"])
            described[name] = {"dtype": feature["dtype"], "_type": "Value"}
        fields.append(pa.field(name, kind))
    return pa.schema(fields, {"huggingface": json.dumps({"info": {"features": described}})})


def _tasks_table(text: str) -> pa.Table:
    """The one task: its text is the index of the table, as pandas reads it."""
    table = pa.table({"task_index": pa.array([0], pa.int64()), "task": [text]})
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_type,
         "metadata": None}
        for name, kind, numpy_type in (
            ("task_index", "int64", "int64"), ("task", "unicode", "object"),
        )
    ]  # fmt: skip
    pandas = {"index_columns": ["task"], "column_indexes": [], "columns": columns}
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})


def _write_info(folder: Path, record: DatasetRecord, episodes: int, frames: int) -> None:
    data = DATA.replace("{chunk", "{chunk_index").replace("{file", "{file_index")
    _write_json(
        folder / INFO,
        {
            "codebase_version": VERSION, "robot_type": "falconwing (simulated)",
            "total_episodes": episodes, "total_frames": frames, "total_tasks": 1,
            "chunks_size": FILES_PER_CHUNK, "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200, "fps": FRAME_RATE_HZ,
            "splits": {"train": f"0:{episodes}"}, "data_path": data, "video_path": None,
            "features": _features(record),
        },
    )  # fmt: skip


def _write_json(path: Path, values: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path, text=True) as file:
        json.dump(values, file, indent=1, default=str)


def _write_table(path: Path, *parts: pa.Table) -> None:
    """Write tables of one schema as row groups of one file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with (
        atomic_write(path) as file,
        pq.ParquetWriter(file, parts[0].schema, write_page_checksum=True) as writer,
    ):
        for part in parts:
            writer.write_table(part, row_group_size=max(len(part), 1))


def _open_parquet(path: Path) -> pq.ParquetFile:
    """A Parquet file; InputError for a missing or damaged one."""
    try:
        return pq.ParquetFile(path, page_checksum_verification=True)
    except (OSError, pa.ArrowException):
        raise _damaged(path) from None


def _damaged(path: Path) -> InputError:
    got = "a file that is damaged or cut short" if path.is_file() else "none"
    return InputError(
        f"{short_name(path)}: expected a whole file of the dataset, got {got}; copy the dataset"
        " again, or collect it again into another folder"
    )


def _differing(before: DatasetRecord, now: DatasetRecord, name: str) -> str:
    """The name of an option in which two records differ."""
    if name != "options":
        return name
    keys = {*before.options, *now.options}
    return next(key for key in sorted(keys) if before.options.get(key) != now.options.get(key))


def _numbered(pattern: str, number: int) -> str:
    chunk, file = divmod(number, FILES_PER_CHUNK)
    return pattern.format(chunk=chunk, file=file)


def _file_number(row: dict[str, Any], part: str) -> int:
    return int(FILES_PER_CHUNK * row[f"{part}/chunk_index"] + row[f"{part}/file_index"])


def _image_type() -> pa.StructType:
    return pa.struct([("bytes", pa.binary()), ("path", pa.string())])


def _scalar_type(dtype: str) -> pa.DataType:
    return {"bool": pa.bool_(), "float32": pa.float32(), "int64": pa.int64()}[dtype]


def _png(image: NDArray[np.uint8]) -> bytes:
    """The PNG file of an image (h, w, 3) or mask (h, w, 1)."""
    buffer = io.BytesIO()
    pixels = image[..., 0] if image.shape[-1] == 1 else image
    Image.fromarray(np.ascontiguousarray(pixels)).save(buffer, "PNG", compress_level=1)
    return buffer.getvalue()


def _decode(column: pa.ChunkedArray, mode: str, size: tuple[int, int]) -> NDArray[np.uint8]:
    """The images (T, h, w, 3) or masks (T, h, w) of a column; ValueError for another size."""
    images = []
    for cell in column.to_pylist():
        with Image.open(io.BytesIO(cell["bytes"])) as image:
            if image.size != size or image.mode != mode:
                raise ValueError
            images.append(np.asarray(image))
    return np.stack(images)


def _image_bytes(flown: Flown) -> int:
    return flown.images.numel()
