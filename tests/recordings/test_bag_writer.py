"""What is written reads back the same, here and by the readers of others; and nothing half-written stays."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from steelnb import experiment
from steelnb.config import ExperimentSettings
from steelnb.datatypes import Scan, Trajectory
from steelnb.errors import OutputError, RecordingError, UnsupportedFormatError
from steelnb.recordings.formats import open_recording, save_recording, truth_path
from steelnb.recordings.recording import Recording
from steelnb.recordings.topics import CLOUD, ODOMETRY
from tests.recordings.bag_samples import KINDS, Listed, made_up

FORMS = [("a.bag", None), ("a.mcap", None), ("a.db3", None), ("folder", "mcap"), ("folder", "sqlite")]


@pytest.mark.parametrize(("name", "form"), FORMS)
def test_a_recording_reads_back_the_same(tmp_path, name, form):
    recording = made_up()
    shares: list[float] = []
    save_recording(tmp_path / name, recording, form, shares.append)
    read = open_recording(tmp_path / name)
    assert shares == pytest.approx(np.arange(1, 7) / 6)
    np.testing.assert_array_equal(read.scans.stamp_s, recording.scans.stamp_s)
    for scan, written in zip(read.scans.walk(), recording.scans.walk(), strict=True):
        assert scan.stamp_s == written.stamp_s
        np.testing.assert_array_equal(scan.points, written.points)  # organised, NaN and all
    np.testing.assert_array_equal(read.poses.stamp_s, recording.poses.stamp_s)
    np.testing.assert_allclose(read.poses.T_world_drone, recording.poses.T_world_drone, atol=1e-15)
    np.testing.assert_allclose(read.T_drone_sensor, recording.T_drone_sensor, atol=1e-15)
    np.testing.assert_array_equal(read.imu.stamp_s, recording.imu.stamp_s)
    np.testing.assert_array_equal(read.imu.specific_force, recording.imu.specific_force)
    np.testing.assert_array_equal(read.imu.angular_rate, recording.imu.angular_rate)
    for picture, shown in zip(read.pictures.walk(), recording.pictures.walk(), strict=True):
        assert picture.stamp_s == pytest.approx(shown.stamp_s, abs=1e-9)
        np.testing.assert_array_equal(picture.pixels, shown.pixels)
    np.testing.assert_allclose(read.truth.T_world_drone, recording.truth.T_world_drone, atol=1e-9)
    assert not read.skipped
    assert {file.name for file in tmp_path.iterdir()} == {name, f"{Path(name).stem}.truth.tum"}


@pytest.mark.parametrize("name", KINDS)
def test_the_truth_is_not_in_the_bag(tmp_path, name):
    recording = made_up()
    save_recording(tmp_path / name, recording)
    truth_path(tmp_path / name).unlink()
    alone = tmp_path / name
    assert open_recording(alone).truth is None
    true_x = recording.truth.position[:, 0]
    assert not any(np.float64(x).tobytes() in alone.read_bytes() for x in true_x)
    assert np.float64(recording.poses.position[3, 0]).tobytes() in alone.read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["best", "least_squares"])
@pytest.mark.parametrize("name", KINDS)
def test_the_odometry_of_a_bag_is_that_of_the_simulation(tmp_path, name, method, simulated):
    recording, flight, truth = simulated
    settings = ExperimentSettings.preset(duration_s=6.0, method=method)
    save_recording(tmp_path / name, recording)
    read = open_recording(tmp_path / name).flight()
    ours = experiment.estimate(settings, read, truth).corrected
    theirs = experiment.estimate(settings, flight, truth).corrected
    np.testing.assert_allclose(ours.stamp_s, theirs.stamp_s, rtol=1e-12)
    # Points went through single precision, 2e-7 m at 4 m; poses are means over thousands of them.
    np.testing.assert_allclose(ours.T_world_drone, theirs.T_world_drone, atol=1e-6)
    assert np.abs(theirs.position - flight.prior.position).max() > 1e-3  # it did correct


@pytest.fixture(scope="module")
def simulated():
    flight, truth = experiment.simulate(ExperimentSettings.preset(duration_s=6.0))
    poses, T = flight.prior, flight.T_drone_sensor
    recording = Recording(Path("flight"), Listed(list(flight.scans)), poses, T, flight.imu, truth.trajectory)
    return recording, flight, truth


@pytest.mark.parametrize("folder", [False, True])
def test_the_mcap_reader_reads_every_message(tmp_path, folder):
    from mcap.reader import make_reader

    recording = made_up()
    save_recording(tmp_path / ("a" if folder else "a.mcap"), recording, "mcap")
    with (tmp_path / ("a/a.mcap" if folder else "a.mcap")).open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        seen = [(channel.topic, message.log_time) for _, channel, message in reader.iter_messages()]
    counts = {summary.channels[k].topic: n for k, n in summary.statistics.channel_message_counts.items()}
    k, samples = len(recording.poses), len(recording.imu.stamp_s)
    assert counts == {
        "/tf_static": 1, "/tf": k, "/odom": k, "/imu": samples, "/tof/points": k, "/camera/image": k
    }  # fmt: skip
    assert {topic: sum(t == topic for t, _ in seen) for topic in counts} == counts
    assert [time for _, time in seen] == sorted(time for _, time in seen)
    assert {schema.name for schema in summary.schemas.values()} >= {CLOUD, ODOMETRY}
    assert all(schema.encoding == "ros2msg" and schema.data for schema in summary.schemas.values())


ROSBAG = """
import json, sys, rosbag
with rosbag.Bag(sys.argv[1]) as bag:
    types = {topic: about.msg_type for topic, about in bag.get_type_and_topic_info().topics.items()}
    first, count = {}, {}
    for topic, message, _ in bag.read_messages():
        first.setdefault(topic, message)
        count[topic] = count.get(topic, 0) + 1
