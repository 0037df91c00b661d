"""Flight log: what was logged is read back, after a clean end, after a kill and after damage."""

import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import zlib

import numpy as np
import pytest

from falconwing_kit.core import flight_log
from falconwing_kit.core.checks import InputError
from falconwing_kit.core.flight_log import (
    FlightLogWriter,
    read_flight_log,
    recover,
    to_flight_table,
)
from falconwing_kit.core.frames import camera_pose
from falconwing_kit.core.messages import Command, Image, State

ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


def picture(sequence: int, size: int = 400) -> Image:
    """Bytes that stand for a JPEG: the log does not look inside."""
    pixels = np.random.default_rng(sequence).integers(0, 256, size, dtype=np.uint8)
    return Image(sequence, 100.0 + 0.05 * sequence, pixels)


def command(sequence: int) -> Command:
    return Command(0.5, 0.01 * sequence, -0.1, 0.2, image_sequence=sequence)


def state(sequence: int) -> State:
    return State.from_vector(np.arange(9.0) + sequence)


def fly(log: FlightLogWriter, frames: range) -> None:
    """A loop: image in, state and command out, 30 ms after the image."""
    for k in frames:
        log.state(picture(k).t, state(k), image_sequence=k)
        log.command(picture(k).t + 0.03, command(k), picture(k))


@pytest.fixture
def whole(tmp_path):
    """A log of 20 frames that was closed cleanly."""
    path = tmp_path / "whole.mcap"
    with FlightLogWriter(path) as log:
        log.metadata({"aircraft": "umx", "mass_g": 150})
        fly(log, range(20))
        log.event(101.0, "touchdown", {"sink_rate": 0.4, "wheels": np.array([1, 1, 0])})
    return path


@pytest.fixture
def interrupted(tmp_path):
    """The same 20 frames as they stand in the file in mid-flight, and the file's size after each
    command.
    """
    sizes = []
    with FlightLogWriter(tmp_path / "flying.mcap") as log:
        for k in range(20):
            fly(log, range(k, k + 1))
            sizes.append(os.path.getsize(tmp_path / "flying.mcap"))
        shutil.copy(tmp_path / "flying.mcap", tmp_path / "interrupted.mcap")
    return tmp_path / "interrupted.mcap", sizes


# A clean end.


def test_everything_comes_back(whole):
    """Each record as it was given to the writer."""
    log = read_flight_log(whole)
    assert log.commands == tuple(command(k) for k in range(20))
    assert log.command_times == pytest.approx([100.03 + 0.05 * k for k in range(20)], abs=1e-9)
    assert np.array_equal([s.vector for s in log.states], [state(k).vector for k in range(20)])
    assert log.state_sequences.tolist() == log.image_sequences.tolist() == list(range(20))
    assert (log.events[0].t, log.events[0].name, log.events[0].details) == (
        101.0,
        "touchdown",
        {"sink_rate": 0.4, "wheels": [1, 1, 0]},
    )
    assert log.metadata == {"aircraft": "umx", "mass_g": "150"} and log.warnings == ()
    for k, image in enumerate(log.images()):
        assert image.sequence == k and np.array_equal(image.pixels, picture(k).pixels)
        assert image.t == pytest.approx(picture(k).t, abs=1e-9)


def test_another_library_reads_the_closed_log(whole):
    """The mcap library's own indexed reader, which needs index and summary, finds the same 61
    records, and what Foxglove draws of them: a frame and the motion of each state, the camera's
    frame once, each event as text.
    """
    from mcap.reader import make_reader

    with whole.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        topics = [channel.topic for _, channel, _ in reader.iter_messages()]
        schemas = {schema.name for schema in reader.get_summary().schemas.values()}
        chunks = reader.get_summary().chunk_indexes
    assert {topic: topics.count(topic) for topic in set(topics)} == {
        "/image": 20,
        "/command": 20,
        "/state": 20,
        "/event": 1,
        "/frame/aircraft": 20,
        "/frame/camera": 1,
        "/motion": 20,
        "/text": 1,
    }
    own, published = ("command", "state", "leader", "event", "motion"), ("CompressedImage",)
    published += ("FrameTransform", "Log")
    assert schemas == {*own, *(f"foxglove.{name}" for name in published)}
    assert {chunk.compression for chunk in chunks} == {"zstd"}


