"""Airframe: a TOML file with units in its keys -> one frozen record in SI units."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.config import from_toml
from falconwing_kit.core.files import shipped_path, short_name

Point = tuple[float, float, float]
Record = TypeVar("Record")
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
        _require_finite_points(self, *WHEEL_NAMES)
        if not self.main_left[1] < self.main_right[1]:
            raise InputError(
                "wheels: expected main_left left of main_right (body y is right); swap the two"
            )

    @property
    def points_body(self) -> Array:
        """The three contact points (3, 3) [m], a row per wheel in the order of WHEEL_NAMES."""
        return np.array([self.main_left, self.main_right, self.tail])


@dataclass(frozen=True)
class Propeller:
    """The disc that the blades sweep: a circle across the body's x axis."""

    x: float  # of its plane, in body axes [m]
    diameter: float  # [m]

    def __post_init__(self) -> None:
        require_range("propeller x", self.x)
        _require_positive(self, "diameter", of=" of the propeller")


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
        if not _is_solid(self.Ixx, self.Iyy, self.Izz, self.Ixz):
            raise InputError(
                "inertia: expected the moments of a solid body, got a largest one above the sum of"
                " the others or Ixz too large; check them"
            )


@dataclass(frozen=True)
class Airframe:
    """One aircraft as its TOML file describes it, before any flight: dimensions, masses, inertia,
    coefficients and contact points; SI units, body axes.
    """

    name: str
    mass: float  # [kg], as flown
    wing_area: float  # S [m^2]
    span: float  # [m]
    length: float  # [m]
    air_density: float  # rho [kg/m^3], of the air it flies in
    bank_limit: float  # [rad], largest bank of a planned turn
    p_body_camera: Point  # position of the camera, the front of its lens [m]
    p_body_nose: Point  # foremost point of the aircraft, the tip of its spinner [m]
    parts: tuple[AirframePart, ...]
    aero: Aero
    wheels: Wheels
    inertia: Inertia
    propeller: Propeller | None = None  # None where the file has none
    x_leading_edge: float | None = (
        None  # the wing's at its root, in body axes [m]; zero of a parts list
    )
    scaled: tuple[str, ...] = ()  # keys taken from the kit's own airframe, scaled: not measured
    contradictions: tuple[str, ...] = ()  # why entries of the file were set aside, a sentence each

    def __post_init__(self) -> None:
        _require_positive(self, "mass", "wing_area", "span", "length", "air_density")
        _require_finite_points(self, "p_body_camera", "p_body_nose")
        if self.x_leading_edge is not None:
            require_range(
                "leading_edge_x_m", self.x_leading_edge, low=-self.length, high=self.length
            )
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
        """Nose, tail and wing tips (4, 3) in body axes [m]; without the fin."""
        nose, tip = self.p_body_nose[0], self.span / 2.0
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
class _AeroTable:
    CL_max: float | None = None
    CL0: float | None = None
    CLa: float | None = None
    CD0: float | None = None
    k: float | None = None


@dataclass(frozen=True)
class _WheelsTable:
    main_left: Point | None = None
    main_right: Point | None = None
    tail: Point | None = None


@dataclass(frozen=True)
class _InertiaTable:
    Ixx: float | None = None
    Iyy: float | None = None
    Izz: float | None = None
    Ixz: float | None = None


@dataclass(frozen=True)
class _PropellerTable:
    x_m: float
    diameter_m: float

    @property
    def record(self) -> Propeller:
        return Propeller(self.x_m, self.diameter_m)


@dataclass(frozen=True)
class _AirframeFile:
    """The keys of the file, each with its unit; three are required."""

    mass_g: float
    wing_area_m2: float
    span_m: float
    name: str | None = None
    length_m: float | None = None
    air_density_kg_m3: float | None = None
    bank_limit_deg: float | None = None
    p_body_camera_m: Point | None = None
    p_body_nose_m: Point | None = None
    leading_edge_x_m: float | None = None
    propeller: _PropellerTable | None = None
    parts: tuple[_PartRow, ...] = ()
    aero: _AeroTable = field(default_factory=_AeroTable)
    wheels_m: _WheelsTable = field(default_factory=_WheelsTable)
    inertia_kg_m2: _InertiaTable = field(default_factory=_InertiaTable)


