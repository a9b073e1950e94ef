"""Speed and memory of reading and writing bags of PointCloud2. Run by hand:

    .venv/bin/python benchmarks/recordings.py > benchmarks/recordings.md

All files lie in a scratch folder (4 GB) that is removed at the end, and in the page cache: what is measured is this
program, not the disk. Times are processor time of its one thread, the kernel's included. They belong to the machine
named in the table; on another only their ratios hold.
"""

import argparse
import contextlib
import json
import os
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared import command, in_own_process, peak_bytes
from steelnb import experiment, odometry
from steelnb.io import read_flight, write_flight
from steelnb.io.bag_files import typestore
from steelnb.io.bag_topics import CLOUD
from steelnb.report.results import machine
from steelnb.settings import ExperimentSettings
from steelnb.types import Array, Flight, Imu, Scan, Trajectory

FORMS = {"ROS 1 bag": "a.bag", "MCAP": "a.mcap", "sqlite": "a.db3"}
SPEED_SCANS, LONG_SCANS, RATE_HZ, REPEATS = 400, 3000, 5.0, 5
POINT_BYTES = 12
SETTINGS = ExperimentSettings.preset(duration_s=6.0, method="best")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--child", nargs=2, metavar=("write|run", "PATH"))
    child = parser.parse_args().child
    if child:
        print(json.dumps((_write if child[0] == "write" else _run)(Path(child[1]))))
        return
    load = os.getloadavg()[0]
    print(f"# Reading and writing recordings\n\n{machine()}. Load when it began: {load:.1f}. "
          f"`{command(__doc__)}`\n")  # fmt: skip
    with tempfile.TemporaryDirectory(prefix="steelnb-bench-") as scratch:
        throughput(Path(scratch))
        memory(Path(scratch))


class Repeated:
    """The scans of a short flight, there and back again, as many as asked for."""

    def __init__(self, flight: Flight, count: int) -> None:
        self.stamp_s = np.arange(count) / RATE_HZ
        self.index = _there_and_back(len(flight.scans), count)
        self.scans = list(flight.scans)

    def __iter__(self) -> Iterator[Scan]:
        return (Scan(float(s), self.scans[k].points) for s, k in zip(self.stamp_s, self.index, strict=True))


def repeated(count: int) -> tuple[Flight, float]:
    """A flight of so many scans, and the megabytes of their clouds."""
    flight, _ = experiment.simulate(SETTINGS)
    scans = Repeated(flight, count)
    poses = Trajectory(scans.stamp_s, flight.prior.T_world_drone[scans.index])
    time_s = np.arange(0, scans.stamp_s[-1], 0.008)
    imu = Imu(time_s, np.tile((0, 0, 9.81), (len(time_s), 1)), np.zeros((len(time_s), 3)))
    size = scans.scans[0].points.size // 3 * POINT_BYTES * count
    return Flight(scans, poses, flight.T_drone_sensor, imu, "repeated"), size / 1e6  # type: ignore[arg-type]


def throughput(scratch: Path) -> None:
    """Print MB/s of writing and reading, ours and the peers', in turns, the best of some."""
    flight, megabytes = repeated(SPEED_SCANS)
    alone = replace(flight, imu=None)
    rows, columns = next(iter(flight.scans)).points.shape[:2]
    print(
        f"{SPEED_SCANS} clouds of {columns} × {rows} points, {megabytes:.0f} MB, from and to the page cache.\n"
        f"MB a second of processor time, best of {REPEATS} in turns. Reading ends with float64 points and NaN rows.\n"
        "The peers: rosbags' own loop with the fields gathered one after the other, as ros_numpy does; and rosbags'\n"
        "writer given messages made field by field, clouds alone, where ours writes poses and tf too.\n\n"
        "| form | write | peer | ratio | read | peer | ratio | open |\n|---|---|---|---|---|---|---|---|"
    )
    for form, name in FORMS.items():
        path, other = scratch / name, scratch / f"peer-{name}"
        seconds: dict[str, list[float]] = {key: [] for key in ("write", "write peer", "read", "read peer", "open")}
        for _ in range(REPEATS):
            for written in (path, other):
                written.unlink(missing_ok=True)
            seconds["write"].append(_timed(partial(write_flight, path, alone)))
            seconds["write peer"].append(_timed(partial(_peer_writes, other, alone)))
            seconds["open"].append(_timed(partial(read_flight, path)))
            opened = read_flight(path)
            seconds["read"].append(_timed(partial(_drain, opened.scans)))
            seconds["read peer"].append(_timed(partial(_drain, _peer_reads(path))))
        rate = {key: megabytes / min(values) for key, values in seconds.items()}
        print(
            f"| {form} | {rate['write']:.0f} | {rate['write peer']:.0f} | {rate['write'] / rate['write peer']:.2f} "
            f"| {rate['read']:.0f} | {rate['read peer']:.0f} | {rate['read'] / rate['read peer']:.2f} "
            f"| {rate['open']:.0f} |",
            flush=True,
        )
        path.unlink()
        other.unlink()
    print("\nThe goal: 200 MB/s each way. *open*: the pass for stamps and poses, over all bytes.\n")