def test_command_is_written_before_its_image(interrupted):
    """If the disk fills up between the two, the command is the more important one."""
    data = interrupted[0].read_bytes()
    for k in range(20):
        assert data.index(json.dumps(command(k).record)[1:-1].encode()) < data.index(
            picture(k).pixels.tobytes()
        )


def test_raw_pixels_are_packed_as_jpeg(tmp_path):
    """A grey image comes back grey within JPEG's rounding, red stays red: OpenCV's order of colours
    is the other.
    """
    import cv2

    pixels = np.zeros((16, 16, 3), np.uint8)
    pixels[..., 0] = 200
    with FlightLogWriter(tmp_path / "a.mcap") as log:
        log.image(Image(0, 0.0, pixels))
    image = next(read_flight_log(tmp_path / "a.mcap").images())
    back = cv2.imdecode(image.pixels, cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(back.astype(int) - pixels).max() <= 3


def test_unknown_numbers_stay_unknown(tmp_path):
    """JSON has no nan; the log writes null and reads nan."""
    vector = np.array([1.0, np.nan, 3, 4, 5, 6, 7, 8, 9])
    with FlightLogWriter(tmp_path / "a.mcap") as log:
        log.state(0.0, State.from_vector(vector))
    assert np.array_equal(
        read_flight_log(tmp_path / "a.mcap").states[0].vector[:9], vector, equal_nan=True
    )


def test_an_error_in_flight_still_closes_the_log(tmp_path):
    """The loop's own error comes through and the log is packed with all that was logged."""
    with pytest.raises(ZeroDivisionError), FlightLogWriter(tmp_path / "a.mcap") as log:
        fly(log, range(3))
        raise ZeroDivisionError
    assert len(read_flight_log(tmp_path / "a.mcap").commands) == 3
    assert read_flight_log(tmp_path / "a.mcap").warnings == ()


def test_a_log_is_never_overwritten(whole):
    """A flight cannot be flown again."""
    with pytest.raises(InputError, match="never overwritten"):
        FlightLogWriter(whole)


def test_a_disk_too_full_to_pack_keeps_the_recording(tmp_path, monkeypatch):
    """Packing needs room for a second file; without it the log stays as recorded, complete."""

    def refuse(*_):
        raise InputError("the disk is full")

    monkeypatch.setattr(flight_log, "_rewrite", refuse)
    with (
        pytest.warns(UserWarning, match="stays unpacked"),
        FlightLogWriter(tmp_path / "a.mcap") as log,
    ):
        fly(log, range(3))
    log = read_flight_log(tmp_path / "a.mcap")
    assert len(log.commands) == 3 and log.warnings == ()


@pytest.mark.parametrize(
    ("write", "sentence"),
    [
        (lambda log: log.command(np.nan, command(0)), "t: expected a finite number"),
        (lambda log: log.command(-1.0, command(0)), "t: expected a finite number"),
        (
            lambda log: log.command(0.0, Command(np.nan, 0.0, 0.0, 0.0)),
            "expected texts and finite numbers",
        ),
        (lambda log: log.event(0.0, "x", {"what": object()}), "expected texts and finite numbers"),
        (lambda log: log.image(Image(-1, 0.0, np.zeros(3, np.uint8))), "expected a count from 0"),
    ],
)
def test_senseless_records_are_refused(tmp_path, write, sentence):
    """The record is not logged; the log goes on."""
    with FlightLogWriter(tmp_path / "a.mcap") as log:
        with pytest.raises(InputError, match=sentence):
            write(log)
        log.command(1.0, command(0))
    assert len(read_flight_log(tmp_path / "a.mcap").commands) == 1


# A kill, a cut, a full disk.

WRITER = """
import sys
import time
import numpy as np
from falconwing_kit.core.flight_log import FlightLogWriter
from falconwing_kit.core.messages import Command, Image
pixels = np.random.default_rng(0).integers(0, 256, 31_000, dtype=np.uint8)
with FlightLogWriter(sys.argv[1]) as log:
    for k in range(10**9):
        log.command(k * 0.05, Command(0.5, 0.0, 0.0, 0.0, image_sequence=k))
        print(k, flush=True)
        if k == int(sys.argv[2]):
            time.sleep(600)
        log.image(Image(k, k * 0.05, pixels))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL is POSIX")
@pytest.mark.parametrize(
    ("frames", "pause"), [(1, -1), (7, -1), (40, -1), (111, -1), (300, -1), (25, 24)]
)
def test_a_kill_loses_no_acknowledged_command(tmp_path, frames, pause):
    """A program is killed while it writes at full speed, or right after a command: what it
    acknowledged is there.
    """
    path = tmp_path / "killed.mcap"
    program = [sys.executable, "-c", WRITER, str(path), str(pause)]
    with subprocess.Popen(program, stdout=subprocess.PIPE, env=ENVIRONMENT, text=True) as child:
        acknowledged = [int(child.stdout.readline()) for _ in range(frames)]
        child.send_signal(signal.SIGKILL)
        acknowledged += [int(line) for line in child.stdout if line.endswith("\n")]
    log = read_flight_log(path)
    assert [c.image_sequence for c in log.commands][: len(acknowledged)] == acknowledged
    assert log.image_sequences.tolist()[: len(acknowledged) - 1] == acknowledged[:-1]
    assert "interrupted" in log.warnings[0]
    assert os.listdir(tmp_path) == ["killed.mcap"]
    report = recover(path, tmp_path / "saved.mcap")
    assert report.counts["/command"] == len(log.commands) and report.counts["/image"] == len(
        log.image_times
    )
    assert read_flight_log(tmp_path / "saved.mcap").warnings == ()


def test_a_cut_log_keeps_all_whole_records(interrupted, tmp_path):
    """Cut at 200 places: command k is there exactly if the cut lies behind the size the file had
    after it.

    The command stands before its image, so the image's own bytes may be cut: sizes are those before
    the image.
    """
    path, sizes = interrupted
    data = path.read_bytes()
    image_record = 9 + 22 + 400  # opcode and length, message header, pixels
    ends = [size - image_record for size in sizes]
    for cut in np.linspace(8, len(data), 200).astype(int):
        (tmp_path / "cut.mcap").write_bytes(data[:cut])
        log = read_flight_log(tmp_path / "cut.mcap")
        assert len(log.commands) == sum(end <= cut for end in ends), cut
        assert len(log.image_times) == sum(size <= cut for size in sizes), cut
        assert len(log.warnings) == 1 and "closing record" in log.warnings[0]
    assert cut == len(data)


def test_a_cut_packed_log_reads_or_says_why(whole, tmp_path):
    """Cut at 200 places: never another error, and what is read is the start of the flight."""
    data = whole.read_bytes()
    counts = []
    for cut in np.linspace(0, len(data), 200).astype(int):
        (tmp_path / "cut.mcap").write_bytes(data[:cut])
        if cut < 8:
            with pytest.raises(InputError, match="expected a flight log in MCAP format"):
                read_flight_log(tmp_path / "cut.mcap")
        else:
            log = read_flight_log(tmp_path / "cut.mcap")
            assert log.commands == tuple(command(k) for k in range(len(log.commands)))
            counts.append(len(log.commands))
    assert counts[-1] == 20 and counts == sorted(counts)


@pytest.mark.skipif(
    sys.platform == "win32", reason="the system's file size limit exists on POSIX only"
)
def test_a_full_disk_in_flight_is_one_sentence_and_keeps_the_log(tmp_path):
    """The kernel refuses to let the file grow beyond 20,000 bytes; what was acknowledged before can
    be read.
    """
    program = """if True:
        import resource
        resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))
        import numpy as np
        from falconwing_kit.core.flight_log import FlightLogWriter
        from falconwing_kit.core.messages import Command, Image
        try:
            with FlightLogWriter("full.mcap") as log:
                for k in range(1000):
                    log.command(k * 0.05, Command(0.5, 0.0, 0.0, 0.0, image_sequence=k))
                    print(k)
                    log.image(Image(k, k * 0.05, np.zeros(500, np.uint8)))
        except ValueError as error:
            print(type(error).__name__, error)
        """
    result = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=60,
    )
    *acknowledged, sentence = result.stdout.splitlines()
    assert sentence.startswith("InputError full.mcap: the disk is full"), result.stderr
    commands = read_flight_log(tmp_path / "full.mcap").commands
    assert [c.image_sequence for c in commands] == [int(k) for k in acknowledged]
    assert len(acknowledged) > 10 and os.listdir(tmp_path) == ["full.mcap"]


# Damage.


def test_length_fields_of_all_sizes_allocate_nothing(interrupted, tmp_path):
    """A record that claims 2^16 .. 2^63 bytes more than there are: reading stops there, with a
    warning.
    """
    path, sizes = interrupted
    data = bytearray(path.read_bytes())
    for power in (16, 31, 32, 40, 62, 63):
        data[sizes[4] + 1 : sizes[4] + 9] = struct.pack("<Q", 2**power)
        (tmp_path / "bad.mcap").write_bytes(data)
        log = read_flight_log(tmp_path / "bad.mcap")
        assert len(log.commands) == 5 and "cannot be read" in log.warnings[0]


def chunk_record(data: bytes, claimed: int, compression: bytes = b"zstd") -> bytes:
    """A chunk record written by hand from the specification."""
    body = (
        struct.pack("<QQQI", 0, 0, claimed, 0) + struct.pack("<I", len(compression)) + compression
    )
    body += struct.pack("<Q", len(data)) + data
    return struct.pack("<BQ", 0x06, len(body)) + body


@pytest.mark.parametrize("claimed", [2**63, 2**31, 1_000_000_000, 1000])
def test_a_decompression_bomb_does_not_go_off(tmp_path, claimed):
    """1 GB of zeros packed by zstd to 30 kB, with honest and dishonest sizes: left out, and little
    memory used.
    """
    import tracemalloc

    import zstandard

    packer = zstandard.ZstdCompressor().compressobj()
    bomb = b"".join([*(packer.compress(bytes(10**7)) for _ in range(100)), packer.flush()])
    path = tmp_path / "bomb.mcap"
    path.write_bytes(flight_magic() + chunk_record(bomb, claimed) + struct.pack("<BQI", 0x0F, 4, 0))
    read_flight_log(path)
    tracemalloc.start()
    log = read_flight_log(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "damaged records left out: 1" in log.warnings[0]
    assert peak < 20 * len(bomb)


def flight_magic() -> bytes:
    """The eight bytes of the specification."""
    return b"\x89MCAP0\r\n"


def test_a_chunk_with_flipped_bits_is_left_out(whole, tmp_path):
    """The checksum of the chunk does not fit; the metadata outside of it are still read."""
    data = bytearray(whole.read_bytes())
    at = data.index(b"zstd") + 200
    data[at] ^= 0x10
    (tmp_path / "flipped.mcap").write_bytes(data)
    log = read_flight_log(tmp_path / "flipped.mcap")
    assert log.commands == () and log.metadata["aircraft"] == "umx"
    assert "damaged records left out: 1" in log.warnings[0]


def test_a_record_that_is_no_json_is_left_out(interrupted, tmp_path):
    """One command's text is spoilt; the other nineteen are read and the warning counts it."""
    data = interrupted[0].read_bytes()
    (tmp_path / "spoilt.mcap").write_bytes(data.replace(b'"throttle": 0.5', b'"throttle"! 0.5', 1))
    log = read_flight_log(tmp_path / "spoilt.mcap")
    assert len(
        log.commands
    ) == 19 and "records of /command that could not be parsed: 1" in " ".join(log.warnings)


