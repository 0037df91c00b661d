"""Gaussian scene: arrays or a file -> a checked set of Gaussians; save, select and join them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.metadata import EntryPoints, entry_points
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import require_size, short_name
from falconwing_kit.scene.native import read_native, write_native
from falconwing_kit.scene.ply import read_ply, write_ply
from falconwing_kit.scene.sh import SH_COUNTS, Array32

Labels = NDArray[np.uint8]
Scenes = tuple["GaussianScene", ...]
Images = tuple[Array32, Array32, Array32]  # of a renderer: colour, not cut at 1, alpha and depth

READERS: dict[str, Callable[[Path], dict[str, Any]]] = {".ply": read_ply, ".npz": read_native}
MAX_LABELS = 256
MAX_SCENE_BYTES = 2 * 1024**3  # eight million Gaussians of a .ply with all its harmonics
UNIT_TOLERANCE = 1e-6  # a quaternion whose length is nearer to 1 keeps its bits
MIN_LENGTH = 1e-12  # a shorter quaternion has no direction


@dataclass(frozen=True, eq=False)
class GaussianScene:
    """A scene of N coloured Gaussians [Kerbl et al. 2023, 3D Gaussian Splatting, eq. 4 and 6].

    G(x) = exp(-1/2 (x - mean)^T Sigma^-1 (x - mean)),  Sigma = R S S R^T,  S = diag(scales)
    rgb(d) = 1/2 + sum_k sh[k] Y_k(d), d from the camera to the mean, Y_0 = 0.2821

    R is the rotation of the quaternion, which is normalised; all else is checked, not corrected.

    Raises:
        InputError: shapes do not fit, a number is not finite, or a value is out of its range.
    """

    means: Array32  # (N, 3) world [m]
    quaternions: Array32  # (N, 4) w x y z, from the Gaussian's principal axes to world axes
    scales: Array32  # (N, 3) standard deviations along the principal axes [m], > 0
    opacities: Array32  # (N,) at the mean, 0..1
    sh: Array32  # (N, K, 3) colour coefficients of red, green, blue; K = 1, 4, 9 or 16
    # (N,) index into label_names; empty: all 0
    labels: Labels = field(default_factory=lambda: np.zeros(0, np.uint8))
    label_names: tuple[str, ...] = ("scene",)
    source: str = ""  # origin, with the credit that its licence requires
    # named points (3,) of one asset [m]: nose, tail ...
    points: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check and convert every field."""
        means = _require_floats("means", self.means, (None, 3))
        if len(means) == 0:
            raise InputError(
                "scene: expected at least one Gaussian, got none; check the file or the selection"
            )
        row_shapes = {"means": (3,), "quaternions": (4,), "scales": (3,), "opacities": ()}
        for name, shape in (row_shapes | {"sh": (None, 3)}).items():
            array = _require_floats(name, getattr(self, name), (len(means), *shape))
            object.__setattr__(self, name, array)
        if self.sh.shape[1] not in SH_COUNTS:
            got = self.sh.shape[1]
            raise InputError(
                f"sh: expected 1, 4, 9 or 16 coefficients (degree 0 to 3), got {got};"
                " cut it to such a degree"
            )
        opacities = self.opacities
        _require_all_gaussians("scales", self.scales > 0.0, "numbers > 0 (metres, not logarithms)")
        in_range = (opacities >= 0.0) & (opacities <= 1.0)
        _require_all_gaussians("opacities", in_range, "numbers in 0..1 (not logits)")
        object.__setattr__(self, "quaternions", _normalise(self.quaternions))
        object.__setattr__(self, "label_names", _require_names(self.label_names))
        labels = _require_labels(self.labels, len(means), len(self.label_names))
        object.__setattr__(self, "labels", labels)
        points = {
            name: _require_floats(f"point {name}", [point], (1, 3))[0]
            for name, point in self.points.items()
        }
        object.__setattr__(self, "points", points)

    def __len__(self) -> int:
        return len(self.means)

    @classmethod
    def load(cls, path: str | Path) -> "GaussianScene":
        """Read a scene: .ply (3DGS or compressed), .splat, .spz, .sog or SOG's folder, or .npz.

        All formats of one scene give the same coordinates, those of its .ply. Where a format holds
        neither labels nor source, all labels are 0 and the source is the file's name.

        Raises:
            FileNotFoundError: there is no file.
            InputError: the file is too large, damaged, of another kind, or holds no Gaussians.
        """
        path = Path(path)
        in_folder = path.is_dir() or path.name == "meta.json"
        read = _reader(".sog" if in_folder else path.suffix.lower())
        if read is None:
            endings = ", ".join((*READERS, *sorted(_more_readers().names)))
            raise InputError(
                f"{short_name(path)}: expected a scene ending in {endings} or a SOG folder,"
                " got another ending"
            )
        if path.is_file():  # not the folder of an SOG
            advice = "thin it with the program that trained it"
            require_size(path, MAX_SCENE_BYTES, "a scene", advice)
        fields = {"source": short_name(path)} | read(path)
        try:
            return cls(**fields)
        except InputError as error:
            raise InputError(f"{short_name(path)}: {error}") from None

    def save(self, path: str | Path) -> None:
        """Write a scene completely or not at all.

        Args:
            path: ends in .npz, which keeps every bit of every field, or in .ply, which every other
                tool reads and which keeps neither labels nor named points.

        Raises:
            InputError: another ending, or the file cannot be written.
            FileNotFoundError: the folder does not exist.
        """
        writers = {".npz": write_native, ".ply": write_ply}
        write = writers.get(Path(path).suffix.lower())
        if write is None:
            raise InputError(
                f"{short_name(path)}: expected a name ending in .npz or .ply for a scene,"
                " got another ending"
            )
        write(path, vars(self))

    def labelled(self, *names: str) -> NDArray[np.bool_]:
        """(N,) True for the Gaussians with one of the labels.

        Raises:
            InputError: the scene has no label of that name.
        """
        for name in names:
            if name not in self.label_names:
                expected = ", ".join(self.label_names)
                raise InputError(f"label: expected one of {expected}, got {name!r}")
        return np.isin(self.labels, [self.label_names.index(name) for name in names])

    def selected(self, mask: ArrayLike) -> "GaussianScene":
        """The Gaussians where the mask (N,) is True, in their order.

        Raises:
            InputError: the mask is not (N,) of bool, or selects none.
        """
        chosen = np.asarray(mask)
        if chosen.dtype != np.bool_ or chosen.shape != (len(self),):
            got = f"{chosen.shape} of {chosen.dtype}"
            raise InputError(f"mask: expected ({len(self)},) of True and False, got {got}")
        if not chosen.any():
            raise InputError(
                "mask: expected at least one Gaussian to stay, got none; a scene cannot be empty"
            )
        names = ("means", "quaternions", "scales", "opacities", "sh", "labels")
        rows = {name: getattr(self, name).compress(chosen, axis=0) for name in names}
        return replace(self, **rows)

    @classmethod
    def joined(cls, *scenes: "GaussianScene") -> "GaussianScene":
        """Several scenes in the same coordinates as one.

        Labels of the same name become one, and colours of a lower degree are padded with zeros.
        Named points belong to one asset and are dropped.

        Raises:
            InputError: no scenes, or more than 256 different labels.
        """
        if not scenes:
            raise InputError("scenes: expected at least one scene to join, got none")
        names = tuple(dict.fromkeys(name for scene in scenes for name in scene.label_names))
        _require_names(names)  # at most 256 fit into the uint8 of the next lines
        new_labels = [
            np.array([names.index(name) for name in scene.label_names], np.uint8)[scene.labels]
            for scene in scenes
        ]
        count = max(scene.sh.shape[1] for scene in scenes)
        padded_sh = [
            np.pad(scene.sh, ((0, 0), (0, count - scene.sh.shape[1]), (0, 0))) for scene in scenes
        ]
        stacked: dict[str, Any] = {
            name: np.concatenate([getattr(scene, name) for scene in scenes])
            for name in ("means", "quaternions", "scales", "opacities")
        }
        return cls(
            **stacked,
            sh=np.concatenate(padded_sh),
            labels=np.concatenate(new_labels),
            label_names=names,
            source="; ".join(dict.fromkeys(scene.source for scene in scenes if scene.source)),
        )


