"""Gaussian scene: arrays or a file -> a checked set of Gaussians; save, select and join them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from importlib.metadata import EntryPoints, entry_points
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.files import short_name
from falconwing_kit.scene.native import read_native, write_native
from falconwing_kit.scene.ply import SH_COUNTS, Array32, read_ply, write_ply

Labels = NDArray[np.uint8]

READERS: dict[str, Callable[[Path], dict[str, Any]]] = {
    ".ply": read_ply,
    ".npz": read_native,
}
MAX_LABELS = 256


@dataclass(frozen=True, eq=False)
class GaussianScene:
    """A scene as N coloured clouds [Kerbl et al. 2023, 3D Gaussian Splatting, eq. 4 and 6].

    G(x) = exp(-1/2 (x - mean)^T Sigma^-1 (x - mean)),  Sigma = R S S R^T,  R from the quaternion, S
    = diag(scales) rgb(d) = 1/2 + sum_k sh[k] Y_k(d), d from the camera to the mean, Y_0 = 0.2821

    Quaternions are brought to length 1; everything else must be right as it comes.

    Raises:
        InputError: shapes do not fit, a number is not finite, or a value is out of its range.
    """

    means: Array32  # (N, 3) world [m]
    quaternions: Array32  # (N, 4) w x y z, turn the cloud's axes into world axes
    scales: Array32  # (N, 3) standard deviations along the cloud's axes [m], > 0
    opacities: Array32  # (N,) at the mean, 0..1
    sh: Array32  # (N, K, 3) colour coefficients of red, green, blue; K = 1, 4, 9 or 16
    labels: Labels = field(
        default_factory=lambda: np.zeros(0, np.uint8)
    )  # (N,) numbers of names; empty: all 0
    label_names: tuple[str, ...] = ("scene",)  # what each label is called
    source: str = ""  # where it came from, with the credit that its licence asks for
    points: Mapping[str, NDArray[Any]] = field(
        default_factory=dict
    )  # named places of one asset (3,) [m]: nose, tail ...

    def __post_init__(self) -> None:
        """Check and convert every field."""
        means = _floats("means", self.means, (None, 3))
        if len(means) == 0:
            raise InputError(
                "scene: expected at least one Gaussian, got none; check the file or the selection"
            )
        shapes = {
            "means": (3,),
            "quaternions": (4,),
            "scales": (3,),
            "opacities": (),
            "sh": (None, 3),
        }
        for name, shape in shapes.items():
            object.__setattr__(self, name, _floats(name, getattr(self, name), (len(means), *shape)))
        if self.sh.shape[1] not in SH_COUNTS:
            got = self.sh.shape[1]
            raise InputError(
                f"sh: expected 1, 4, 9 or 16 coefficients (degree 0 to 3), got {got}; cut it to such a degree"
            )
        _require_each("scales", self.scales > 0.0, "numbers > 0 (metres, not logarithms)")
        _require_each(
            "opacities",
            (self.opacities >= 0.0) & (self.opacities <= 1.0),
            "numbers in 0..1 (not logits)",
        )
        object.__setattr__(self, "quaternions", _unit(self.quaternions))
        object.__setattr__(self, "label_names", _names(self.label_names))
        object.__setattr__(self, "labels", _labels(self.labels, len(means), len(self.label_names)))
        points = {
            name: _floats(f"point {name}", [place], (1, 3))[0]
            for name, place in self.points.items()
        }
        object.__setattr__(self, "points", points)

    def __len__(self) -> int:
        return len(self.means)

    @classmethod
    def load(cls, path: str | Path) -> "GaussianScene":
        """Read a scene: .ply (3DGS or compressed), .splat, .spz, .sog, a folder with SOG's
        meta.json, or .npz.

        Every format gives the coordinates that a .ply of the same scene has; SPZ, which keeps other
        axes, is turned.

        Args:
            path: the file or folder; the ending says which format it is.

        Returns:
            The scene; all labels are 0 and the source is the file's name where the format holds
            neither.

        Raises:
            FileNotFoundError: there is no file.
            InputError: the file is damaged or of another kind, or holds something else than
                Gaussians.
        """
        path = Path(path)
        in_folder = path.is_dir() or path.name == "meta.json"
        read = _reader(".sog" if in_folder else path.suffix.lower())
        if read is None:
            kinds = ", ".join((*READERS, *_more_readers().names))
            raise InputError(
                f"{short_name(path)}: expected a scene ending in {kinds} or a SOG folder, got another ending"
            )
        fields = {"source": short_name(path)} | read(path)
        try:
            return cls(**fields)
        except InputError as error:
            raise InputError(f"{short_name(path)}: {error}") from None

    def save(self, path: str | Path) -> None:
        """Write a scene whole or not at all.

        Args:
            path: a file ending in .npz, which keeps everything to the last bit, or in
                .ply, which every other tool reads, and which keeps neither labels nor named points.

        Raises:
            InputError: another ending, or the place cannot be written.
            FileNotFoundError: the folder does not exist.
        """
        arrays = (self.means, self.quaternions, self.scales, self.opacities, self.sh)
        suffix = Path(path).suffix.lower()
        if suffix == ".npz":
            write_native(path, *arrays, self.labels, self.label_names, self.source, self.points)
        elif suffix == ".ply":
            write_ply(path, *arrays, self.source)
        else:
            raise InputError(
                f"{short_name(path)}: expected a name ending in .npz or .ply for a scene, got another ending"
            )

    def labelled(self, *names: str) -> NDArray[np.bool_]:
        """(N,) True for the Gaussians that carry one of the labels.

        Raises:
            InputError: the scene has no label of that name.
        """
        for name in names:
            if name not in self.label_names:
                raise InputError(
                    f"label: expected one of {', '.join(self.label_names)}, got {name!r}"
                )
        return np.isin(self.labels, [self.label_names.index(name) for name in names])

    def selected(self, mask: ArrayLike) -> "GaussianScene":
        """The Gaussians under a mask, in their order.

        Args:
            mask: (N,) True for those that stay.

        Raises:
            InputError: the mask is not (N,) of bool, or nothing stays.
        """
        chosen = np.asarray(mask)
        if chosen.dtype != np.bool_ or chosen.shape != (len(self),):
            raise InputError(
                f"mask: expected ({len(self)},) of True and False, got {chosen.shape} of {chosen.dtype}"
            )
        names = ("means", "quaternions", "scales", "opacities", "sh", "labels")
        if not chosen.any():
            raise InputError(
                "mask: expected at least one Gaussian to stay, got none; a scene cannot be empty"
            )
        return replace(
            self, **{name: getattr(self, name).compress(chosen, axis=0) for name in names}
        )

    @classmethod
    def joined(cls, *scenes: "GaussianScene") -> "GaussianScene":
        """Several scenes in the same coordinates as one.

        Labels of the same name become one; colours of a lower degree get zeros for what they lack.
        Named points are those of one asset and do not go along: keep the asset's own.

        Raises:
            InputError: no scenes, or more than 256 different labels.
        """
        if not scenes:
            raise InputError("scenes: expected at least one scene to join, got none")
        names = tuple(dict.fromkeys(name for scene in scenes for name in scene.label_names))
        _names(names)  # before the numbers, which would not fit
        numbers = [
            np.array([names.index(name) for name in scene.label_names], np.uint8)
            for scene in scenes
        ]
        basis = max(scene.sh.shape[1] for scene in scenes)
        stacked: dict[str, Any] = {
            name: np.concatenate([getattr(scene, name) for scene in scenes])
            for name in ("means", "quaternions", "scales", "opacities")
        }
        return cls(
            **stacked,
            sh=np.concatenate(
                [np.pad(s.sh, ((0, 0), (0, basis - s.sh.shape[1]), (0, 0))) for s in scenes]
            ),
            labels=np.concatenate(
                [table[scene.labels] for table, scene in zip(numbers, scenes, strict=True)]
            ),
            label_names=names,
            source="; ".join(dict.fromkeys(scene.source for scene in scenes if scene.source)),
        )


def _more_readers() -> EntryPoints:
    """Readers of further formats that installed packages offer; the kit's own toolbox offers
    .splat, .spz and .sog.
    """
    return entry_points(group="falconwing_kit.scene_readers")


def _reader(suffix: str) -> Callable[[Path], dict[str, Any]] | None:
    """The function that reads files with this ending; None if there is none."""
    offered = next((point.load for point in _more_readers() if point.name == suffix), lambda: None)
    return READERS.get(suffix) or offered()


def _floats(name: str, values: ArrayLike, shape: tuple[int | None, ...]) -> Array32:
    """The array as float32, finite and of the shape."""
    wanted = str(shape).replace("None", "any")
    try:
        with np.errstate(over="ignore"):
            array = np.ascontiguousarray(values, dtype=np.float32)
    except (TypeError, ValueError):
        raise InputError(f"{name}: expected an array of numbers of shape {wanted}") from None
    if array.ndim != len(shape) or any(
        want not in (None, got) for want, got in zip(shape, array.shape, strict=True)
    ):
        raise InputError(
            f"{name}: expected shape {wanted}, one row for each of the means, got {array.shape}"
        )
    _require_each(name, np.isfinite(array), "finite numbers")
    return array


def _require_each(name: str, good: NDArray[np.bool_], what: str) -> None:
    """Refuse where a row is not good in all of its numbers."""
    if good.all():
        return
    bad = len(good) - np.count_nonzero(good.all(axis=tuple(range(1, good.ndim))))
    raise InputError(
        f"{name}: expected {what}, got others in {bad} of {len(good)} Gaussians; repair or remove those"
    )


def _unit(quaternions: Array32) -> Array32:
    """Quaternions of length 1; those that are so already keep their bits."""
    if (np.abs(np.einsum("ij,ij->i", quaternions, quaternions) - 1.0) < 1e-6).all():
        return quaternions  # the usual case, in a tenth of the time
    length = np.linalg.norm(quaternions.astype(np.float64), axis=1, keepdims=True)
    _require_each("quaternions", length > 1e-12, "rotations other than 0, 0, 0, 0")
    return np.where(np.abs(length - 1.0) < 1e-6, quaternions, quaternions / length).astype(
        np.float32
    )


def _names(label_names: tuple[str, ...]) -> tuple[str, ...]:
    """The names of labels as a tuple, each once."""
    names = tuple(label_names)
    if not 0 < len(names) <= MAX_LABELS or not all(
        isinstance(name, str) and name for name in names
    ):
        raise InputError(
            f"label_names: expected 1 to {MAX_LABELS} words, got {len(names)}, of which each must be one"
        )
    if len(set(names)) != len(names):
        raise InputError(
            "label_names: expected every name once; give two kinds of things two names"
        )
    return names


def _labels(labels: ArrayLike, count: int, kinds: int) -> Labels:
    """The labels as numbers of names."""
    numbers = np.asarray(labels)
    if numbers.size == 0:
        return np.zeros(count, np.uint8)
    if numbers.shape != (count,) or numbers.dtype.kind not in "ui":
        raise InputError(
            f"labels: expected ({count},) whole numbers, got {numbers.shape} of {numbers.dtype}"
        )
    if numbers.min() < 0 or numbers.max() >= kinds:
        raise InputError(
            f"labels: expected 0 to {kinds - 1}, numbers of the label names, got {numbers.min()} to {numbers.max()}"
        )
    return numbers.astype(np.uint8)
