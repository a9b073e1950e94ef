"""Recordings in parts, without an index, cut short, damaged, or in other encodings."""

import shutil
import struct
from zlib import crc32

import numpy as np
import pytest

from steelnb.core.errors import InputError
from steelnb.io import read_flight
from steelnb.io.containers import typestore
from steelnb.io.messages import CLOUD, ODOMETRY, TF
from tests.io.samples import KINDS, POINTS, STAMPS, Bagged, T_of, ns, poses

MAGIC = b"\x89MCAP0\r\n"


def part(path, begin, end, shift_s=0.0):
    """A bag with some of the flight's scans and poses."""
    whole = poses(len(STAMPS))
    some = type(whole)(STAMPS[begin:end] + shift_s, whole.T_world_drone[begin:end])
    return Bagged(path).clouds(stamps=some.stamp_s).odometry(trajectory=some).write()


def assert_whole(flight):
    np.testing.assert_array_equal(flight.prior.stamp_s, STAMPS)
    np.testing.assert_allclose(flight.prior.T_world_drone, poses(5).T_world_drone, atol=1e-12)
    assert [scan.fault for scan in flight.scans] == [""] * 5


def mcap(path, ros=2, encoding="cdr", chunk_messages=4, compression="", short_names=False, cloud=CLOUD):
    """An MCAP file with a chunk index, but without indices of messages."""
    text = lambda value: struct.pack("<I", len(value)) + value.encode()  # noqa: E731
    record = lambda kind, body: bytes([kind]) + struct.pack("<Q", len(body)) + body  # noqa: E731
    bag, store = Bagged(path.with_suffix(".bag" if ros == 1 else ".mcap")).clouds().odometry(), typestore(ros)
    names = {"/points": cloud, "/odom": ODOMETRY}
    head, blocks, index = b"", [b""], b""
    for k, (topic, kind) in enumerate(names.items(), 1):
        name = kind.replace("/msg/", "/") if ros == 1 or short_names else kind
        head += record(3, struct.pack("<H", k) + text(name) + text(f"ros{ros}msg") + text(""))
        head += record(4, struct.pack("<HH", k, k) + text(topic) + text(encoding) + struct.pack("<I", 0))
    for n, (topic, kind, stamp, message) in enumerate(sorted(bag.rows, key=lambda row: row[2])):
        data = bytes(store.serialize_ros1(message, kind) if ros == 1 else store.serialize_cdr(message, kind))
        times = struct.pack("<HIQQ", 1 + list(names).index(topic), n, ns(stamp), ns(stamp))
        blocks = [*blocks, b""] if n and n % chunk_messages == 0 else blocks
        blocks[-1] += record(5, times + data)
    out = MAGIC + record(1, text(f"ros{ros}") + text("hand"))
    for k, block in enumerate(blocks):
        raw = head + block if k == 0 else block
        sizes = struct.pack("<QQQI", 0, ns(9), len(raw), crc32(raw)) + text(compression) + struct.pack("<Q", len(raw))
        chunk = record(6, sizes + raw)
        times = struct.pack("<QQQQIQ", 0, ns(9), len(out), len(chunk), 0, 0)
        index += record(8, times + text(compression) + struct.pack("<QQ", len(raw), len(raw)))
        out += chunk
    out += record(15, struct.pack("<I", 0))
    counts = struct.pack("<QHIIIIQQI", 10, 2, 2, 0, 0, len(blocks), 0, ns(9), 20) + struct.pack("<HQHQ", 1, 5, 2, 5)
    summary = len(out)
    out += head + index + record(11, counts) + record(2, struct.pack("<QQI", summary, 0, 0)) + MAGIC
    path.write_bytes(out)
    return path


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_a_folder_of_parts_is_one_recording(tmp_path, suffix):
    folder = tmp_path / "parts"
    folder.mkdir()
    for name, begin, end in (("b", 0, 2), ("c", 2, 4), ("a", 4, 5)):
        shutil.move(part(tmp_path / f"{name}{suffix}", begin, end), folder)
    (folder / "notes.txt").write_text("windy")
    flight = read_flight(folder)
    assert_whole(flight)
    assert flight.name == "parts"
    listed = "".join(f"    - parts/{name}{suffix}\n" for name in "bcx")
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{listed}")
    if suffix != ".bag":
        found = read_flight(folder)
        assert len(found) == 4
        assert found.facts["notes"] == f"metadata.yaml names x{suffix}, which is missing; what is whole is read"


