"""Open3D, without the messages that importing it sends from a notebook."""

import os
import sys
from types import ModuleType


def import_open3d() -> ModuleType:
    """Open3D, which is imported only where it is used.

    It imports Dash, which in a kernel opens a comm that JupyterLab has no handler for, and says so in an alert: this
    one stays a dummy. Its own web visualiser, which would open a port, is off unless the environment says otherwise.
    """
    os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")
    comm = sys.modules.get("comm")  # loaded by every kernel
    kept = getattr(comm, "create_comm", None)
    try:
        if comm:
            comm.create_comm = comm.DummyComm  # type: ignore[attr-defined]
        import open3d
    finally:
        if comm:
            comm.create_comm = kept  # type: ignore[attr-defined]
    return open3d
