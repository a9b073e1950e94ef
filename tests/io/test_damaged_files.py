"""Damaged files of points and poses end in a result or one line, whatever their headers say."""

import contextlib
import gzip
import os
import re
import socket
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from steelnb.core.errors import InputError
from steelnb.io import read_flight, read_trajectory, read_truth, write_tum
from steelnb.io.clouds import read_points
from tests.io.samples import TRIALS, poses
from tests.io.test_clouds import save

MEMORY_MAX = 30e6
"""For files of ten kilobytes."""
NUMBERS = b"0 1 -1 3 399 4294967295 2147483648 99999999999999999999 nan 1e9 x ".split(b" ")
FORMATS = (
    "text.pcd", "binary.pcd", "compressed.pcd", "text.ply", "binary.ply", "a.las", "a.laz", "a.npy", "a.csv", "a.tum",
)  # fmt: skip
HEADER_BYTES = {".las": 400, ".laz": 600, ".npy": 128, ".csv": 100, ".tum": 200, ".pcd": 180, ".ply": 130}


def damaged(whole: bytes, header: int, rng: np.random.Generator) -> bytes:
    """One to three damages: bytes, numbers, lines or binary numbers of the header are changed, or the file is cut."""
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(min(header, len(whole)) or 1))
        kind = rng.integers(6)
        if kind == 0:
            whole = whole[:at] + bytes(rng.integers(0, 256, rng.integers(1, 4), np.uint8)) + whole[at + 1 :]
        elif kind == 1:
            words = whole[:header].split(b" ")
            words[rng.integers(len(words))] = NUMBERS[rng.integers(len(NUMBERS))]
            whole = b" ".join(words) + whole[header:]
        elif kind == 2:
            lines = whole[:header].split(b"\n")
            moved = lines.pop(rng.integers(len(lines))) if rng.random() < 0.7 else lines[0]
            lines.insert(int(rng.integers(len(lines) + 1)), moved)
            whole = b"\n".join(lines) + whole[header:]
        elif kind == 3:
            size = int(rng.choice([1, 2, 4, 8]))
            number = rng.choice([0, 1, 127, 255, 2**31 - 1, 2**32 - 1, 2**63 - 1, 2**64 - 1, 10**6]) % 2 ** (8 * size)
            whole = whole[:at] + int(number).to_bytes(size, "little") + whole[at + size :]
        elif kind == 4:
            whole = whole[: int(rng.integers(len(whole) + 1))]
        else:
            whole = whole[:at] + whole[at + int(rng.integers(1, 40)) :]
    return whole


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_headers_give_points_or_one_line(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / name
    if path.suffix == ".tum":
        write_tum(path, poses(100))
    else:
        save(path)
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    read = read_trajectory if path.suffix == ".tum" else read_points
    refused = 0
    tracemalloc.start()
    for trial in range(TRIALS):
        content = damaged(whole, HEADER_BYTES[path.suffix], rng)
        path.write_bytes(content)
        tracemalloc.reset_peak()
        try:
            assert len(read(path)) > 0
        except InputError:
            refused += 1
        assert tracemalloc.get_traced_memory()[1] < MEMORY_MAX, (trial, content[:400])
    tracemalloc.stop()
    assert refused > TRIALS / 10
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("kind", ["pipe", "socket", "device"])
@pytest.mark.parametrize("read", [read_flight, read_trajectory, read_points, read_truth])
def test_what_may_never_end_is_refused(tmp_path, kind, read):
    path = tmp_path / ("a.truth.tum" if read is read_truth else "a.ply" if read is read_points else "a.mcap")
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with contextlib.chdir(tmp_path):  # its whole path may be too long for a socket
            socket.socket(socket.AF_UNIX).bind(path.name)
    else:
        path.symlink_to("/dev/zero")
    with pytest.raises(InputError, match=r"a pipe, a device or a socket; expected .*, in a file"):
        read(tmp_path / "a.mcap", truth=str(path)) if read is read_truth else read(path)


def test_pipes_in_a_folder_are_no_parts_of_a_recording(tmp_path):
    os.mkfifo(tmp_path / "b.mcap")
    with pytest.raises(InputError, match="no whole message in it"):
        read_flight(tmp_path)


@pytest.mark.parametrize(
    ("name", "begin", "what"),
    [
        ("a.e57", b"ASTM-E57\1", "E57; expected PLY or LAS"),
        ("a.pcap", b"\xd4\xc3\xb2\xa1", "packets of a network"),
        ("a.pcapng", b"\n\r\r\n\x1c\0\0\0\x4d\x3c\x2b\x1a", "packets of a network"),
        ("a.zip", b"PK\3\4", "a zip archive"),
        ("a.ulg", b"ULog\1\x12\x35", "a log of PX4"),
        ("a.bz2", b"BZh91AY&SY", "compressed by bzip2"),
        ("a.txt", b"%PDF-1.4\n1 0 0\n2 3 4\n", "a document"),
        ("a.xyz", b"OFF\n2 0 0\n1 2 3\n4 5 6\n", "OFF; expected PLY"),
        ("a.ply", b"<!DOCTYPE html>\n<html>", "a web page"),
        *(
            (f"a{suffix}", begin, what)
            for suffix in (".bag", ".mcap", ".db3", ".npy", ".tum")
            for begin, what in (
                (
                    b"version https://git-lfs.github.com/spec/v1\noid sha256:abc\n",
                    r"a pointer of git LFS; .* \(git lfs",
                ),
                (gzip.compress(b"#ROSBAG V2.0\n" * 50, mtime=0), r"compressed by gzip; .* \(gunzip\)"),
            )
        ),
    ],
)
def test_files_of_other_programs_are_named(tmp_path, name, begin, what):
    path = tmp_path / name
    path.write_bytes(begin)
    for read in (read_trajectory,) if path.suffix == ".tum" else (read_points, read_flight):
        with pytest.raises(InputError, match=f"{name}.* {what}") as refused:
            read(path)
        assert not re.search("reindex|recover", str(refused.value))
