"""Sources: positions of balls in a rendered image, by hand; a recorded log returns what was
written.
"""

from dataclasses import replace

import numpy as np
import pytest

from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_log import FlightLogWriter, read_flight_log
from falconwing_kit.core.messages import Command, Image, Observation, State
from falconwing_kit.flight.loop import Loop
from falconwing_kit.flight.sources import (
    MeasuredStates,
    RecordedImages,
    RecordedPilot,
    RecordedStates,
    RenderedView,
    decode_jpeg,
    fpv_camera,
)
from falconwing_kit.scene.analog import AnalogVideo
from falconwing_kit.scene.gaussians import GaussianScene

LEVEL = State.from_vector(np.zeros(9))
RED, GREEN = np.array([0.9, 0.1, 0.1]), np.array([0.1, 0.9, 0.1])


class StillWorld:
    """A world with the states of the test; records the times it was advanced to."""

    def __init__(self, state: State = LEVEL, leader: State | None = None) -> None:
        self.state, self.leader_state, self.flown = state, leader, []

    def advance(self, t: float) -> None:
        self.flown.append(t)

    def measured(self) -> State:
        return replace(self.state, roll=0.01 * len(self.flown))


def at(x: float, y: float, z: float) -> State:
    return replace(LEVEL, p_world=np.array([x, y, z]))


def balls(
    *coloured: tuple, labels: tuple[int, ...] = (0,), names: tuple[str, ...] = ("hall",)
) -> GaussianScene:
    """Opaque balls of 5 cm at positions with colours."""
    n = len(coloured)
    return GaussianScene(
        means=np.array([place for place, _ in coloured]),
        quaternions=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        scales=np.full((n, 3), 0.05),
        opacities=np.full(n, 0.99),
        sh=np.array([(colour - 0.5) / 0.28209479 for _, colour in coloured])[:, None],
        labels=np.array(labels, np.uint8),
        label_names=names,
    )


def middle_of(pixels: np.ndarray, channel: int) -> np.ndarray:
    """Mean position [px] of the pixels in which one channel is well above the others."""
    others = np.delete(pixels.astype(int), channel, axis=2).max(axis=2)
    rows, columns = np.nonzero(pixels[..., channel] - others > 60)
    return np.array([columns.mean() + 0.5, rows.mean() + 0.5])


