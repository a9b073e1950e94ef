"""Small recordings, and bags of any messages, for the tests."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.datatypes import Imu, Scan, Trajectory
from steelnb.recordings.bag_files import typestore
from steelnb.recordings.bag_writer import Messages
from steelnb.recordings.recording import Picture, Recording

KINDS = ("a.bag", "a.mcap", "a.db3")
Row = tuple[str, str, float, Any]
"""Topic, type, stamp in seconds, message or bytes."""


class Listed:
    """A source of scans or pictures at hand."""

    def __init__(self, items: list) -> None:
        self.items = items
        self.stamp_s = np.array([item.stamp_s for item in items])

    def walk(self, wanted: np.ndarray | None = None) -> Iterator:
        return (item for k, item in enumerate(self.items) if wanted is None or wanted[k])


def poses(count: int, step_s: float = 0.2, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, 3] = rng.normal(size=(count, 3))
    T[:, :3, :3] = Rotation.random(count, rng).as_matrix()
    return Trajectory(np.round(step_s * np.arange(count), 9), T)


def made_up(count: int = 6, rows: int = 5, columns: int = 7, pictures: bool = True) -> Recording:
    """Organised scans with some NaN, poses at their stamps, IMU at 50 Hz, RGB pictures, and a truth of its own."""
    rng = np.random.default_rng(1)
    trajectory = poses(count)
    scans = []
    for stamp in trajectory.stamp_s:
        points = rng.normal(size=(rows, columns, 3)).astype(np.float32).astype(np.float64)
        points[0, 0] = np.nan
        scans.append(Scan(float(stamp), points))
    time = np.round(np.arange(0, trajectory.stamp_s[-1], 0.02), 9)
    imu = Imu(time, rng.normal(size=(len(time), 3)), rng.normal(size=(len(time), 3)))
    images = [Picture(float(t) + 0.05, rng.integers(0, 255, (4, 6, 3), np.uint8)) for t in trajectory.stamp_s]
    T_drone_sensor = np.eye(4)
    T_drone_sensor[:3, 3] = 0.06, -0.01, 0.02
    T_drone_sensor[:3, :3] = Rotation.from_euler("xyz", (0.1, -0.2, 0.3)).as_matrix()
    return Recording(
        Path("made-up"),
        Listed(scans),
        trajectory,
        T_drone_sensor,
        imu,
        poses(count, seed=3),
        Listed(images) if pictures else None,
    )


def write_rows(path: Path, rows: Iterable[Row], compression: str = "") -> Path:
    """A bag of these messages in this order; `bytes` are written as they are."""
    rows = list(rows)
    ros = 1 if path.suffix == ".bag" else 2
    store = typestore(ros)
    with _writer(path, compression) as writer:
        topics: dict[tuple[str, str], Any] = {}
        for topic, kind, stamp, message in rows:
            if (topic, kind) not in topics:
                topics[topic, kind] = writer.add_connection(topic, kind, typestore=store)
            serialize = store.serialize_ros1 if ros == 1 else store.serialize_cdr
            raw = message if isinstance(message, bytes) else serialize(message, kind)
            writer.write(topics[topic, kind], round(stamp * 1e9), raw)
    if ros == 2:
        folder = path.with_suffix(".rows")
        (folder / "a" / f"a{path.suffix}").rename(path)
    return path


def _writer(path: Path, compression: str) -> Any:
    from rosbags import rosbag1, rosbag2

    if path.suffix == ".bag":
        writer = rosbag1.Writer(path)
        if compression:
            writer.set_compression(rosbag1.Writer.CompressionFormat[compression.upper()])
        return writer
    plugin = rosbag2.StoragePlugin.MCAP if path.suffix == ".mcap" else rosbag2.StoragePlugin.SQLITE3
    folder = path.with_suffix(".rows") / "a"
    folder.parent.mkdir()
    two = rosbag2.Writer(folder, version=8, storage_plugin=plugin)
    if compression:
        two.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
    return two


def factory(path: Path) -> Messages:
    """What makes the messages of a bag with this ending."""
    return Messages(1 if path.suffix == ".bag" else 2)


def ns(stamp_s: float) -> int:
    return round(stamp_s * 1e9)