@pytest.mark.parametrize("compression", ["lz4", ""])
def test_chunks_of_other_writers_are_read(tmp_path, compression):
    """A log of another program, with lz4 or uncompressed; its checksum is computed here by zlib."""
    import lz4.frame

    body = json.dumps({"t": 1.0, **command(3).record}).encode()
    channel = struct.pack("<HH", 1, 0) + b"".join(
        struct.pack("<I", len(x)) + x for x in (b"/command", b"json")
    )
    channel += struct.pack("<I", 0)
    message = struct.pack("<HIQQ", 1, 0, 10**9, 10**9) + body
    records = b"".join(
        struct.pack("<BQ", op, len(x)) + x for op, x in ((0x04, channel), (0x05, message))
    )
    packed = lz4.frame.compress(records) if compression else records
    chunk = bytearray(chunk_record(packed, len(records), compression.encode()))
    chunk[9 + 24 : 9 + 28] = struct.pack("<I", zlib.crc32(records))
    (tmp_path / "other.mcap").write_bytes(flight_magic() + chunk + struct.pack("<BQI", 0x0F, 4, 0))
    assert read_flight_log(tmp_path / "other.mcap").commands == (command(3),)


@pytest.mark.parametrize(
    ("content", "word"), [(b"", "an empty file"), (b"t,px,py\n" * 9, "another kind of file")]
)
def test_other_files_are_refused(tmp_path, content, word):
    """One sentence; the file's name is in it."""
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(InputError, match=rf"a\.mcap: .*{word}"):
        read_flight_log(tmp_path / "a.mcap")


