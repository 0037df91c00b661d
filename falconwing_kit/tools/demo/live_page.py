"""Live page: a scene and the steps of a flight -> a browser page with FPV view, hall and plots.

Viser serves the page to this machine only, without requests to any other. The loop never waits for
it: `show` stores the newest step and returns, and a second thread draws, so a slow browser drops
frames and does not slow the flight.
"""

import html
import io
import math
import threading
import time
import warnings
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falconwing_kit.aircraft.touchdown import LandingPad
from falconwing_kit.control.guidance import Hall
from falconwing_kit.core.checks import Array, require_range
from falconwing_kit.core.frames import pose_matrix
from falconwing_kit.core.messages import Command, State
from falconwing_kit.flight.loop import LoopStep
from falconwing_kit.flight.sources import decode_jpeg
from falconwing_kit.scene.arena import leader_at
from falconwing_kit.scene.camera import PinholeCamera
from falconwing_kit.scene.gaussians import GaussianScene
from falconwing_kit.scene.render import render
from falconwing_kit.tools.classroom.aircraft_boxes import AIRCRAFT, DARK

HOST = "127.0.0.1"
PERIOD_S, PLOT_EVERY = 0.05, 4  # the loop's period; plots are drawn at every fourth step
PANEL_PX = 420
LEFT_S = 5.0  # without a browser, after which a page that is kept is closed
WINDOW_S = 30.0  # time range of the plots
BLUE, RUST, QUIET, LINE = "#0b5394", "#c1440e", "#666", "#ddd"  # as on the kit's other pages
# chase camera and its target, relative to the aircraft [m]
CHASE_FROM, CHASE_TO = np.array([-3.2, -2.3, 1.0]), np.array([0.6, 0.0, 0.05])
FAR_M = 400.0  # camera distance for a nearly orthographic image of a side of the hall
THICK_M = 0.6  # Gaussians closer than this to a side belong to its image
FACE_PX = 2000  # longer edge of a side's image

PATH_RGB, PATH_PIECES = (193, 68, 14), 400


