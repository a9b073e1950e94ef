"""Readers at their limits: memory that a small file asks for, pipes, names of any bytes, numbers of any size."""

import bz2
import os
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lz4.frame
import numpy as np
import pytest
from backports import zstd
from steelnb.io.bag_files import bounded
from steelnb.io.calibration import read_settings
from steelnb.io.images import read_depth

from steelnb.errors import InputError
from steelnb.files import LINE_BYTES_MAX, open_lines, reading
from steelnb.io import (
    bag_files,
    read_cloud,
    read_flight,
    read_structure,
    read_trajectory,
    read_truth,
    write_flight,
    write_tum,
)
from steelnb.settings import parse_parameter, read_toml
from steelnb.types import Trajectory
from tests.io.samples import KINDS, Bagged, made_up, poses
from tests.io.test_clouds import by_laspy
from tests.io.test_folders import laid_out

READERS = {
    "a.ply": read_cloud, "a.xyz": read_cloud, "a.npy": read_cloud, "a.las": read_cloud, "a.bag": read_flight,
    "a.mcap": read_flight, "a.db3": read_flight, "a.tum": read_trajectory, "a.json": read_structure,
    "a.toml": read_toml, "a.png": read_depth,
}  # fmt: skip


@pytest.mark.parametrize("name", READERS)
def test_a_pipe_is_refused_by_name_and_not_waited_for(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match=rf"{name}: a pipe or a device; expected a"):
        READERS[name](tmp_path / name)


def test_whatever_a_library_raises_is_one_line_with_the_name(tmp_path: Path) -> None:
    class Panic(BaseException):
        """As those of libraries in Rust."""

    for fault in (Panic("two\nlines"), MemoryError(), RecursionError("deep"), AssertionError(), OSError("no number")):
        with (
            pytest.raises(InputError, match=rf"^{tmp_path}/a: not a thing: \w[^\n]*$"),
            reading(tmp_path / "a", "a thing"),
        ):
            raise fault
    with pytest.raises(KeyboardInterrupt), reading(tmp_path / "a", "a thing"):
        raise KeyboardInterrupt


def test_a_line_without_an_end_is_not_held_in_memory(tmp_path: Path) -> None:
    for name, begin in (("a.xyz", "1 2 3\n4 5 6\n"), ("a.tum", "1 0 0 0 0 0 0 1\n")):
        (tmp_path / name).write_text(begin + "7" * (2 * LINE_BYTES_MAX))
        with pytest.raises(InputError, match=f"a line of more than {LINE_BYTES_MAX} bytes"):
            READERS[name](tmp_path / name)
    (tmp_path / "long.txt").write_text(f"1 {'7' * (LINE_BYTES_MAX // 2)}\n" * 5)
    with open_lines(tmp_path / "long.txt") as file:
        assert sum(1 for _ in file) == 5


def test_faces_of_a_ply_take_no_memory(tmp_path: Path) -> None:
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    faces = f"element face {10**12}\nproperty list uchar int vertex_indices\n"
    (tmp_path / "a.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 2\n{axes}{faces}end_header\n0 0 0\n1 1 1\n")
    assert len(read_cloud(tmp_path / "a.ply")) == 2


@pytest.mark.parametrize("form", [6, 7, 8])
def test_later_chunks_of_a_laz_file_ask_for_no_memory(tmp_path: Path, form: int) -> None:
    points, path = np.round(np.random.default_rng(0).uniform(-3, 3, (50_100, 3)), 3), tmp_path / "a.laz"
    by_laspy(path, points, "1.4", form)
    assert len(read_cloud(path)) == len(np.unique(points, axis=0))
    whole = path.read_bytes()
    start, record = *struct.unpack_from("<I", whole, 96), *struct.unpack_from("<H", whole, 105)
    layers, (table,) = {6: 9, 7: 10, 8: 11}[form], struct.unpack_from("<q", whole, start)
    head = start + 8 + record + 4
    second = head + 4 * layers + sum(struct.unpack_from(f"<{layers}I", whole, head))
    sizes = [head + 4 * (layers - 1), second + record + 4, second + record + 4 + 4 * (layers - 1)]
    for place, number in (*((size, 2**31 - 1) for size in sizes), (table + 4, 1), (table + 4, 2**32 - 1)):
        damaged = bytearray(whole)
        struct.pack_into("<I", damaged, place, number)
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"a\.laz: \d+ chunks listed at byte .*: cut short or damaged"):
            read_cloud(path)


def test_unpacking_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bag_files, "UNPACKED_MAX", 1 << 20)
    ways = (
        (bz2.compress, bz2.BZ2Decompressor), (lz4.frame.compress, lz4.frame.LZ4FrameDecompressor),
        (zstd.compress, zstd.ZstdDecompressor),
    )  # fmt: skip
    for pack, make in ways:
        packed = pack(b"a" * (1 << 19))
        assert bounded(make)(packed) == b"a" * (1 << 19)
        assert bounded(make)(packed + packed) == b"a" * (1 << 20)  # two frames
        with pytest.raises(ValueError, match="unpacks to more than 1 MB"):
            bounded(make)(pack(b"a" * (1 << 24)))
        with pytest.raises(ValueError, match="end early"):
            bounded(make)(packed[:-5])