def memory(scratch: Path) -> None:
    """Print the peak memory of processes that write and run ten minutes of scans."""
    _, megabytes = repeated(2)
    megabytes *= LONG_SCANS / 2
    print(
        f"## Ten minutes at {RATE_HZ:.0f} Hz\n\n{LONG_SCANS} scans, {megabytes / 1e3:.2f} GB: a flight of "
        f"{SETTINGS.flight.duration_s:.0f} s, there and back again, so that the map is that of the short flight and\n"
        "what grows would be the reader's. Peak resident memory of a process of its own, imports and compiled kernels\n"
        "included.\n\n"
        "| form | write: peak at a tenth (MB) | at the end | run `best`: opened (MB) | peak at a tenth | at the end "
        "| scans a second of processor time, reading included |\n|---|---|---|---|---|---|---|"
    )
    for form, name in FORMS.items():
        path = scratch / f"long-{name}"
        wrote, ran = (in_own_process(__file__, "--child", what, str(path)) for what in ("write", "run"))
        print(
            f"| {form} | {wrote['tenth']:.0f} | {wrote['end']:.0f} | {ran['opened']:.0f} | {ran['tenth']:.0f} "
            f"| {ran['end']:.0f} | {ran['rate']:.0f} |",
            flush=True,
        )
        path.unlink()
    print("\nThe goal: flat, at most 1000 MB.")


def _write(path: Path) -> dict[str, float]:
    flight, _ = repeated(LONG_SCANS)
    peaks: dict[str, float] = {}

    def note(share: float) -> None:
        if share >= 0.1:
            peaks.setdefault("tenth", _peak())

    write_flight(path, flight, on_progress=note)
    return peaks | {"end": _peak()}


def _run(path: Path) -> dict[str, float]:
    flight = read_flight(path)
    peaks = {"opened": _peak()}
    began = time.process_time()

    def note(k: int, *_: object) -> None:
        if k + 1 == LONG_SCANS // 10:
            peaks["tenth"] = _peak()

    odometry.run(flight, odometry.make_odometry(SETTINGS.odometry, flight.T_drone_sensor, flight.imu), note)
    return peaks | {"end": _peak(), "rate": LONG_SCANS / (time.process_time() - began)}


def _peer_reads(path: Path) -> Iterator[Array]:
    """rosbags' loop, then one structured array and its fields, as ros_numpy's `pointcloud2_to_xyz_array`."""
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as reader:
        wanted = [each for each in reader.connections if each.msgtype == CLOUD]
        for connection, _, raw in reader.messages(wanted):
            message: Any = reader.deserialize(raw, connection.msgtype)  # its class is made from the bag's definitions
            layout: Any = {
                "names": [field.name for field in message.fields],
                "formats": ["<f4"] * len(message.fields),
                "offsets": [field.offset for field in message.fields],
                "itemsize": message.point_step,
            }
            records = np.frombuffer(message.data, np.dtype(layout)).reshape(message.height, message.width)
            points = np.zeros((*records.shape, 3))
            for k, axis in enumerate("xyz"):
                points[..., k] = records[axis]
            points[~np.isfinite(points).all(axis=-1)] = np.nan
            yield points


def _peer_writes(path: Path, flight: Flight) -> None:
    """rosbags' writer, messages built field by field from a structured array, clouds alone."""
    from rosbags import rosbag1, rosbag2

    ros = 1 if path.suffix == ".bag" else 2
    store = typestore(ros)
    types, serialize = store.types, store.serialize_ros1 if ros == 1 else store.serialize_cdr
    fields = [types["sensor_msgs/msg/PointField"](axis, 4 * k, 7, 1) for k, axis in enumerate("xyz")]
    plugin = rosbag2.StoragePlugin.MCAP if path.suffix == ".mcap" else rosbag2.StoragePlugin.SQLITE3
    folder = path.with_suffix("")
    writer = rosbag1.Writer(path) if ros == 1 else rosbag2.Writer(folder, version=8, storage_plugin=plugin)
    with writer:
        connection = writer.add_connection("/points", CLOUD, typestore=store)
        for scan in flight.scans:
            stamp_ns = round(scan.stamp_s * 1e9)
            stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
            header = types["std_msgs/msg/Header"](*((0,) if ros == 1 else ()), stamp, "tof")
            rows, columns = scan.points.shape[:2]
            records = np.zeros((rows, columns), [(axis, "<f4") for axis in "xyz"])
            for k, axis in enumerate("xyz"):
                records[axis] = scan.points[..., k]
            data = np.frombuffer(records.tobytes(), np.uint8)
            message = types[CLOUD](header, rows, columns, fields, False, 12, 12 * columns, data, False)
            writer.write(connection, stamp_ns, serialize(message, CLOUD))
    if ros == 2:
        (folder / f"{folder.name}{path.suffix}").rename(path)
        with contextlib.suppress(FileNotFoundError):
            (folder / "metadata.yaml").unlink()
        folder.rmdir()


def _there_and_back(length: int, count: int) -> NDArray[np.int64]:
    k = np.arange(count) % (2 * length - 2)
    return np.where(k < length, k, 2 * length - 2 - k)


def _timed(call: Callable[[], object]) -> float:
    began = time.process_time()
    call()
    return time.process_time() - began


def _drain(items: Iterable[object]) -> None:
    for _ in items:
        pass


def _peak() -> float:
    return peak_bytes() / 2**20


if __name__ == "__main__":
    main()
