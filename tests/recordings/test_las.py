"""LAS and LAZ: laspy reads what we write, and files cut short or damaged get an error of ours."""

import random
from pathlib import Path

import laspy
import numpy as np
import pytest

from steelnb.errors import EmptyCloudError, FileContentError, SteelnbError
from steelnb.recordings import read_cloud
from steelnb.recordings.las import las_chunks, las_count, las_step, read_las, write_las

UTM = np.array([299119.894, 2801406.927, 1949.952])
ENDINGS = (".las", ".laz")


def made_up(count: int = 3000) -> np.ndarray:
    return np.random.default_rng(0).normal(scale=5.0, size=(count, 3))


def surveyed(path: Path, points: np.ndarray, version: str = "1.4", form: int = 7) -> None:
    """As other programs write them: with colours, a millimetre's scale and an offset."""
    header = laspy.LasHeader(point_format=form, version=version)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(points.min(axis=0))
    file = laspy.LasData(header)
    file.x, file.y, file.z = points.T
    file.intensity = np.arange(len(points)) % 1000
    file.write(str(path))


@pytest.mark.parametrize("ending", ENDINGS)
def test_points_come_back_to_half_a_step(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"a{ending}"
    for points, step_m in ((made_up(), 1e-5), (made_up() + UTM, 1e-5), (1e4 * made_up(), 1e-4)):
        write_las(path, np.concatenate([points, [[np.nan, 0, 0]]]))
        np.testing.assert_allclose(read_las(path), points, rtol=0, atol=0.51 * step_m)
        assert (las_count(path), las_step(path)) == (len(points), pytest.approx(step_m))
        with laspy.open(path) as reader:  # an independent reader
            assert reader.header.are_points_compressed == (ending == ".laz")
            np.testing.assert_allclose(reader.read().xyz, points, rtol=0, atol=0.51 * step_m)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize(("version", "form"), [("1.2", 0), ("1.2", 3), ("1.4", 6), ("1.4", 7)])
def test_clouds_of_other_programs_are_read(tmp_path: Path, ending: str, version: str, form: int) -> None:
    path, points = tmp_path / f"a{ending.upper()}", np.round(made_up() + UTM, 3)
    surveyed(path.with_suffix(ending), points, version, form)
    path.with_suffix(ending).rename(path)
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.points + cloud.origin, points, rtol=0, atol=1e-6)
    assert cloud.resolution_m == pytest.approx(0.001)
    assert np.abs(cloud.points).max() < 100
    chunks = list(las_chunks(path, 700))
    assert [len(chunk) for chunk in chunks] == [700, 700, 700, 700, 200]
    np.testing.assert_array_equal(np.concatenate(chunks), read_las(path))


@pytest.mark.parametrize("ending", ENDINGS)
def test_cut_files_are_refused(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"a{ending}"
    surveyed(path, made_up())
    whole = path.read_bytes()
    for share in np.linspace(0, 1, 50, endpoint=False):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(FileContentError) as caught:
            read_cloud(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("ending", ENDINGS)
def test_damaged_files_get_points_or_an_error_of_ours(tmp_path: Path, ending: str) -> None:
    rng = random.Random(5)
    path = tmp_path / f"a{ending}"
    for version, form in (("1.2", 0), ("1.4", 6)):
        surveyed(path, made_up(500), version, form)
        whole = path.read_bytes()
        refused = 0
        for turn in range(1000):
            damaged = bytearray(whole)
            for _ in range(rng.choice((1, 3, 12))):
                damaged[rng.randrange(500 if turn % 2 else len(whole))] = rng.randrange(256)
            path.write_bytes(damaged)
            try:
                assert read_las(path).shape[1] == 3
            except SteelnbError:
                refused += 1
        assert 0 < refused < 1000


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"", "begins with b''"), (b"ply\nformat ascii 1.0\n", "begins with b'ply"), (b"LASF" + bytes(100), "104 bytes")],
)
def test_foreign_files_are_refused(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "a.laz"
    path.write_bytes(content)
    with pytest.raises(FileContentError, match=words):
        read_cloud(path)


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_file_without_points_is_an_empty_cloud(tmp_path: Path, ending: str) -> None:
    write_las(tmp_path / f"a{ending}", np.full((4, 3), np.nan))
    with pytest.raises(EmptyCloudError):
        read_cloud(tmp_path / f"a{ending}")


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_full_disk_is_an_error_of_the_system(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"a{ending}"
    path.symlink_to("/dev/full")
    with pytest.raises(OSError, match=r"No space left|is the disk full"):
        write_las(path, made_up())
