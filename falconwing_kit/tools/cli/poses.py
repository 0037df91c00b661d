"""falconwing poses: estimate a flight's states from its onboard video, for identify."""

import csv
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from falconwing_kit.aircraft.airframe import load_airframe
from falconwing_kit.core.checks import Array, InputError, require_file, require_range
from falconwing_kit.core.files import read_text, require_writable_path, short_name
from falconwing_kit.core.flight_log import read_flight_log, to_flight_table
from falconwing_kit.core.flight_table import nearest_index, write_flight_table
from falconwing_kit.core.messages import COMMAND_NAMES
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.tools.cli.scene_input import open_scene
from falconwing_kit.tools.cli.show import next_line, print_json, print_table
from falconwing_kit.vision.hybrid_state import HybridFlight, HybridSettings, Video, estimate_flight
from falconwing_kit.vision.images import decode_image, read_image
from falconwing_kit.vision.marker import Marker, Pixels

if TYPE_CHECKING:
    from falconwing_kit.tools.devices.lens import Lens

COLUMNS = ("t", "frame", *COMMAND_NAMES)
MIN_POSES = 60  # 3 s at 20 Hz, the minimum of `identify`


@dataclass(frozen=True)
class Poses:
    """Estimate a flight's states from its onboard video by marker, pose network and smoother.

    Exit code 1 if the video gives poses for less than 3 s, too little for identification.
    """

    video: Annotated[Path, tyro.conf.Positional]
    """a folder with commands.csv (t,frame,throttle,aileron,elevator,rudder) and the frames, or a
    flight log (MCAP)
    """
    out: Path | None = None
    """the flight table to write (CSV)"""
    network: str | None = None
    """a pose network: hall (shipped) or a .safetensors file; used for frames without a pose from
    marker and scene
    """
    scene: str | None = None
    """a trained scene of the room: hall (shipped) or a file; poses are then refined against it"""
    camera: Path | None = None
    """transforms.json of `falconwing scene poses`, for the intrinsics; if not given, --fov-deg"""
    bench: Path | None = None
    """file of falconwing bench, for intrinsics and distortion; a log that `record --bench` made is
    undistorted already
    """
    fov_deg: float = 77.8
    """horizontal field of view; 77.8 is that of the hall's flights"""
    marker: str = "DICT_4X4_50,7,0.80"
    """dictionary, id and side of the black square in metres"""
    marker_place: str = "0,0,0.75"
    """the marker's centre in the world [m]; the marker is vertical and faces the approach"""
    room: str = "-22.5,-12,0,17.5,8,5"
    """minimum and maximum x,y,z of the room [m]"""
    airframe: Path | None = None
    """an airframe file, for the camera's position; without it the kit's aircraft"""
    measured: bool = False
    """write each frame's measured pose instead of the smoothed states"""
    json: bool = False
    """print the result as JSON"""

    def run(self) -> int:
        """Estimate the states, write them and count the frames by result.

        Returns:
            0 if there are enough poses to identify a model, else 1.

        Raises:
            FileNotFoundError: there is no video, lens or network file, or no folder to write into.
            InputError: an option is wrong, the video cannot be used, or it shows no marker.
        """
        if self.out is not None:
            require_writable_path(self.out)
        marker, settings = self._marker(), self._settings()
        lens = self._lens()
        video = read_video(self.video, lens)
        flight = estimate_flight(
            video,
            self._camera(video, lens),
            self._network(),
            marker=marker,
            scene=None if self.scene is None else open_scene(self.scene),
            p_body_camera=load_airframe(self.airframe).p_body_camera,
            settings=settings,
            progress=_progress(len(video.t)) if not self.json else lambda: None,
        )
        table = flight.measured if self.measured else flight.table
        if self.out is not None:
            write_flight_table(self.out, table)
        record = poses_record(flight)
        if self.json:
            print_json(record)
        else:
            _print_record(record)
            next_line(
                f"falconwing identify {self.out}"
                if self.out
                else "--out flight.csv keeps the table"
            )
        return 0 if int(table.has_pose.sum()) >= MIN_POSES else 1

    def _marker(self) -> Marker:
        words = self.marker.split(",")
        if len(words) != 3:
            raise InputError(
                "--marker: expected dictionary,id,size such as DICT_4X4_50,7,0.80, "
                f"got {self.marker!r}"
            )
        number, size = _numbers("--marker", ",".join(words[1:]), 2)
        T_world_marker = Marker().T_world_marker
        T_world_marker[:3, 3] = _numbers("--marker-place", self.marker_place, 3)
        return Marker(words[0].strip(), int(number), size, T_world_marker)

    def _settings(self) -> HybridSettings:
        x0, y0, z0, x1, y1, z1 = _numbers("--room", self.room, 6)
        return HybridSettings(room_low=(x0, y0, z0), room_high=(x1, y1, z1))

    def _network(self) -> Any:
        if self.network is None:
            return None
        from falconwing_kit.vision.pose_net import PoseNet

        return PoseNet.load(self.network)

    def _lens(self) -> "Lens | None":
        if self.bench is None:
            return None
        from falconwing_kit.tools.devices.calibration import read_bench

        if self.camera is not None:
            raise InputError("--bench: expected it without --camera; leave one of them out")
        return read_bench(self.bench).require_lens()

    def _camera(self, video: Video, lens: "Lens | None" = None) -> PinholeCamera:
        """The intrinsics at the size of the video's frames."""
        image = next(
            (image for image in map(video.image, range(len(video.t))) if image is not None), None
        )
        if image is None:
            raise InputError(
                f"{video.name}: expected readable frames, got none; check the names in commands.csv"
            )
        height, width = image.shape[:2]
        if lens is not None:
            return lens.camera(width, height)
        if self.camera is None:
            return PinholeCamera.from_fov_deg(width, height, self.fov_deg)
        from falconwing_kit.tools.capture.photo_files import read_reconstruction

        return scaled_camera(read_reconstruction(self.camera).camera, width, height)