class LivePage:
    """A page that shows a running flight: `show(step)` for every step, and `close()` at the end.

    Args:
        scene: the hall; None for an empty page and `set_scene` later.
        port: TCP port; if it is taken the next free one, with a warning.
        banner: label on top of the page; a simulation is labelled as one.

    Raises:
        InputError: the port is not in 1024..65000.
    """

    def __init__(
        self, scene: GaussianScene | None = None, port: int = 8080, banner: str = "SIMULATION"
    ) -> None:
        wanted = int(require_range("port", port, low=1024, high=65000))
        self._server = _serve(wanted)
        self.port = int(self._server.get_port())
        self.url = f"http://{HOST}:{self.port}"
        if self.port != wanted:
            warnings.warn(f"port {wanted} is taken, so the page is at {self.url}", stacklevel=2)
        self._banner = banner
        self._newest: LoopStep | None = None
        self._past: list[tuple[float, ...]] = []  # time, position and speed of every step shown
        self._lock = threading.Lock()
        self._news, self._closing = threading.Event(), threading.Event()
        self._build()
        if scene is not None:
            self.set_scene(scene)
        # a browser that connects late gets the newest step too
        self._server.on_client_connect(lambda client: self._news.set())
        self._thread = threading.Thread(target=self._draw_loop, name="live page", daemon=True)
        self._thread.start()

    def set_scene(self, scene: GaussianScene) -> None:
        """Add a hall, in the kit's world frame."""
        _add_hall(self._server.scene, scene)

    def open(self) -> bool:
        """Open the page in this machine's browser; False if there is none."""
        return webbrowser.open(self.url)

    def wait_for_viewer(self, seconds: float) -> bool:
        """Wait at most `seconds` until a browser shows the page; False if none did."""
        end = time.monotonic() + seconds
        while not self._server.get_clients() and time.monotonic() < end:
            time.sleep(0.05)
        return bool(self._server.get_clients())

    def keep(self, verdict: str) -> None:
        """Show a verdict, and return when Ctrl-C is pressed or no browser shows the page."""
        self._banner = f"{self._banner}: {verdict}"
        self._news.set()
        seen = time.monotonic()
        with suppress(KeyboardInterrupt):
            while time.monotonic() - seen < LEFT_S:
                seen = time.monotonic() if self._server.get_clients() else seen
                time.sleep(0.1)

    def __enter__(self) -> "LivePage":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def show(self, step: LoopStep) -> None:
        """Show a step as soon as possible; older steps not drawn by then are dropped.

        Args:
            step: of the loop; an earlier time than the last step's starts a new flight. An aircraft
                without a known pose is hidden; an unknown speed is left out of the plot.
        """
        state = _state_with_pose(step.state)
        step = replace(step, state=state, leader=_state_with_pose(step.leader))
        with self._lock:
            if self._past and step.t < self._past[-1][0]:
                self._past = []
            if state is not None:
                self._past.append(
                    (step.t, *state.p_world.tolist(), float(np.linalg.norm(state.v_world)))
                )
            self._newest = step
        self._news.set()

    def close(self) -> None:
        """Draw the last step, then close the page."""
        self._closing.set()
        self._news.set()
        self._thread.join()
        with _silence_viser():
            self._server.stop()

    def _build(self) -> None:
        """Create the elements of the empty page."""
        server = self._server
        self._aircraft, self._leader = (
            _add_aircraft(server.scene, name) for name in ("/aircraft", "/leader")
        )
        self._aircraft.visible = self._leader.visible = False
        self._path = server.scene.add_line_segments(
            "/path", np.zeros((PATH_PIECES, 2, 3)), PATH_RGB, thickness=0.03
        )
        self._drop = server.scene.add_box(
            "/drop", color=DARK, dimensions=(0.02, 0.02, 1.0), visible=False
        )
        _set_initial_view(server.initial_camera)
        self._head = server.gui.add_html(head_html(self._banner, None))
        self._view = server.gui.add_image(
            np.full((240, 320, 3), 40, np.uint8), label=None, jpeg_quality=85
        )
        self._plots = server.gui.add_html(plots_html(np.zeros((0, 3)), None))
        self._following = server.gui.add_checkbox("follow the aircraft", True)

    def _draw_loop(self) -> None:
        """Draw the newest step until the page closes; an error ends the page, not the flight."""
        drawn = 0
        try:
            while self._news.is_set() or not self._closing.is_set():
                self._news.wait()
                self._news.clear()
                with self._lock:
                    step, past = self._newest, np.array(self._past).reshape(-1, 5)
                if step is not None:
                    self._draw(step, past, plots=drawn % PLOT_EVERY == 0 or self._closing.is_set())
                    drawn += 1
                self._closing.wait(PERIOD_S)
        except Exception as fault:
            warnings.warn(
                f"the live page stopped ({type(fault).__name__}: {fault}); the flight continues",
                stacklevel=2,
            )

    def _draw(self, step: LoopStep, past: Array, plots: bool) -> None:
        """Update the page to this step; past is (N, 5) of time, position and speed."""
        place = past[:, 1:4].astype(np.float32)
        with self._server.atomic():
            _move_aircraft(self._aircraft, step.state)
            _move_aircraft(self._leader, step.leader)
            self._head.content = head_html(self._banner, step)
            if step.image is not None:
                self._view.image = decode_jpeg(step.image)
            if step.state is not None:
                self._move_cameras(step.state.p_world)
                height = float(place[-1, 2])
                self._drop.position, self._drop.scale = (
                    (*place[-1, :2], height / 2.0),
                    (1.0, 1.0, height),
                )
                self._drop.visible = True
            if len(place) > 1:
                # a constant number of segments, because viser fixes the array of colours
                points = place[np.linspace(0, len(place) - 1, PATH_PIECES + 1).astype(int)]
                self._path.points = np.stack([points[:-1], points[1:]], axis=1)
            if plots:
                self._plots.content = plots_html(past[:, [0, 3, 4]], step.command)

    def _move_cameras(self, p_world: Array) -> None:
        """Move every browser's camera with the aircraft, if 'follow the aircraft' is on."""
        if not self._following.value:
            return
        for client in self._server.get_clients().values():
            with client.atomic():
                client.camera.position = p_world + CHASE_FROM
                client.camera.look_at = p_world + CHASE_TO


def _state_with_pose(state: State | None) -> State | None:
    """The state if its pose is finite, else None."""
    return state if state is not None and np.isfinite(state.pose.T_world_body).all() else None


def head_html(banner: str, step: LoopStep | None) -> str:
    """HTML of the panel's top: banner, mode, time and position; step None before the first."""
    mode, numbers = (
        ("", "waiting for the first step") if step is None else (step.mode, f"{step.t:.1f} s")
    )
    if step is not None and step.state is not None:
        x, y, z = step.state.p_world
        numbers += f" &nbsp; x {x:.1f} m &nbsp; y {y:+.2f} m &nbsp; height {z:.2f} m"
    return (
        "<style>img{width:100%}</style>"
        '<div style="font:14px system-ui,sans-serif;padding:10px 14px 2px">'
        f'<b style="color:#fff;background:{RUST};border-radius:4px;padding:3px 9px;'
        f'letter-spacing:.06em">{html.escape(banner)}</b> '
        f'<b style="font-size:19px;margin-left:8px">{html.escape(mode)}</b>'
        f'<div style="color:{QUIET};margin-top:7px;font-variant-numeric:tabular-nums">'
        f"{numbers}</div></div>"
    )