@dataclass(frozen=True)
class _KitFile:
    """The kit's own file, where nothing is missing."""

    name: str
    mass_g: float
    wing_area_m2: float
    span_m: float
    length_m: float
    air_density_kg_m3: float
    bank_limit_deg: float
    p_body_camera_m: Point
    p_body_nose_m: Point
    parts: tuple[_PartRow, ...]
    aero: Aero
    wheels_m: Wheels
    inertia_kg_m2: Inertia


def load_airframe(path: str | Path | None = None) -> Airframe:
    """Read an airframe file.

    It needs mass_g, wing_area_m2 and span_m. What else it lacks is that of the kit's own aircraft,
    scaled by dynamic similarity: lengths with the span (with length_m, where the file has it, for
    everything along the body), moments of inertia with mass times length squared; coefficients,
    angles and the air stay. `Airframe.scaled` names it. An inertia that no body of this mass and
    span has is scaled too, and `Airframe.contradictions` says why.

    Args:
        path: the TOML file; None takes the kit's own aircraft.

    Raises:
        FileNotFoundError: there is no file at the path.
        InputError: the file is not TOML, a key is missing or unknown, or a value is impossible or
            looks like another unit.
    """
    path = default_airframe_path() if path is None else path
    file = from_toml(_AirframeFile, path)
    try:
        _require_plausible_units(file)
        return _complete(file, str(Path(path).stem) if file.name is None else file.name)
    except InputError as error:
        raise InputError(f"{short_name(path)}: {error}") from None


def scaling_sentence(airframe: Airframe) -> str:
    """What of the airframe was scaled from the kit's own aircraft, one line; "" if nothing was."""
    if not airframe.scaled:
        return ""
    why = "".join(f"; {sentence}" for sentence in airframe.contradictions)
    return (
        f"{airframe.name}: scaled from the kit's own airframe, not measured: "
        f"{', '.join(airframe.scaled)}{why}"
    )


# Plausible values of an aircraft between a few grams and the size of a small car, and other units
# that a file may give them in: key, low, high, unit, (other unit, its number per unit) ...
_LENGTH_UNITS = (("centimetres", 1e2), ("millimetres", 1e3), ("inches", 39.37))
_AREA_UNITS = (("square decimetres", 1e2), ("square centimetres", 1e4))
_UNITS = (
    ("mass_g", 5.0, 1e5, "grams", (("kilograms", 1e-3), ("milligrams", 1e3))),
    ("wing_area_m2", 1e-3, 30.0, "square metres", _AREA_UNITS),
    ("span_m", 0.08, 15.0, "metres", _LENGTH_UNITS),
    ("length_m", 0.03, 15.0, "metres", _LENGTH_UNITS),
    ("air_density_kg_m3", 0.3, 3.0, "kg/m^3", (("g/m^3", 1e3), ("g/cm^3", 1e-3))),
)
_ASPECT_RATIOS = (0.5, 60.0)  # span^2 / area, from a disk to a sailplane
_WING_LOADINGS = (0.05, 200.0)  # [kg/m^2], from an indoor model of film to a fast jet model