def scaled_camera(camera: PinholeCamera, width: int, height: int) -> PinholeCamera:
    """The intrinsics of the same lens for frames of another size [px].

    Raises:
        InputError: the frames have another aspect ratio, hence another field of view.
    """
    scale = width / camera.width
    if abs(height - scale * camera.height) > 1.0:
        raise InputError(
            f"camera: expected frames of the shape of {camera.width} x {camera.height}, "
            f"got {width} x {height}; give --fov-deg instead"
        )
    return PinholeCamera(
        scale * camera.fx, scale * camera.fy, scale * camera.cx, scale * camera.cy, width, height
    )


def read_video(path: Path, lens: "Lens | None" = None) -> Video:
    """Read a recorded flight; its frames are loaded one by one when used.

    Args:
        path: a folder with commands.csv and the frames it names, or a flight log with images.
        lens: removes the distortion of the frames, unless the log says that it is removed.

    Raises:
        FileNotFoundError: there is no such folder or file.
        InputError: commands.csv lacks a column or has a cell that is not a number, or the log has
            no images.
    """
    video, is_straight = (
        (_from_folder(path), False) if path.is_dir() else _from_log(require_file(path))
    )
    if lens is None or is_straight:
        return video

    def straight(frame: int) -> Pixels | None:
        pixels = video.image(frame)
        return None if pixels is None else lens.undistort(pixels)

    return replace(video, image=straight)


def _from_folder(folder: Path) -> Video:
    name = short_name(require_file(folder / "commands.csv"))
    reader = csv.DictReader(read_text(folder / "commands.csv").splitlines())
    missing = [column for column in COLUMNS if column not in (reader.fieldnames or ())]
    if missing:
        raise InputError(
            f"{name}: expected the columns {', '.join(COLUMNS)}, got none for {missing[0]}"
        )
    rows = list(reader)
    try:
        numbers = np.array(
            [[float(row[column]) for column in ("t", *COMMAND_NAMES)] for row in rows], np.float64
        )
    except (TypeError, ValueError):
        raise InputError(
            f"{name}: expected a number in every cell but frame, got text; check for cut lines"
        ) from None
    if len(rows) < 2 or not np.isfinite(numbers).all() or not (np.diff(numbers[:, 0]) > 0.0).all():
        raise InputError(
            f"{name}: expected at least two rows of finite numbers with increasing time, got others"
        )
    frames = [folder / str(row["frame"]) for row in rows]
    outside = [path for path in frames if folder.resolve() not in path.resolve().parents]
    if outside:
        raise InputError(
            f"{name}: expected frames in the folder of the file, got {outside[0].name}; "
            "use plain file names"
        )
    return Video(
        folder.name, numbers[:, 0], numbers[:, 1:], lambda frame: _read_image(frames[frame])
    )


def _from_log(path: Path) -> tuple[Video, bool]:
    """The video, and whether its images were undistorted when they were recorded."""
    log = read_flight_log(path)
    images = {image.t: image.pixels for image in log.images()}
    if not images:
        raise InputError(f"{path.name}: expected a log with images, got none; record with a camera")
    table = to_flight_table(log)
    times = np.array(sorted(images))
    nearest = times[nearest_index(times, table.t)]
    video = Video(
        path.name,
        table.t,
        table.commands,
        lambda frame: decode_image(images[nearest[frame]].tobytes()),
    )
    return video, log.metadata.get("undistorted") == "yes"


def _read_image(path: Path) -> Pixels | None:
    """A frame as RGB; None if the file is missing or damaged."""
    return read_image(path) if path.is_file() else None


def poses_record(flight: HybridFlight) -> dict[str, Any]:
    """Counts and median sigmas of a flight's estimate, as they go to JSON."""
    table = flight.table
    seen = table.has_pose
    position, attitude = (table.extra[name][seen] for name in ("sigma_position", "sigma_attitude"))
    return {
        "flight": table.name,
        "frames": len(table.t),
        "with_pose": int(seen.sum()),
        "marker_sights": len(flight.marker),
        "corner_sigma_px": flight.corner_sigma_px,
        "sigma_position_m": _median(position),
        "sigma_attitude_deg": math.degrees(_median(attitude)),
        "counts": dict(sorted(flight.counts.items())),
    }


def _print_record(record: dict[str, Any]) -> None:
    share = 100.0 * record["with_pose"] / record["frames"]
    title = (
        f"{record['flight']}: {record['with_pose']} of {record['frames']} frames have a pose "
        f"({share:.0f} %)"
    )
    print_table(("frames", "count"), list(record["counts"].items()), title=title)
    print(
        f"smoothed: median sigma {100 * record['sigma_position_m']:.0f} cm and "
        f"{record['sigma_attitude_deg']:.1f} deg; "
        f"sigma of a marker corner {record['corner_sigma_px']:.2f} px"
    )


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def _numbers(name: str, text: str, count: int) -> list[float]:
    try:
        values = [require_range(name, float(word)) for word in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count:
        raise InputError(f"{name}: expected {count} numbers with commas between them, got {text!r}")
    return values


def _progress(frames: int) -> Any:
    """A progress bar on standard error."""
    from tqdm import tqdm

    return tqdm(total=frames, unit="frame", leave=False, disable=None).update