def plots_html(past: Array, command: Command | None) -> str:
    """HTML with inline SVG: the command as two sticks, height and speed over time.

    Args:
        past: (N, 3) time [s], height [m] and speed [m/s] of the steps so far.
        command: None before the first step.
    """
    sticks = command.vector if command is not None else np.zeros(4)
    throttle, aileron, elevator, rudder = (float(value) for value in sticks)
    # As on a mode 2 transmitter: nose-up elevator is the stick pulled back, down in the drawing.
    boxes = _stick(
        95, rudder, 2.0 * throttle - 1.0, f"throttle {throttle:.2f}", f"rudder {rudder:+.2f}"
    )
    boxes += _stick(275, aileron, -elevator, f"elevator {elevator:+.2f}", f"aileron {aileron:+.2f}")
    lines = _plot(past[:, [0, 1]], "height [m]", BLUE) + _plot(past[:, [0, 2]], "speed [m/s]", RUST)
    return (
        '<div style="padding:4px 14px">'
        '<svg viewBox="0 0 370 150" style="width:100%;font:12px system-ui,sans-serif">'
        f"{boxes}</svg>{lines}</div>"
    )


def _stick(centre: float, right: float, up: float, above: str, below: str) -> str:
    """One stick of a transmitter as SVG, both positions in -1..1."""
    left, size = centre - 50.0, 100.0
    x, y = centre + 44.0 * right, 75.0 - 44.0 * up
    return (
        f'<rect x="{left}" y="25" width="{size}" height="{size}" rx="8" fill="#f6f6f6" '
        f'stroke="{LINE}"/>'
        f'<path d="M{centre} 25v100M{left} 75h100" stroke="{LINE}"/>'
        f'<path d="M{centre} 75L{x:.1f} {y:.1f}" stroke="{QUIET}" stroke-width="3"/>'
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="8" fill="{BLUE}"/>'
        f'<text x="{centre}" y="16" text-anchor="middle">{above}</text>'
        f'<text x="{centre}" y="142" text-anchor="middle">{below}</text>'
    )


def _plot(series: Array, label: str, colour: str) -> str:
    """A line plot of the last WINDOW_S; series is (N, 2) of time and value, nan is left out."""
    series = series[np.isfinite(series[:, 1])]
    recent = (
        series[series[:, 0] >= series[-1, 0] - WINDOW_S] if len(series) else np.array([[0.0, 0.0]])
    )
    recent = recent[:: max(1, len(recent) // 300)]
    begin, span = recent[0, 0], max(recent[-1, 0] - recent[0, 0], 10.0)
    tick = _round_tick(max(float(recent[:, 1].max()), 0.5))
    top = tick * math.ceil(max(float(recent[:, 1].max()), 0.5) / tick)
    points = " ".join(
        f"{30 + 330 * (t - begin) / span:.1f},{92 - 76 * v / top:.1f}" for t, v in recent
    )
    levels = "".join(
        f'<path d="M30 {92 - 76 * k * tick / top:.1f}h330" stroke="{LINE}"/>'
        f'<text x="25" text-anchor="end" y="{96 - 76 * k * tick / top:.1f}">{k * tick:g}</text>'
        for k in range(round(top / tick) + 1)
    )
    times = "".join(
        f'<text x="{30 + 330 * (t - begin) / span:.1f}" y="107" text-anchor="middle">{t:g}</text>'
        for t in np.arange(5.0 * math.ceil(begin / 5.0), begin + span - 1.0, 5.0)
    )
    return (
        f'<svg viewBox="0 0 370 112" style="width:100%;font:11px system-ui,sans-serif" '
        f'fill="{QUIET}">{levels}{times}'
        f'<text x="365" y="107" text-anchor="end">time [s]</text>'
        f'<text x="30" y="10" fill="{colour}" font-weight="600">{label}</text>'
        f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="2"/></svg>'
    )


def _round_tick(top: float) -> float:
    """A round step, two to four of which reach `top`."""
    size = 10.0 ** math.floor(math.log10(top))
    return next(size * part for part in (0.25, 0.5, 1.0, 2.5, 5.0) if top / (size * part) <= 4.0)


def hall_sides(scene: GaussianScene) -> Iterator[tuple[Array, NDArray[np.uint8]]]:
    """Floor, walls and marker of a hall as textured quads, which a browser draws quickly.

    Each side is rendered from far away, with the Gaussians near it. The ceiling is left out for the
    view from above.

    Yields:
        corners (4, 3) in the world [m], viewed from inside, clockwise from the top left, and rgb
        (H, W, 3).
    """
    if "leader" in scene.label_names:
        scene = leader_at(scene, None)
    hall = Hall()
    low, high = np.array([hall.x, hall.y, (0.0, hall.height)]).T
    centre, half = (low + high) / 2.0, (high - low) / 2.0
    x, y, z = np.eye(3)
    for ahead, down in ((-z, -x), (x, -z), (-x, -z), (y, -z), (-y, -z)):
        depth = float(half @ np.abs(ahead))
        near = np.abs((scene.means - centre) @ ahead - depth) < THICK_M
        if near.any():
            yield _render_side(
                scene.selected(near), centre + depth * ahead, np.cross(down, ahead), down, half
            )
    if "marker" in scene.label_names:  # vertical, facing the approach
        marker = scene.selected(scene.labelled("marker"))
        low, high = marker.means.min(axis=0), marker.means.max(axis=0)
        yield _render_side(marker, (low + high) / 2.0, -y, -z, (high - low) / 2.0)


def _render_side(
    scene: GaussianScene, middle: Array, right: Array, down: Array, half: Array
) -> tuple[Array, Any]:
    """A side viewed from inside: corners (4, 3) [m] and a nearly orthographic image."""
    wide, high = (float(half @ np.abs(edge)) for edge in (right, down))
    scale = FACE_PX / (2.0 * max(wide, high))  # pixels a metre
    width, height = round(2.0 * wide * scale), round(2.0 * high * scale)
    camera = PinholeCamera(FAR_M * scale, FAR_M * scale, width / 2.0, height / 2.0, width, height)
    ahead = np.cross(right, down)
    T_world_camera = pose_matrix(np.stack([right, down, ahead], axis=1), middle - FAR_M * ahead)
    frame = render(scene, camera, T_world_camera, background=(0.8, 0.8, 0.8))
    corners = np.array(
        [
            middle + i * wide * right + j * high * down
            for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))
        ]
    )
    return corners, np.rint(255.0 * frame.rgb).astype(np.uint8)