def _require_plausible_units(file: _AirframeFile) -> None:
    """Raise InputError where a number is of another unit than its key says."""
    for key, low, high, unit, others in _UNITS:
        value = getattr(file, key)
        if value is None or low <= value <= high:
            continue
        if value <= 0.0:
            raise InputError(f"{key}: expected a positive number, got {value:g}")
        guess = [name for name, per_unit in others if low <= value / per_unit <= high]
        hint = f"did you give {' or '.join(guess)}?" if guess else "check it"
        raise InputError(f"{key}: expected {unit}, {low:g} to {high:g}, got {value:g}; {hint}")
    ratio, loading = file.span_m**2 / file.wing_area_m2, file.mass_g / 1000.0 / file.wing_area_m2
    if not _ASPECT_RATIOS[0] <= ratio <= _ASPECT_RATIOS[1]:
        raise InputError(
            f"wing_area_m2: expected square metres that fit a span of {file.span_m:g} m, got"
            f" {file.wing_area_m2:g}, a mean chord of {file.wing_area_m2 / file.span_m:.3g} m; did"
            " you give another unit?"
        )
    if not _WING_LOADINGS[0] <= loading <= _WING_LOADINGS[1]:
        raise InputError(
            f"mass_g: expected grams that fit a wing of {file.wing_area_m2:g} m^2, got"
            f" {file.mass_g:g}, a wing loading of {loading:.3g} kg/m^2; did you give kilograms?"
        )


def _complete(file: _AirframeFile, name: str) -> Airframe:
    """The airframe of a file; what the file lacks is scaled from the kit's own file."""
    kit = from_toml(_KitFile, default_airframe_path())
    span_ratio = file.span_m / kit.span_m
    length = span_ratio * kit.length_m if file.length_m is None else file.length_m
    length_ratio = length / kit.length_m

    def resize(point: Point) -> Point:  # lengths across the body go with the span
        return length_ratio * point[0], span_ratio * point[1], length_ratio * point[2]

    aero = _fill(file.aero, vars(kit.aero))
    wheels = _fill(file.wheels_m, {w: resize(getattr(kit.wheels_m, w)) for w in WHEEL_NAMES})
    similar = _similar_inertia(kit, file.mass_g / kit.mass_g, file.span_m, length)
    inertia_table, inertia = file.inertia_kg_m2, _fill(file.inertia_kg_m2, similar)
    contradiction = ""
    if inertia_table != _InertiaTable():
        contradiction = _why_impossible(inertia, file.mass_g / 1000.0, file.span_m, length)
    if contradiction:
        inertia_table, inertia = _InertiaTable(), similar
    plain = (
        "length_m", "air_density_kg_m3", "bank_limit_deg", "p_body_camera_m", "p_body_nose_m"
    )  # fmt: skip
    tables = {"aero": file.aero, "wheels_m": file.wheels_m, "inertia_kg_m2": inertia_table}
    density, bank_deg, p_body_camera, p_body_nose = (
        file.air_density_kg_m3, file.bank_limit_deg, file.p_body_camera_m, file.p_body_nose_m
    )  # fmt: skip
    return Airframe(
        name=name,
        mass=file.mass_g / 1000.0,
        wing_area=file.wing_area_m2,
        span=file.span_m,
        length=length,
        air_density=kit.air_density_kg_m3 if density is None else density,
        bank_limit=math.radians(kit.bank_limit_deg if bank_deg is None else bank_deg),
        p_body_camera=resize(kit.p_body_camera_m) if p_body_camera is None else p_body_camera,
        p_body_nose=resize(kit.p_body_nose_m) if p_body_nose is None else p_body_nose,
        propeller=None if file.propeller is None else file.propeller.record,
        x_leading_edge=file.leading_edge_x_m,
        parts=tuple(AirframePart(row.name, row.mass_g / 1000.0, row.inside) for row in file.parts),
        aero=_record("aero", Aero, aero),
        wheels=_record("wheels_m", Wheels, wheels),
        inertia=_record("inertia_kg_m2", Inertia, inertia),
        scaled=(
            *(key for key in plain if getattr(file, key) is None),
            *(name for key, table in tables.items() for name in _missing(key, table)),
        ),
        contradictions=(contradiction,) if contradiction else (),
    )


def _fill(table: Any, substitutes: Mapping[str, Any]) -> dict[str, Any]:
    """The entries of a table of the file, a substitute for each that it lacks."""
    return {
        name: substitutes[name] if value is None else value for name, value in vars(table).items()
    }