def packed(path: Path, target: Path, mode: str = "") -> Path:
    """The messages of a bag, compressed as ROS 1 does it, or as ROS 2's ``mode`` (STORAGE, FILE or MESSAGE) does."""
    from rosbags import rosbag1, rosbag2

    ros = 2 if mode else 1
    store = bag_files.typestore(ros)
    writer: Any
    if ros == 1:
        writer = rosbag1.Writer(target)
        writer.set_compression(rosbag1.Writer.CompressionFormat.BZ2)
    else:
        storage = rosbag2.StoragePlugin.SQLITE3 if mode != "STORAGE" else rosbag2.StoragePlugin.MCAP
        writer = rosbag2.Writer(target, version=8, storage_plugin=storage)
        writer.set_compression(rosbag2.CompressionMode[mode], rosbag2.CompressionFormat.ZSTD)
    with bag_files.bag_reader(ros)(path) as reader, writer:
        topics = {c.topic: writer.add_connection(c.topic, c.msgtype, typestore=store) for c in reader.connections}
        for connection, stamp_ns, raw in reader.messages():
            writer.write(topics[connection.topic], stamp_ns, raw)
    return target


@pytest.mark.parametrize(("name", "mode"), [("a.bag", ""), ("a.mcap", "STORAGE"), ("a.mcap", "MESSAGE")])
def test_bags_are_unpacked_within_the_bound(
    tmp_path: Path, name: str, mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    Bagged(tmp_path / name).clouds().odometry().write()
    path = packed(tmp_path / name, tmp_path / ("packed" if mode else "packed.bag"), mode)
    assert len(list(read_flight(path).scans)) == 5
    monkeypatch.setattr(bag_files, "UNPACKED_MAX", 100)
    with pytest.raises(InputError, match=rf"^{path}: not a bag: a chunk or a message unpacks to more than 0 MB"):
        read_flight(path)


def test_compressed_files_leave_half_of_the_temporary_disk_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Bagged(tmp_path / "a.mcap").clouds().odometry().write()
    path, disk = packed(tmp_path / "a.mcap", tmp_path / "packed", "FILE"), tmp_path / "disk"
    disk.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(disk))
    assert len(list(read_flight(path).scans)) == 5
    (file,) = path.glob("*.zstd")
    file.write_bytes(zstd.compress(b"\0" * (1 << 26)))
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=1 << 22))
    with pytest.raises(
        InputError, match=rf"^{path}: .* unpacks to more than 2 MB, half of what is free in {disk}; expected less"
    ):
        read_flight(path)
    assert list(disk.iterdir()) == []


def test_pipes_for_poses_and_in_the_folder_of_a_bag(tmp_path: Path) -> None:
    write_flight(tmp_path / "a.bag", made_up())
    write_flight(tmp_path / "ros2", made_up())
    folder = laid_out(tmp_path / "clouds", [f"{k}.npy" for k in range(5)])
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "a.bag", folder):
        with pytest.raises(InputError, match="pipe: a pipe or a device; expected a"):
            read_flight(path, poses=str(tmp_path / "pipe"))
        with pytest.raises(InputError, match="pipe: a pipe or a device; expected a"):
            read_truth(path, truth=str(tmp_path / "pipe"))
    assert len(read_flight(tmp_path / "ros2")) == 6
    (file,) = (tmp_path / "ros2").glob("*.mcap")
    file.unlink()
    os.mkfifo(file)
    with pytest.raises(InputError, match=r"ros2\.mcap: a pipe or a device; expected a file of a bag"):
        read_flight(tmp_path / "ros2")


@pytest.mark.parametrize("kind", [*KINDS, "folder"])
@pytest.mark.parametrize("stem", ["a#b?c%41 d", os.fsdecode(b"a\xffb")])
def test_any_bytes_in_the_name_of_a_recording(tmp_path: Path, kind: str, stem: str) -> None:
    path = tmp_path / stem / f"{stem}{Path(kind).suffix}"
    write_flight(path, made_up())
    flight = read_flight(path)
    assert len(list(flight.scans)) == 6
    flight.name.encode()
    read_cloud_path = tmp_path / f"{stem}.xyz"
    read_cloud_path.write_text("1 2 3\n4 5 6\n")
    assert len(read_cloud(read_cloud_path)) == 2


def test_poses_beyond_every_map_are_left_out(tmp_path: Path) -> None:
    far = poses(5).T_world_drone.copy()
    far[2, 0, 3] = 1e300
    write_tum(tmp_path / "a.tum", Trajectory(poses(5).stamp_s, far))
    assert len(read_trajectory(tmp_path / "a.tum")) == 4
    bag = Bagged(tmp_path / "a.bag").clouds()
    for k, stamp in enumerate((0.0, 0.2, 0.4)):
        bag.tf("odom", "base_link", poses(3).T_world_drone[k], stamp, "/tf")
        turn = bag.rows[-1][3].transforms[0].transform.rotation
        if k == 1:
            turn.x = turn.y = 1e300
    flight = read_flight(bag.write())
    assert flight.skipped["tf that is no transform"] == 1
    assert np.isfinite(flight.prior.T_world_drone).all()


@pytest.mark.parametrize(
    "content",
    [f"x = {'[' * 3000}{']' * 3000}", f"{'.'.join('a' * 3000)} = 1", f"x = {'9' * 5000}", "x = 1\n" + "#" * (1 << 22)],
)
def test_toml_of_any_depth_and_size(tmp_path: Path, content: str) -> None:
    (tmp_path / "s.toml").write_text(content)
    for read in (read_toml, read_settings):
        with pytest.raises(InputError, match=r"s\.toml") as caught:
            read(tmp_path / "s.toml")
        assert len(str(caught.value)) < 500
    assert parse_parameter(f"x={'[' * 3000}")[0] == "x"