@pytest.mark.parametrize("width", [160, 320, 640])
def test_focal_length_is_062_of_the_width(width):
    """tan(half the field) = 0.5 / 0.62, which is 38.9 deg, in every size."""
    camera = fpv_camera(width, width * 3 // 4)
    assert camera.fx == pytest.approx(0.62 * width, rel=1e-12)
    assert (camera.fy, camera.cx, camera.cy) == pytest.approx((camera.fx, width / 2, width * 3 / 8))


def test_ball_appears_where_the_pinhole_law_puts_it():
    """5 m ahead, 1 m left, 0.5 m up; camera 0.2 m ahead: u = 160 - 198.4 / 4.8, v = 120 - 99.2 /
    4.8. Half a pixel.
    """
    world = StillWorld(at(-5.0, 2.0, 1.0))
    view = RenderedView(world, balls(((0.0, 3.0, 1.5), RED)), fpv_camera(), (0.2, 0.0, 0.0))
    image = view.next_image(0.35)
    assert (image.pixels.shape, image.pixels.dtype) == ((240, 320, 3), np.uint8)
    assert middle_of(image.pixels, 0) == pytest.approx(
        [160 - 198.4 / 4.8, 120 - 99.2 / 4.8], abs=0.5
    )
    assert (image.sequence, image.t, world.flown) == (0, 0.35, [0.35])
    assert view.next_image(0.40).sequence == 1
    assert view.T_world_camera[:3, 3] == pytest.approx([-4.8, 2.0, 1.0])


def test_leader_is_rendered_at_its_place_and_only_if_there_is_one():
    """Green leader 4 m ahead, then 1 m to the right: 198.4 / 4 px. Without one: no green."""
    scene = balls(
        ((6.0, 2.0, 0.0), RED), ((0.0, 0.0, 0.0), GREEN), labels=(0, 1), names=("hall", "leader")
    )
    before = scene.means.copy()
    world = StillWorld(leader=at(4.0, 0.0, 0.0))
    view = RenderedView(world, scene, fpv_camera())
    assert middle_of(view.next_image(0.0).pixels, 1) == pytest.approx([160.0, 120.0], abs=0.5)
    world.leader_state = at(4.0, -1.0, 0.0)
    moved = view.next_image(0.05).pixels
    assert middle_of(moved, 1) == pytest.approx([160.0 + 198.4 / 4.0, 120.0], abs=0.5)
    assert middle_of(moved, 0) == pytest.approx([160.0 - 198.4 / 3.0, 120.0], abs=0.5)
    assert (scene.means == before).all()  # the caller's scene stays as it was
    alone = RenderedView(StillWorld(), scene, fpv_camera()).next_image(0.0).pixels
    with np.errstate(invalid="ignore"), pytest.warns(RuntimeWarning, match="Mean of empty"):
        assert np.isnan(middle_of(alone, 1)).all()


def test_the_link_of_a_scene_is_applied():
    """The link applied to the image without it; the frame's number seeds its noise."""
    scene, link = balls(((6.0, 0.0, 0.0), RED)), AnalogVideo(30.0, seed=4)
    plain = RenderedView(StillWorld(), scene, fpv_camera())
    noisy = RenderedView(StillWorld(), scene, fpv_camera(), link=link)
    clean = plain.next_image(0.0).pixels
    first, second = noisy.next_image(0.0).pixels, noisy.next_image(0.05).pixels
    assert (first == link.apply(clean, 1)).all() and (second == link.apply(clean, 2)).all()
    assert (first != second).any()


def test_hall_without_leader_gets_the_kits_own():
    """An aircraft 2 m ahead is 0.70 m wide: 198.4 * 0.70 / 2 = 69 px, +-10 % for its tips."""
    empty = balls(((6.0, 2.0, 0.0), RED))
    pixels = (
        RenderedView(StillWorld(leader=at(2.0, 0.0, 0.0)), empty, fpv_camera())
        .next_image(0.0)
        .pixels
    )
    columns = np.nonzero(pixels[100:140, 100:220].max(axis=(0, 2)) > 40)[0]
    assert np.ptp(columns) + 1 == pytest.approx(69.0, abs=7.0)


def test_measured_states_advance_the_world():
    """The state at t is the one measured after flying to t."""
    world = StillWorld()
    assert MeasuredStates(world).state_at(0.1).roll == pytest.approx(0.01)
    assert world.flown == [0.1]


class Wave:
    """A pilot whose commands depend on the step."""

    def act(self, observation: Observation) -> Command:
        return Command(0.5, 0.01 * round(observation.t / 0.05), 0.0, 0.0)


class GreyCamera:
    """An image every second step, grey like its number."""

    def next_image(self, t: float) -> Image:
        number = round(t / 0.05) // 2
        return Image(number, 0.1 * number, np.full((48, 64, 3), 10 * number, np.uint8))


@pytest.fixture
def recorded(tmp_path):
    """A log of ten steps."""
    with FlightLogWriter(tmp_path / "flight.mcap") as log:
        Loop(Wave(), Sink(), GreyCamera(), MeasuredStates(StillWorld()), log=log).run(0.5)
    return tmp_path / "flight.mcap"


class Sink:
    """A sink that keeps its commands."""

    def __init__(self) -> None:
        self.sent: list[Command] = []

    def send(self, t: float, command: Command) -> None:
        self.sent.append(command)


def test_a_replayed_log_gives_its_commands_images_and_states(recorded):
    """The recorded values at the recorded times; JPEG keeps a flat grey to two levels.

    Ten commands, and at 0.5 s the safe one that ends either flight.
    """
    sink, steps = Sink(), []
    pilot = RecordedPilot(recorded)
    loop = Loop(
        pilot, sink, RecordedImages(recorded), RecordedStates(recorded), hooks=(steps.append,)
    )
    loop.run(pilot.duration)
    assert [command.aileron for command in sink.sent] == pytest.approx(
        [*(0.01 * np.arange(10)), 0.0]
    )
    assert [step.image.sequence for step in steps] == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    assert [float(step.image.pixels.mean()) for step in steps[::2]] == pytest.approx(
        [0, 10, 20, 30, 40], abs=2.0
    )
    assert [step.state.roll for step in steps] == pytest.approx(0.01 * np.arange(1, 11))


@pytest.mark.parametrize("start", [0.0, 300.0, 1.7e9])
def test_a_clock_of_any_start_is_replayed_from_its_beginning(tmp_path, start):
    """Seconds since boot or since 1970: image 0 and the first state at 0, the last command at 0.2.

    Times are compared to a microsecond: at 1.7e9 s a double resolves a quarter of one.
    """
    with FlightLogWriter(tmp_path / "flight.mcap") as log:
        for k in range(5):
            t = start + 0.05 * k
            log.state(t, at(float(k), 0.0, 0.0))
            log.command(
                t, Command(0.5, 0.1 * k, 0.0, 0.0, k), Image(k, t, np.zeros((8, 8, 3), np.uint8))
            )
    pilot, sink, steps = RecordedPilot(tmp_path / "flight.mcap"), Sink(), []
    images, states = (kind(tmp_path / "flight.mcap") for kind in (RecordedImages, RecordedStates))
    assert pilot.duration == pytest.approx(0.2, abs=1e-6)
    Loop(pilot, sink, images, states, hooks=(steps.append,)).run(pilot.duration + 0.04)
    assert [command.aileron for command in sink.sent[:5]] == pytest.approx(
        [0.0, 0.1, 0.2, 0.3, 0.4]
    )
    assert [step.image.sequence for step in steps] == [0, 1, 2, 3, 4]
    assert [step.image.t for step in steps] == pytest.approx([0.0, 0.05, 0.1, 0.15, 0.2], abs=1e-6)
    assert [step.state.p_world[0] for step in steps] == [0.0, 1.0, 2.0, 3.0, 4.0]


def test_before_the_first_record_there_is_none(tmp_path):
    """A log whose images and states start at 0.2 s."""
    with FlightLogWriter(tmp_path / "late.mcap") as log:
        log.command(0.0, Command(0.1, 0.0, 0.0, 0.0))
        log.image(Image(7, 0.2, np.zeros((8, 8, 3), np.uint8)))
        log.state(0.2, LEVEL)
    images, states = RecordedImages(tmp_path / "late.mcap"), RecordedStates(tmp_path / "late.mcap")
    assert images.next_image(0.1) is None
    assert states.state_at(0.1) is None
    assert images.next_image(0.2).sequence == 7
    assert states.state_at(0.3).p_world == pytest.approx(0.0)


def test_colours_keep_their_order_through_a_log(tmp_path):
    """Red stays red although OpenCV's order is BGR. JPEG keeps a flat colour to a few levels."""
    with FlightLogWriter(tmp_path / "red.mcap") as log:
        log.image(Image(0, 0.0, np.full((16, 16, 3), (220, 30, 60), np.uint8)))
    (image,) = read_flight_log(tmp_path / "red.mcap").images()
    assert decode_jpeg(image)[8, 8] == pytest.approx([220, 30, 60], abs=4)


def test_damaged_images_and_empty_logs_are_refused(tmp_path):
    """One sentence each."""
    with pytest.raises(InputError, match="expected a JPEG"):
        decode_jpeg(Image(0, 0.0, np.arange(50, dtype=np.uint8)))
    with FlightLogWriter(tmp_path / "empty.mcap"):
        pass
    with pytest.raises(InputError, match="commands to replay"):
        RecordedPilot(tmp_path / "empty.mcap")