@cache  # a search through all installed packages
def _more_readers() -> EntryPoints:
    """Readers offered by installed packages; the kit's toolbox offers .splat, .spz and .sog."""
    return entry_points(group="falconwing_kit.scene_readers")


def _reader(suffix: str) -> Callable[[Path], dict[str, Any]] | None:
    """The function that reads files with this ending; None if there is none."""
    if suffix in READERS:
        return READERS[suffix]
    offered = (point for point in _more_readers() if point.name == suffix)
    return next((point.load() for point in offered), None)


def _require_floats(name: str, values: ArrayLike, shape: tuple[int | None, ...]) -> Array32:
    """The array as float32, finite and of the shape, where None is any length."""
    expected = str(shape).replace("None", "any")
    try:
        with np.errstate(over="ignore"):
            array = np.ascontiguousarray(values, dtype=np.float32)
    except (TypeError, ValueError):
        raise InputError(f"{name}: expected an array of numbers of shape {expected}") from None
    if array.ndim != len(shape) or any(
        side not in (None, got) for side, got in zip(shape, array.shape, strict=True)
    ):
        raise InputError(
            f"{name}: expected shape {expected}, one row for each of the means, got {array.shape}"
        )
    _require_all_gaussians(name, np.isfinite(array), "finite numbers")
    return array