cloud, place, tf = first["/tof/points"], first["/odom"].pose.pose.position, first["/tf_static"].transforms[0]
print(json.dumps({"types": types, "count": count, "points": cloud.data.hex(), "size": [cloud.height, cloud.width],
    "odom": [place.x, place.y, place.z], "frames": [tf.header.frame_id, tf.child_frame_id]}))
"""


def test_debians_rosbag_reads_what_we_write(tmp_path):
    python = "/usr/bin/python3"
    probe = subprocess.run([python, "-c", "import rosbag"], capture_output=True) if Path(python).exists() else None
    if probe is None or probe.returncode:
        pytest.skip("the system's Python has no rosbag; on Debian, apt install python3-rosbag")
    recording = made_up()
    save_recording(tmp_path / "a.bag", recording)
    done = subprocess.run([python, "-c", ROSBAG, tmp_path / "a.bag"], capture_output=True, text=True, check=True)
    read = json.loads(done.stdout)
    k = len(recording.poses)
    assert read["count"]["/tof/points"] == read["count"]["/odom"] == read["count"]["/tf"] == k
    assert read["types"]["/tf_static"] == "tf2_msgs/TFMessage"
    points = np.frombuffer(bytes.fromhex(read["points"]), "<f4").reshape(*read["size"], 3)
    np.testing.assert_array_equal(points, next(recording.scans.walk()).points)
    assert read["odom"] == recording.poses.position[0].tolist()
    assert read["frames"] == ["base_link", "tof"]


def test_scans_without_points_stay_in_step(tmp_path):
    recording = made_up()
    items = list(recording.scans.walk())
    items[2] = Scan(items[2].stamp_s, np.zeros((0, 3)))
    save_recording(tmp_path / "a.bag", replace(recording, scans=Listed(items)))
    read = open_recording(tmp_path / "a.bag")
    assert [len(scan.points) for scan in read.scans.walk()] == [5, 5, 0, 5, 5, 5]
    assert list(read.scans.walk())[2].stamp_s == items[2].stamp_s
    assert dict(read.skipped) == {"empty cloud": 1}  # once, though walked through twice


@pytest.mark.parametrize(("name", "form"), FORMS)
def test_a_disk_that_fills_up_leaves_nothing(tmp_path, name, form):
    """In a process whose files may not pass a size, which the kernel refuses as it refuses a full disk."""
    code = (
        "import resource, sys; from pathlib import Path; from steelnb.errors import OutputError\n"
        "from steelnb.recordings.formats import save_recording\n"
        "from tests.recordings.bag_samples import made_up\n"
        "recording = made_up(6, 100, 100)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))\n"
        "try: save_recording(Path(sys.argv[1]), recording, sys.argv[2] or None)\n"
        "except OutputError as fault: print(fault)\n"
    )
    before = sorted(tmp_path.iterdir())
    command = [sys.executable, "-c", code, tmp_path / name, form or ""]
    done = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr
    assert "cannot be written" in done.stdout
    assert len(done.stdout.splitlines()) == 1
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("name", KINDS)
def test_a_source_that_breaks_off_leaves_the_old_file(tmp_path, name):
    class Breaks(Listed):
        def walk(self, wanted=None):
            yield from self.items[:3]
            raise RecordingError("scan 3 is gone")

    save_recording(tmp_path / name, made_up())
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    with pytest.raises(RecordingError, match="scan 3"):
        save_recording(tmp_path / name, replace(made_up(), scans=Breaks(made_up().scans.items)))
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_an_unwritable_place_is_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="cannot be written"):
        save_recording(tmp_path / "file" / "a.bag", made_up())
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "other").touch()
    with pytest.raises(OutputError, match="not empty"):
        save_recording(tmp_path / "full", made_up(), "mcap")


@pytest.mark.parametrize(
    ("name", "form", "says"),
    [
        ("a.xyz", None, r"form '.xyz'; expected one of ros1"),
        ("a.bag", "mcap", r"form mcap with ending '.bag'; expected .mcap or none, for a folder"),
        ("a.db3", "ros1", r"expected a path that ends in .bag"),
        ("a", "ros1", r"expected a path that ends in .bag"),
        ("a", "rosbag", r"form 'rosbag'; expected one of ros1"),
    ],
)
def test_a_form_that_does_not_fit_the_ending_is_refused(tmp_path, name, form, says):
    with pytest.raises(UnsupportedFormatError, match=says):
        save_recording(tmp_path / name, made_up(), form)
    assert not list(tmp_path.iterdir())


def test_a_truth_of_another_recording_is_not_left_beside(tmp_path):
    save_recording(tmp_path / "a.bag", made_up())
    with pytest.raises(OutputError, match=r"a.truth.tum: would be taken"):
        save_recording(tmp_path / "a.mcap", replace(made_up(), truth=None))


def test_a_stamp_that_bags_cannot_hold_is_refused(tmp_path):
    recording = made_up()
    early = Trajectory(recording.poses.stamp_s - 1.0, recording.poses.T_world_drone)
    with pytest.raises(RecordingError, match=r"stamp -1.0 s"):
        save_recording(tmp_path / "a.bag", replace(recording, poses=early))
    assert not list(tmp_path.iterdir())


def test_stamps_since_1970_are_kept_to_the_resolution_of_a_float(tmp_path):
    recording = made_up(pictures=False)
    late = 1_700_000_000.123456
    poses = Trajectory(recording.poses.stamp_s + late, recording.poses.T_world_drone)
    scans = Listed([Scan(scan.stamp_s + late, scan.points) for scan in recording.scans.items])
    moved = replace(recording, poses=poses, scans=scans, imu=None, truth=None)
    for name in KINDS:
        save_recording(tmp_path / name, moved)
        read = open_recording(tmp_path / name)
        np.testing.assert_array_equal(read.scans.stamp_s, poses.stamp_s)
        np.testing.assert_array_equal(read.poses.stamp_s, poses.stamp_s)
        assert read.imu is None
        assert read.pictures is None


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the peak is read from Linux's /proc")
def test_memory_does_not_grow_with_the_recording(tmp_path):
    """Peak memory of a process that writes and reads 100 and 800 scans of 0.3 MB: 30 and 240 MB."""
    code = (
        "import sys; from pathlib import Path; from dataclasses import replace\n"
        "import numpy as np; from steelnb.datatypes import Scan, Trajectory\n"
        "from steelnb.recordings.formats import open_recording, save_recording\n"
        "from tests.recordings.bag_samples import made_up, poses\n"
        "count, path = int(sys.argv[1]), Path(sys.argv[2])\n"
        "class Scans:\n"
        "    stamp_s = 0.2 * np.arange(count)\n"
        "    def walk(self, wanted=None):\n"
        "        return (Scan(t, np.full((160, 160, 3), t + 1.0)) for t in self.stamp_s)\n"
        "save_recording(path, replace(made_up(2, pictures=False), scans=Scans(), poses=poses(count)))\n"
        "assert sum(scan.points[0, 0, 0] > 0 for scan in open_recording(path).scans.walk()) == count\n"
        "print(int(Path('/proc/self/status').read_text().partition('VmHWM:')[2].split()[0]) / 1024)\n"
    )
    for name in KINDS:
        peaks = []
        for count in (100, 800):
            command = [sys.executable, "-c", code, str(count), tmp_path / f"{count}-{name}"]
            done = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[2])
            assert done.returncode == 0, done.stderr
            peaks.append(float(done.stdout))
            os.remove(tmp_path / f"{count}-{name}")
        assert peaks[0] > 20
        assert peaks[1] - peaks[0] < 30, name