@pytest.mark.parametrize(("shift_s", "words"), [(600.0, "b.mcap begins 599 s"), (0.0, "b.mcap begins 1 s")])
def test_several_recordings_in_a_folder_are_listed(tmp_path, shift_s, words):
    folder = tmp_path / "days"
    folder.mkdir()
    for name, begin_s in (("a", 0.0), ("b", shift_s), ("c", 2 * shift_s)):
        shutil.move(part(tmp_path / f"{name}.mcap", 0, 5, begin_s), folder)
    with pytest.raises(InputError, match=rf"days: bags in it: a.mcap, b.mcap, c.mcap; {words}"):
        read_flight(folder)
    parent = tmp_path / "parent"
    shutil.copytree(folder, parent / "one")
    with pytest.raises(InputError, match=r"parent: bags in it: one; expected one of them"):
        read_flight(parent)


@pytest.mark.parametrize(("ros", "encoding"), [(2, "cdr"), (1, "ros1")])
def test_an_mcap_without_an_index_of_messages_or_of_ros_1_is_read(tmp_path, ros, encoding):
    flight = read_flight(mcap(tmp_path / "a.mcap", ros, encoding))
    assert_whole(flight)
    assert "notes" not in flight.facts


def test_an_mcap_of_another_encoding_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"a.mcap: messages in protobuf; expected cdr or ros1"):
        read_flight(mcap(tmp_path / "a.mcap", encoding="protobuf"))


@pytest.mark.parametrize("kind", [*KINDS, "a.bag.active"])
@pytest.mark.parametrize("share", [0.6, 0.9])
def test_of_a_file_that_is_cut_short_what_is_whole_is_read(tmp_path, kind, share):
    points = np.random.default_rng(0).normal(size=(30, 40, 3)).astype(np.float32).astype(float)
    whole = Bagged(tmp_path / kind.replace(".active", "")).clouds(points=points).odometry().write()
    cut = tmp_path / f"cut{kind[1:]}"
    cut.write_bytes(whole.read_bytes()[: int(share * whole.stat().st_size)])
    flight = read_flight(cut)
    assert 1 <= len(flight) <= 5
    for scan in flight.scans:
        np.testing.assert_array_equal(scan.points, points)
    assert f"{cut.name} is cut short or damaged" in flight.facts["notes"]
    cut.write_bytes(whole.read_bytes()[:60])
    with pytest.raises(InputError, match=rf"{cut.name}: no whole message in it .*expected"):
        read_flight(cut)


def test_poses_that_damage_takes_are_said_to_be_missing(tmp_path):
    """The index counts them, but no message is whole."""
    path = Bagged(tmp_path / "a.mcap").clouds().odometry().write()
    content = bytearray(path.read_bytes())
    content[content.index(b"/odom") + 46] = 0xFF
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"a.mcap: no message of /odom can be read \(.* damaged"):
        read_flight(path)


def test_a_damaged_chunk_costs_only_its_messages(tmp_path):
    path = mcap(tmp_path / "a.mcap", chunk_messages=2)
    data = bytearray(path.read_bytes())
    second = data.index(POINTS.astype("<f4").tobytes(), 1500)
    data[second : second + 20] = bytes(20)
    path.write_bytes(data)
    flight = read_flight(path)
    assert len(flight) == 4
    assert flight.facts["notes"] == "a.mcap has a damaged chunk; what is whole is read"
    for scan in flight.scans:
        np.testing.assert_array_equal(scan.points, POINTS)