def test_recovering_keeps_the_damaged_log(interrupted):
    """The only copy of a flight is not replaced by what one program could read of it."""
    with pytest.raises(InputError, match="another name"):
        recover(interrupted[0], interrupted[0])


# What Foxglove draws, and logs with raw images of earlier versions.


def messages(path) -> dict[str, list]:
    """The JSON messages of each topic, as the mcap library reads them, with their log times."""
    from mcap.reader import make_reader

    found: dict[str, list] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            record = json.loads(message.data)
            found.setdefault(channel.topic, []).append((message.log_time, record))
    return found


def test_images_are_compressed_images_for_foxglove(whole):
    """Names and fields of docs.foxglove.dev; Python's base64 gives back the bytes of the frame."""
    from base64 import b64decode

    for k, (log_time, record) in enumerate(messages(whole)["/image"]):
        assert record.keys() == {"timestamp", "frame_id", "data", "format"}
        assert b64decode(record["data"]) == picture(k).pixels.tobytes()
        assert (record["format"], record["frame_id"]) == ("jpeg", "camera")
        assert record["timestamp"] == {"sec": log_time // 10**9, "nsec": log_time % 10**9}


def test_frames_are_where_aircraft_camera_and_leader_are(tmp_path):
    """SciPy turns the quaternions into matrices: those of `rotation_world_body` and of the kit's
    camera; the camera sits 20 cm before the centre of gravity, as the metadata say.
    """
    from scipy.spatial.transform import Rotation

    def matrix(record: dict) -> np.ndarray:
        T = np.eye(4)
        T[:3, :3] = Rotation.from_quat([record["rotation"][k] for k in "xyzw"]).as_matrix()
        T[:3, 3] = [record["translation"][k] for k in "xyz"]
        return T

    angles = {"roll": 0.4, "pitch": -0.3, "yaw": 2.0}
    aircraft = State(np.array([1.0, -2.0, 3.0]), v_world=np.array([3.0, 4.0, 0.0]), **angles)
    leader = State(np.array([5.0, -2.0, 3.0]), 0.1, -0.2, 0.3, np.zeros(3))
    path = tmp_path / "a.mcap"
    with FlightLogWriter(path) as log:
        log.metadata({"p_body_camera": "[0.2, 0.0, -0.01]"})
        log.leader(2.5, leader)
        log.state(2.5, aircraft)
    found = messages(path)
    ((_, of_aircraft),), ((_, of_leader),) = found["/frame/aircraft"], found["/frame/leader"]
    ((_, of_camera),), ((_, motion),) = found["/frame/camera"], found["/motion"]
    assert matrix(of_aircraft) == pytest.approx(aircraft.pose.T_world_body, abs=1e-12)
    assert matrix(of_leader) == pytest.approx(leader.pose.T_world_body, abs=1e-12)
    T_world_camera = camera_pose(aircraft.pose.T_world_body, [0.2, 0.0, -0.01])
    assert matrix(of_aircraft) @ matrix(of_camera) == pytest.approx(T_world_camera, abs=1e-12)
    names = [(r["parent_frame_id"], r["child_frame_id"]) for r in (of_aircraft, of_camera)]
    assert names == [("world", "aircraft"), ("aircraft", "camera")]
    assert of_leader["child_frame_id"] == "leader"
    assert of_aircraft["timestamp"] == {"sec": 2, "nsec": 500_000_000}
    assert (motion["height_m"], motion["speed_m_s"]) == (3.0, 5.0)
    assert motion["roll_deg"] == pytest.approx(np.degrees(0.4))
    back = read_flight_log(path)
    assert np.array_equal(back.leaders[0].vector, leader.vector)
    assert back.leader_times.tolist() == [2.5]


def test_a_lost_pose_has_no_frame(tmp_path):
    """Foxglove must not be sent nan, which JSON does not have; the state itself stays, as null."""
    lost = State.from_vector(np.full(12, np.nan))
    with FlightLogWriter(tmp_path / "a.mcap") as log:
        log.state(0.0, lost)
        log.leader(0.0, lost)
        log.state(0.05, state(1))
    found = messages(tmp_path / "a.mcap")
    assert len(found["/state"]) == 2 and len(found["/frame/aircraft"]) == 1
    assert "/frame/leader" not in found and len(read_flight_log(tmp_path / "a.mcap").leaders) == 1


def packed_with_raw_images(source, target) -> None:
    """A log as version 0.2.0 packed it: the same records in compressed chunks, images as JPEG."""
    from mcap.records import Channel, Message, Metadata, Schema
    from mcap.writer import Writer

    with target.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="falconwing")
        schemas, channels = {0: 0}, {}
        for record in flight_log.read_mcap_records(source, []):
            if isinstance(record, Schema):
                number = writer.register_schema(record.name, record.encoding, record.data)
                schemas[record.id] = number
            elif isinstance(record, Channel):
                channels[record.id] = writer.register_channel(
                    record.topic, record.message_encoding, schemas[record.schema_id]
                )
            elif isinstance(record, Metadata):
                writer.add_metadata(record.name, record.metadata)
            elif isinstance(record, Message):
                number = channels[record.channel_id]
                writer.add_message(
                    number, record.log_time, record.data, record.publish_time, record.sequence
                )
        writer.finish()


