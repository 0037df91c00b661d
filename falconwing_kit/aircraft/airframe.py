"""Airframe: a TOML file with units in its keys -> one frozen record in SI units."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.config import from_toml
from falconwing_kit.core.files import shipped_path, short_name

Point = tuple[float, float, float]
WHEEL_NAMES = ("main_left", "main_right", "tail")


@dataclass(frozen=True)
class AirframePart:
    """One weighed part."""

    name: str
    mass: float  # [kg]
    inside: str = ""  # the part whose mass includes this one

    def __post_init__(self) -> None:
        _require_positive(self, "mass", of=f" of {self.name!r}")


@dataclass(frozen=True)
class Aero:
    """Coefficients of the whole aircraft: CL = CL0 + CLa alpha, CD = CD0 + k CL^2."""

    CL_max: float  # lift coefficient at minimum speed
    CL0: float
    CLa: float  # [1/rad]
    CD0: float
    k: float

    def __post_init__(self) -> None:
        _require_positive(self, "CL_max", "CLa", "CD0", "k")
        require_range("CL0", self.CL0)


@dataclass(frozen=True)
class Wheels:
    """Contact points of the tyres, in body axes [m]."""

    main_left: Point
    main_right: Point
    tail: Point  # the third wheel; ahead of the main wheels where it is a nose wheel

    def __post_init__(self) -> None:
        _require_finite(self, *WHEEL_NAMES)
        if not self.main_left[1] < self.main_right[1]:
            raise InputError(
                "wheels: expected main_left left of main_right (body y is right); swap the two"
            )

    @property
    def points_body(self) -> Array:
        """The three contact points (3, 3) [m], a row per wheel in the order of WHEEL_NAMES."""
        return np.array([self.main_left, self.main_right, self.tail])


@dataclass(frozen=True)
class Inertia:
    """Moments of inertia about the centre of gravity in body axes [kg m^2]."""

    Ixx: float
    Iyy: float
    Izz: float
    Ixz: float = 0.0

    def __post_init__(self) -> None:
        _require_positive(self, "Ixx", "Iyy", "Izz")
        require_range("Ixz", self.Ixz)
        largest, others = max(self.Ixx, self.Iyy, self.Izz), self.Ixx + self.Iyy + self.Izz
        if 2.0 * largest > others or self.Ixz**2 >= self.Ixx * self.Izz:
            raise InputError(
                "inertia: expected the moments of a solid body, got a largest one above the sum of"
                " the others or Ixz too large; check them"
            )


@dataclass(frozen=True)
class Airframe:
    """Dimensions, masses and coefficients of an aircraft before its first flight; SI, body axes."""

    name: str
    mass: float  # [kg], as flown
    wing_area: float  # S [m^2]
    span: float  # [m]
    length: float  # [m]
    air_density: float  # rho [kg/m^3], of the air it flies in
    bank_limit: float  # [rad], largest bank of a planned turn
    p_body_camera: Point  # position of the camera [m]
    parts: tuple[AirframePart, ...]
    aero: Aero
    wheels: Wheels
    inertia: Inertia

    def __post_init__(self) -> None:
        _require_positive(self, "mass", "wing_area", "span", "length", "air_density")
        _require_finite(self, "p_body_camera")
        if not 0.0 < self.bank_limit < math.pi / 2:
            raise InputError(
                "bank limit: expected an angle between 0 and 90 deg, got"
                f" {math.degrees(self.bank_limit):g}"
            )
        names = [part.name for part in self.parts]
        for part in self.parts:
            if names.count(part.name) > 1:
                raise InputError(
                    f"parts: expected every name once, got {part.name!r} twice; rename one"
                )
            if part.inside and (part.inside not in names or part.inside == part.name):
                raise InputError(
                    f"parts: expected {part.name!r} inside another part of the list, got"
                    f" {part.inside!r}"
                )

    @property
    def mean_chord(self) -> float:
        """Wing area over span [m]."""
        return self.wing_area / self.span

    @property
    def corners_body(self) -> Array:
        """Nose (with the camera), tail and wing tips (4, 3) in body axes [m]; without the fin."""
        nose, tip = self.p_body_camera[0], self.span / 2.0
        return np.array(
            [(nose, 0.0, 0.0), (nose - self.length, 0.0, 0.0), (0.0, tip, 0.0), (0.0, -tip, 0.0)]
        )

    @property
    def parts_mass(self) -> float:
        """Sum of the parts that are not inside another one [kg]; the sizing uses `mass`."""
        return math.fsum(part.mass for part in self.parts if not part.inside)


@dataclass(frozen=True)
class _PartRow:
    name: str
    mass_g: float
    inside: str = ""


@dataclass(frozen=True)
class _AirframeFile:
    """The keys of the file, each with its unit."""

    name: str
    mass_g: float
    wing_area_m2: float
    span_m: float
    length_m: float
    air_density_kg_m3: float
    bank_limit_deg: float
    p_body_camera_m: Point
    parts: tuple[_PartRow, ...]
    aero: Aero
    wheels_m: Wheels
    inertia_kg_m2: Inertia


def load_airframe(path: str | Path | None = None) -> Airframe:
    """Read an airframe file.

    Args:
        path: the TOML file; None takes the kit's own aircraft.

    Raises:
        FileNotFoundError: there is no file at the path.
        InputError: the file is not TOML, a key is missing or unknown, or a value is impossible.
    """
    path = default_airframe_path() if path is None else path
    file = from_toml(_AirframeFile, path)
    try:
        return Airframe(
            name=file.name,
            mass=file.mass_g / 1000.0,
            wing_area=file.wing_area_m2,
            span=file.span_m,
            length=file.length_m,
            air_density=file.air_density_kg_m3,
            bank_limit=math.radians(file.bank_limit_deg),
            p_body_camera=file.p_body_camera_m,
            parts=tuple(
                AirframePart(row.name, row.mass_g / 1000.0, row.inside) for row in file.parts
            ),
            aero=file.aero,
            wheels=file.wheels_m,
            inertia=file.inertia_kg_m2,
        )
    except InputError as error:
        raise InputError(f"{short_name(path)}: {error}") from None


def default_airframe_path() -> Path:
    """The file of the kit's own aircraft: of the checkout, else of the installation.

    Raises:
        FileNotFoundError: it is in neither place.
    """
    return shipped_path("hardware/airframe_umx.toml", "name one (falconwing: --airframe FILE)")


def _require_positive(record: object, *names: str, of: str = "") -> None:
    for name in names:
        value = require_range(name + of, getattr(record, name))
        if value <= 0.0:
            raise InputError(f"{name}{of}: expected a positive number, got {value:g}")


def _require_finite(record: object, *names: str) -> None:
    for name in names:
        for axis, value in zip("xyz", getattr(record, name), strict=True):
            require_range(f"{name} {axis}", value)
