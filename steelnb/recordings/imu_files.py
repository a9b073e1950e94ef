"""IMU data as text, in EuRoC's form: nanoseconds, angular rate, specific force."""

from collections import Counter
from pathlib import Path

import numpy as np

from steelnb.datatypes import Imu
from steelnb.errors import FileContentError
from steelnb.recordings.stamps import NANO, nanoseconds, rising, text_lines

IMU = "imu.csv"
_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)


def read_imu(path: Path, skipped: Counter[str]) -> Imu | None:
    """IMU data of a file; None where there is no file. Stamps that do not rise are left out and counted.

    Raises `FileContentError` with the number of the first bad line.
    """
    if not path.is_file():
        return None
    rows = []
    for number, line in text_lines(path):
        words = [word.strip() for word in line.split(",")]
        try:
            rows.append([int(words[0]) / NANO, *map(float, words[1:7])])
        except (ValueError, OverflowError):
            words = []
        if len(words) < 7:
            raise FileContentError(
                f"{path}, line {number}: {line[:60]!r}; expected 7 numbers: ns, rate, specific force"
            )
    table = np.array(rows).reshape(-1, 7)
    table = table[rising(table[:, 0], skipped, "IMU: ")]
    return Imu(table[:, 0], table[:, 4:], table[:, 1:4])


def write_imu(path: Path, imu: Imu | None) -> None:
    """Write IMU data, if there is any, with all digits."""
    if imu is None or not len(imu.stamp_s):
        return
    rows = np.column_stack([imu.angular_rate, imu.specific_force]).tolist()
    lines = [
        ",".join([str(nanoseconds(stamp)), *map(repr, row)])
        for stamp, row in zip(imu.stamp_s.tolist(), rows, strict=True)
    ]
    path.write_text("\n".join([_HEADER, *lines, ""]))
