"""What the base install can do: `steelnb segment` and `structure` without the libraries of the extras."""

import json
import subprocess
import sys
from pathlib import Path

import laspy
import numpy as np

from steelnb.io.clouds import write_ply
from tests.lattice import lattice, scanned

EXTRAS = (
    "ahrs", "cv2", "dask", "distributed", "evo", "ezdxf", "gtsam", "ifcopenshell", "imufusion", "ipykernel", "IPython",
    "ipywidgets", "jupyterlab", "nbclient", "nbconvert", "nbformat", "open3d", "papermill", "plotly", "psutil",
    "pyarrow", "pybullet", "rerun", "rosbags", "sklearn", "small_gicp", "torch", "trimesh",
)  # fmt: skip
"""Import names of what only extras install."""


def steelnb(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    code = f"import sys; sys.modules |= dict.fromkeys({EXTRAS!r}); from steelnb import cli; sys.exit(cli.main())"
    return subprocess.run([sys.executable, "-c", code, *arguments], cwd=folder, capture_output=True, text=True)


def test_segment_needs_no_extra(tmp_path: Path) -> None:
    points = np.round(scanned(lattice(8, 4, 2, 3), 40, 0.06, 0.01), 3)
    write_ply(tmp_path / "tower.ply", points)
    np.savetxt(tmp_path / "tower.xyz", points, fmt="%.3f")
    file = laspy.LasData(laspy.LasHeader(point_format=0, version="1.2"))
    file.x, file.y, file.z = points.T
    file.write(str(tmp_path / "tower.laz"))
    for name in ("tower.ply", "tower.xyz", "tower.laz"):
        shown = steelnb(tmp_path, "segment", name, "-o", "bars")
        assert shown.returncode == 0, shown.stderr
        assert f"read      {name}: " in shown.stdout
        assert len(json.loads((tmp_path / "bars" / "segments.json").read_text())["segments"]) > 20
        assert (tmp_path / "bars" / "segments.png").exists()