def test_logs_of_earlier_versions_are_read_and_renewed(interrupted, tmp_path):
    """Images come back from the older form, and `recover` makes the present one of it; a second
    time it changes nothing.
    """
    old, new, again = (tmp_path / f"{name}.mcap" for name in ("old", "new", "again"))
    packed_with_raw_images(interrupted[0], old)
    assert recover(old, new).counts == recover(new, again).counts
    for path in (old, new, again):
        log = read_flight_log(path)
        assert log.warnings == () and log.commands == tuple(command(k) for k in range(20))
        for k, image in enumerate(log.images()):
            assert image.sequence == k and np.array_equal(image.pixels, picture(k).pixels)
        assert k == 19
    assert "foxglove.CompressedImage" not in old.read_bytes().decode("latin-1")
    assert messages(new) == messages(again) and len(messages(new)["/frame/aircraft"]) == 20


@pytest.mark.parametrize(
    "data",
    [b"{", b"[]", b'{"format": "png", "data": ""}', b'{"format": "jpeg", "data": "a"}',
     b'{"format": "jpeg", "data": 7}', b"[" * 2000],
)  # fmt: skip
def test_an_image_that_is_none_is_counted_and_left_out(tmp_path, data):
    """One good image beside it; the warning counts the bad one, and `images` gives the other."""
    from mcap.writer import Writer

    from falconwing_kit.core.foxglove import pack_image

    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/image", "json", 0)
        for sequence, content in enumerate((data, pack_image(0, b"jpeg"))):
            writer.add_message(channel, 0, content, 0, sequence)
        writer.finish()
    log = read_flight_log(tmp_path / "a.mcap")
    assert [image.sequence for image in log.images()] == log.image_sequences.tolist() == [1]
    assert "records of /image that could not be parsed: 1" in log.warnings[0]


