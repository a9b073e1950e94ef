"""Imports of Open3D without its side effects in notebooks."""

import os
import sys
from types import ModuleType


def import_open3d() -> ModuleType:
    """Import Open3D, without an alert in JupyterLab and without its web server.

    Open3D imports Dash, which opens a Jupyter comm that JupyterLab reports as unknown; a dummy comm replaces it.
    Open3D's web visualiser, which opens a port, is off unless the environment enables it.
    """
    os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")
    comm = sys.modules.get("comm")  # loaded by every kernel
    create_comm = getattr(comm, "create_comm", None)
    try:
        if comm:
            comm.create_comm = comm.DummyComm  # type: ignore[attr-defined]
        import open3d
    except ImportError as fault:  # its C code makes one of an interrupt
        cause: BaseException | None = fault
        while cause and not isinstance(cause, KeyboardInterrupt | SystemExit):
            cause = cause.__cause__ or cause.__context__
        raise (cause or fault) from None
    finally:
        if comm:
            comm.create_comm = create_comm  # type: ignore[attr-defined]
    return open3d