def _require_all_gaussians(name: str, good: NDArray[np.bool_], expected: str) -> None:
    """InputError with the number of rows that are not good in every column."""
    if good.all():
        return
    bad = len(good) - np.count_nonzero(good.all(axis=tuple(range(1, good.ndim))))
    raise InputError(
        f"{name}: expected {expected}, got others in {bad} of {len(good)} Gaussians;"
        " repair or remove those"
    )


def _normalise(quaternions: Array32) -> Array32:
    """Quaternions of length 1; those of length 1 already keep their bits."""
    if (np.abs(np.einsum("ij,ij->i", quaternions, quaternions) - 1.0) < UNIT_TOLERANCE).all():
        return quaternions  # true of most files, and ten times as fast
    length = np.linalg.norm(quaternions.astype(np.float64), axis=1, keepdims=True)
    _require_all_gaussians("quaternions", length > MIN_LENGTH, "rotations other than 0, 0, 0, 0")
    unit = np.where(np.abs(length - 1.0) < UNIT_TOLERANCE, quaternions, quaternions / length)
    return unit.astype(np.float32)


def _require_names(label_names: tuple[str, ...]) -> tuple[str, ...]:
    """The names of labels as a tuple of 1 to 256 different words."""
    names = tuple(label_names)
    are_words = all(isinstance(name, str) and name for name in names)
    if not 0 < len(names) <= MAX_LABELS or not are_words:
        raise InputError(
            f"label_names: expected 1 to {MAX_LABELS} words that are not empty, got {len(names)}"
        )
    if len(set(names)) != len(names):
        raise InputError("label_names: expected every name once; give two labels two names")
    return names


def _require_labels(labels: ArrayLike, count: int, name_count: int) -> Labels:
    """The labels as (N,) uint8, zeros where there are none."""
    indices = np.asarray(labels)
    if indices.size == 0:
        return np.zeros(count, np.uint8)
    if indices.shape != (count,) or indices.dtype.kind not in "ui":
        got = f"{indices.shape} of {indices.dtype}"
        raise InputError(f"labels: expected ({count},) whole numbers, got {got}")
    low, high = indices.min(), indices.max()
    if low < 0 or high >= name_count:
        raise InputError(
            f"labels: expected 0 to {name_count - 1}, indices of label_names, got {low} to {high}"
        )
    return indices.astype(np.uint8)
