"""Cameras as hardware: a TOML file with units in its keys -> image format, body, mount, supply."""

from dataclasses import dataclass
from pathlib import Path

from falconwing_kit.core.checks import InputError, require_range
from falconwing_kit.core.config import from_toml
from falconwing_kit.core.files import shipped_path, short_name
from falconwing_kit.tools.hardware.power_filter import PowerFilter

SHIPPED = ("analog", "digital")
MOUNTS = ("cheeks", "plate")


@dataclass(frozen=True)
class ImageFormat:
    """The image at the ground station."""

    width_px: int
    height_px: int
    rate_hz: float
    fov_deg: float  # horizontal

    def __post_init__(self) -> None:
        for name, high in (
            ("width_px", 16384),
            ("height_px", 16384),
            ("rate_hz", 1000.0),
            ("fov_deg", 175.0),
        ):
            require_range(name, getattr(self, name), low=1.0, high=high)


@dataclass(frozen=True)
class Box:
    """The camera's outer dimensions [mm] from its screw holes; the depth is the optical axis."""

    width: float
    height: float
    depth_behind: float  # from the screw holes to the back
    lens_ahead: float  # from the screw holes to the front of the lens

    def __post_init__(self) -> None:
        for name in ("width", "height", "depth_behind", "lens_ahead"):
            require_range(name, getattr(self, name), low=1.0, high=100.0)


@dataclass(frozen=True)
class Mount:
    """Screws and tilt of the camera."""

    kind: str  # one of MOUNTS
    screw_mm: float  # outer diameter of the thread
    # from the optical axis; cheeks: forward and up, plate: right and up
    holes_mm: tuple[tuple[float, float], ...]
    tilt_deg: float  # maximum tilt up and down

    def __post_init__(self) -> None:
        if self.kind not in MOUNTS:
            raise InputError(f"kind: expected one of {', '.join(MOUNTS)}, got {self.kind!r}")
        if not self.holes_mm:
            raise InputError("holes_mm: expected at least one hole [[0.0, 0.0]], got none")
        require_range("screw_mm", self.screw_mm, low=1.0, high=6.0)
        require_range("tilt_deg", self.tilt_deg, low=0.0, high=60.0)
        for place in self.holes_mm:
            for number in place:
                require_range("holes_mm", number, low=-50.0, high=50.0)


@dataclass(frozen=True)
class Supply:
    """Voltage range and current of the camera."""

    low_v: float
    high_v: float
    current_a: float

    def __post_init__(self) -> None:
        require_range("low_v", self.low_v, low=1.0, high=30.0)
        require_range("high_v", self.high_v, low=self.low_v, high=30.0)
        require_range("current_a", self.current_a, low=0.001, high=5.0)

    @property
    def load_ohm(self) -> float:
        """The camera as a resistor, at the lowest voltage, its highest load of the filter."""
        return self.low_v / self.current_a


@dataclass(frozen=True)
class CameraHardware:
    """One camera."""

    name: str
    link: str  # transmission of its images
    mass_g: float
    image: ImageFormat
    body_mm: Box
    mount: Mount
    supply: Supply
    power_filter: PowerFilter | None = None  # None with a supply of its own

    def __post_init__(self) -> None:
        require_range("mass_g", self.mass_g, low=0.1, high=1000.0)
        if self.mount.kind == "cheeks" and any(
            abs(up) > self.body_mm.height / 2.0 for _, up in self.mount.holes_mm
        ):
            raise InputError(
                "mount: expected the holes in the camera's side, got one above or below its body"
            )


def load_camera(camera: str | Path = "analog") -> CameraHardware:
    """Read a camera file.

    Args:
        camera: "analog" or "digital" for the kit's own, or a TOML file.

    Returns:
        The camera, with all values checked.

    Raises:
        FileNotFoundError: there is no file.
        InputError: the file is not TOML, a key is missing or unknown, or a value is out of range.
    """
    path = (
        shipped_path(f"hardware/camera_{camera}.toml", "name a file")
        if camera in SHIPPED
        else Path(camera)
    )
    found = from_toml(CameraHardware, path)
    if (
        found.power_filter is not None
        and found.supply.load_ohm <= 10.0 * found.power_filter.series_ohm
    ):
        raise InputError(
            f"{short_name(path)}: power_filter: expected a voltage drop below 10 %, got more; "
            "use a smaller resistance"
        )
    return found