def test_compressed_files_without_metadata_are_refused(tmp_path):
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "a.mcap.zstd", tmp_path / "folder" / "a.db3.zstd"):
        path.write_bytes(b"\x28\xb5\x2f\xfd")
        with pytest.raises(InputError, match=r"is compressed; expected it unpacked \(`unzstd a"):
            read_flight(path if "folder" not in str(path) else path.parent)


@pytest.mark.parametrize("mode", ["FILE", "MESSAGE"])
def test_a_compressed_ros_2_folder_is_read(tmp_path, mode):
    from rosbags import rosbag2

    bag, store = Bagged(tmp_path / "a.db3").clouds().odometry(), typestore(2)
    writer = rosbag2.Writer(tmp_path / "folder", version=8)
    writer.set_compression(rosbag2.CompressionMode[mode], rosbag2.CompressionFormat.ZSTD)
    with writer:
        topics = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind, _, _ in bag.rows[::5]}
        for topic, kind, stamp, message in sorted(bag.rows, key=lambda row: row[2]):
            writer.write(topics[topic], ns(stamp), store.serialize_cdr(message, kind))
    assert_whole(read_flight(tmp_path / "folder"))
    if mode == "MESSAGE":
        (tmp_path / "folder" / "metadata.yaml").unlink()
        assert_whole(read_flight(tmp_path / "folder"))


def test_an_unmerged_journal_is_told(tmp_path):
    path = part(tmp_path / "a.db3", 0, 5)
    for name in ("a.db3-wal", "a.db3-journal"):
        (tmp_path / name).write_bytes(b"more")
        assert f"a.db3 is not all: {name} beside it has more" in read_flight(path).facts["notes"]
        (tmp_path / name).unlink()


def test_types_may_be_named_as_in_ros_1(tmp_path):
    assert_whole(read_flight(mcap(tmp_path / "hand.mcap", short_names=True)))


@pytest.mark.parametrize(
    ("kind", "what"),
    [
        ("ouster_ros/msg/PacketMsg", "packets of a LiDAR, not points; expected clouds"),
        ("velodyne_msgs/msg/VelodyneScan", "packets of a LiDAR, not points; expected clouds"),
        ("hesai_ros_driver/msg/UdpFrame", "packets of a LiDAR, not points; expected clouds"),
        ("livox_ros_driver2/msg/CustomMsg", "a Livox's own message; expected PointCloud2, .* xfer_format 0"),
        ("sensor_msgs/msg/LaserScan", "a scan of one plane; expected clouds"),
        ("sensor_msgs/msg/PointCloud", "an old PointCloud; expected PointCloud2"),
    ],
)
@pytest.mark.parametrize("scans", [None, "/points"])
def test_messages_of_other_scans_are_named(tmp_path, kind, what, scans):
    with pytest.raises(InputError, match=f"/points is {what}"):
        read_flight(mcap(tmp_path / "a.mcap", cloud=kind), scans=scans)


@pytest.mark.parametrize("kind", KINDS[:2])
def test_of_a_topic_with_two_types_one_is_read(tmp_path, kind):
    bag = Bagged(tmp_path / kind).clouds().odometry()
    flight = read_flight(bag.images("/points", np.ones((2, 3), "<f4"), "32FC1").write())
    assert_whole(flight)
    assert f"{kind} has /points also as Image, which is left out" == flight.facts["notes"]


def test_transforms_of_both_names_are_read(tmp_path):
    bag = Bagged(tmp_path / "a.bag").clouds().odometry().tf("odom", "map", T_of((1, 0, 0)), topic="/tf")
    bag.tf("base_link", "tof", T_of((0.5, 0, 0)), topic="/tf")
    topic, _, stamp, message = bag.rows[-1]
    bag.rows[-1] = topic, TF[1], stamp, typestore(1).types[TF[1]](message.transforms)
    flight = read_flight(bag.write())
    assert flight.T_drone_sensor[0, 3] == 0.5
    assert "notes" not in flight.facts
