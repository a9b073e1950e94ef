"""Open3D in a kernel."""

import nbformat
from nbclient import NotebookClient

OPENS = """
import comm
kernels_own = comm.create_comm
from steelnb.libraries import import_open3d
open3d = import_open3d()
import sys
print("dash" in sys.modules, comm.create_comm is kernels_own, len(open3d.geometry.PointCloud().points))
"""


def test_a_kernel_that_imports_open3d_opens_no_comm() -> None:
    opened: list[str] = []

    class Client(NotebookClient):
        def process_message(self, msg, cell, cell_index):
            if msg["msg_type"] == "comm_open":
                opened.append(msg["content"]["target_name"])
            return super().process_message(msg, cell, cell_index)

    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(OPENS)])
    Client(notebook, kernel_name="python3", timeout=120).execute()
    assert notebook.cells[0].outputs[0].text == "True True 0\n"
    assert opened == []