def test_a_camera_place_that_is_none_does_not_stop_the_packing(tmp_path):
    """Metadata of another writer: the camera's frame is the aircraft's, nothing else is lost."""
    for number, text in enumerate(('"x"', "[1, 2]", "[1, 2, NaN]", "{")):
        path = tmp_path / f"{number}.mcap"
        with FlightLogWriter(path) as log:
            log.metadata({"p_body_camera": text})
            log.state(0.0, state(0))
        ((_, record),) = messages(path)["/frame/camera"]
        assert record["translation"] == {"x": 0.0, "y": 0.0, "z": 0.0}


# The way to the flight table.


def test_table_has_one_row_per_image_with_its_own_command(whole):
    """By hand: row k has the time of image k, state k and the command that answers image k, given
    30 ms later.
    """
    table = to_flight_table(read_flight_log(whole))
    assert table.t == pytest.approx([100.0 + 0.05 * k for k in range(20)], abs=1e-9)
    assert table.commands[:, 1] == pytest.approx([0.01 * k for k in range(20)], abs=1e-15)
    assert table.p_world[2].tolist() == [2.0, 3.0, 4.0]
    assert table.attitude[2].tolist() == [
        7.0,
        5.0,
        6.0,
    ]  # roll, pitch, yaw; the state has pitch, yaw, roll
    assert table.extra["vx"][2] == 8.0 and "p" not in table.extra and table.warnings == ()