def _missing(key: str, table: Any) -> list[str]:
    """Keys of a table's missing entries; the table's own key where it has no entry at all."""
    missing = [f"{key}.{name}" for name, value in vars(table).items() if value is None]
    return [key] if len(missing) == len(vars(table)) else missing


def _record(key: str, kind: type[Record], entries: Mapping[str, Any]) -> Record:
    """A record of the entries of a table; InputError with the table's key in front."""
    try:
        return kind(**entries)
    except InputError as error:
        raise InputError(f"{key}: {error}") from None


def _similar_inertia(
    kit: _KitFile, mass_ratio: float, span: float, length: float
) -> dict[str, float]:
    """I = m radius^2; the radius about x goes with the span, y with the length, z with both."""
    span_ratio, length_ratio = span / kit.span_m, length / kit.length_m
    both_ratio = (span + length) / (kit.span_m + kit.length_m)
    own = kit.inertia_kg_m2
    return {
        "Ixx": own.Ixx * mass_ratio * span_ratio**2,
        "Iyy": own.Iyy * mass_ratio * length_ratio**2,
        "Izz": own.Izz * mass_ratio * both_ratio**2,
        "Ixz": own.Ixz * mass_ratio * span_ratio * length_ratio,
    }


def _why_impossible(inertia: Mapping[str, float], mass: float, span: float, length: float) -> str:
    """Why no body of this mass [kg], span and length [m] has this inertia; "" if one may.

    No part lies farther out than the wing tips or the ends of the body, so a radius of gyration
    sqrt(I / m) is below half the diagonal; one below a fiftieth of the span is a point's.
    """
    if min(inertia[axis] for axis in ("Ixx", "Iyy", "Izz")) <= 0.0:
        return ""  # a wrong entry, which the record refuses
    smallest, largest = 0.02 * span, 0.5 * math.hypot(span, length)
    for axis in ("Ixx", "Iyy", "Izz"):
        radius = math.sqrt(inertia[axis] / mass)
        if not smallest <= radius <= largest:
            return (
                f"inertia_kg_m2 contradicts mass_g: {axis} {inertia[axis]:g} would be a radius of"
                f" gyration of {radius:.3g} m, expected {smallest:.2g} to {largest:.2g} m"
            )
    return (
        "" if _is_solid(**inertia)
        else "inertia_kg_m2 is of no solid body: the largest moment is above the sum of the others,"
        " or Ixz is too large"
    )  # fmt: skip


def _is_solid(Ixx: float, Iyy: float, Izz: float, Ixz: float) -> bool:
    """Whether a body can have these moments: none above the sum of the others, Ixz small enough."""
    return 2.0 * max(Ixx, Iyy, Izz) <= Ixx + Iyy + Izz and Ixz**2 < Ixx * Izz


def builder_airframe_path() -> Path:
    """The file of the aircraft that the builder's book builds, its camera above the wing.

    Raises:
        FileNotFoundError: it is neither in the checkout nor in the installation.
    """
    return shipped_path("hardware/airframe_builder.toml", "name one (falconwing: --airframe FILE)")


def default_airframe_path() -> Path:
    """The file of the kit's own aircraft: of the checkout, else of the installation.

    Raises:
        FileNotFoundError: it is in neither place.
    """
    return shipped_path("hardware/airframe_umx.toml", "name one (falconwing: --airframe FILE)")


def _require_positive(part: object, *names: str, of: str = "") -> None:
    """Raise InputError unless these numbers of a part of the airframe are finite and above 0.

    Args:
        part: a record of this file.
        names: of its fields.
        of: added to the names in a message, such as " of 'wing'".
    """
    for name in names:
        value = require_range(name + of, getattr(part, name))
        if value <= 0.0:
            raise InputError(f"{name}{of}: expected a positive number, got {value:g}")


def _require_finite_points(part: object, *points: str) -> None:
    """Raise InputError unless these points (3,) of a part of the airframe are finite.

    Args:
        part: a record of this file.
        points: names of its fields.
    """
    for name in points:
        for axis, value in zip("xyz", getattr(part, name), strict=True):
            require_range(f"{name} {axis}", value)