def _add_hall(page: Any, scene: GaussianScene) -> None:
    """Add the hall's sides, visible from the inside only, so that no wall hides the flight."""
    import trimesh
    from PIL import Image as Picture

    for number, (corners, rgb) in enumerate(hall_sides(scene)):
        packed = io.BytesIO()
        Picture.fromarray(rgb).save(packed, format="JPEG", quality=88)
        # emissive: the image is lit already
        material = trimesh.visual.material.PBRMaterial(
            emissiveTexture=Picture.open(packed),
            emissiveFactor=[1.0, 1.0, 1.0],
            baseColorFactor=[0, 0, 0, 255],
            metallicFactor=0.0,
            roughnessFactor=1.0,
        )
        uv = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])
        texture = trimesh.visual.TextureVisuals(uv=uv, material=material)
        sides = trimesh.Trimesh(corners, [[0, 2, 1], [0, 3, 2]], visual=texture, process=False)
        page.add_mesh_trimesh(f"/hall/{number}", sides, cast_shadow=False, receive_shadow=False)


def _set_initial_view(camera: Any) -> None:
    """Initial view across the end of the approach and the pad."""
    pad = LandingPad()
    threshold = np.array([pad.x_start, pad.y_centre, 0.0])
    camera.fov = math.radians(50.0)
    camera.look_at = threshold + np.array([0.0, 0.0, 0.6])
    camera.position = threshold + np.array([-7.0, -9.0, 4.0])


def _add_aircraft(page: Any, name: str) -> Any:
    """Add the aircraft as boxes below one moving body frame; the frame."""
    frame = page.add_frame(name, show_axes=False)
    for number, (colour, size, centre) in enumerate(AIRCRAFT):
        page.add_box(
            f"{name}/{number}", color=colour, dimensions=tuple(size), position=tuple(centre)
        )
    return frame


def _move_aircraft(frame: Any, state: State | None) -> None:
    """Move an aircraft to its pose, or hide it without a state."""
    from viser.transforms import SO3

    if state is not None:
        T_world_body = state.pose.T_world_body
        frame.position, frame.wxyz = T_world_body[:3, 3], SO3.from_matrix(T_world_body[:3, :3]).wxyz
    frame.visible = state is not None


def _serve(port: int) -> Any:
    """A viser server reachable from this machine only, without viser's share tunnel."""
    import viser

    with _silence_viser():
        server = viser.ViserServer(host=HOST, port=port, label="FalconWing", verbose=False)
    # The share button requests a tunnel from an outside host: remove it and the method behind it.
    server.request_share_url = lambda *_, **__: None  # type: ignore[method-assign]
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.scene.configure_environment_map(None)  # its reflections reduce the hall's contrast
    server.scene.add_light_ambient("/light", intensity=2.5)
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(PANEL_PX)
    return server


@contextmanager
def _silence_viser() -> Iterator[None]:
    """Suppress viser's messages on start and stop."""
    import rich

    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