def test_frames_without_state_have_no_pose(tmp_path):
    """Image 1 has no state; none is interpolated from its neighbours 50 ms away."""
    with FlightLogWriter(tmp_path / "a.mcap") as log:
        for k in range(4):
            log.command(picture(k).t + 0.03, command(k), picture(k))
            if k != 1:
                log.state(picture(k).t, state(k), image_sequence=k)
    assert to_flight_table(read_flight_log(tmp_path / "a.mcap")).has_pose.tolist() == [
        True,
        False,
        True,
        True,
    ]


def test_without_sequence_numbers_time_decides(tmp_path):
    """A pilot flies by hand at 10 Hz: frames take the last command given and the state nearest in
    time.
    """
    with FlightLogWriter(tmp_path / "a.mcap") as log:
        for k in range(6):
            log.image(Image(k, 0.05 * k, np.zeros(3, np.uint8)))
            log.state(0.05 * k + 0.002, state(k))
        for k in range(3):
            log.command(0.04 + 0.1 * k, Command(0.1 * k, 0.0, 0.0, 0.0))
    table = to_flight_table(read_flight_log(tmp_path / "a.mcap"))
    assert table.t == pytest.approx([0.05, 0.1, 0.15, 0.2, 0.25], abs=1e-9)
    assert table.commands[:, 0] == pytest.approx([0.0, 0.0, 0.1, 0.1, 0.2])
    assert table.p_world[:, 0].tolist() == [1, 2, 3, 4, 5]
    assert "no command was given yet: 1" in table.warnings[-1]


def test_without_images_the_states_are_the_rows(tmp_path):
    """A simulated flight needs no pictures."""
    with FlightLogWriter(tmp_path / "a.mcap") as log:
        for k in range(5):
            log.state(0.05 * k, state(k), image_sequence=k)
            log.command(0.05 * k, command(k))
    table = to_flight_table(read_flight_log(tmp_path / "a.mcap"))
    assert table.has_pose.all() and table.commands[:, 1] == pytest.approx(
        [0.01 * k for k in range(5)]
    )


def test_repeated_image_stamps_do_not_break_the_table(tmp_path):
    """A camera that repeats a stamp: the table's time still increases, one row per stamp."""
    with FlightLogWriter(tmp_path / "a.mcap") as log:
        for k, t in enumerate([0.0, 0.05, 0.05, 0.1]):
            log.command(t, command(k), Image(k, t, np.zeros(3, np.uint8)))
    assert len(to_flight_table(read_flight_log(tmp_path / "a.mcap")).t) == 3


def test_a_log_without_commands_gives_no_table(tmp_path):
    """A flight table needs commands; the sentence says so."""
    with FlightLogWriter(tmp_path / "a.mcap") as log:
        log.state(0.0, state(0))
    with pytest.raises(InputError, match="expected a log with commands"):
        to_flight_table(read_flight_log(tmp_path / "a.mcap"))
