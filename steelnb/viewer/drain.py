"""A named pipe that rerun writes its file to, and a thread that carries it to the disk.

Rerun tells nobody that a disk is full, and a program whose disk was full may then never end. Behind a pipe its writes
always succeed, and the fault is ours to tell.
"""

import os
import shutil
import threading
from pathlib import Path

PIECE_BYTES = 1 << 16


class Drain:
    """What is written to ``entry`` goes to a new file, until the writer closes it. ``fault`` is what stopped it."""

    def __init__(self, file: Path) -> None:
        """Raises OSError where the file or the pipe cannot be made."""
        self.fault: OSError | None = None
        self._file = file.open("xb")
        self.entry = file.with_name(f"{file.name}.pipe")
        try:
            os.mkfifo(self.entry)
        except OSError:
            self._file.close()
            raise
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def _carry(self) -> None:
        with self.entry.open("rb", buffering=0) as source:
            try:
                with self._file:
                    shutil.copyfileobj(source, self._file, PIECE_BYTES)
            except OSError as fault:
                self.fault = fault
            while source.read(PIECE_BYTES):  # the writer shall not wait
                pass

    def close(self) -> None:
        """Wait until all is on the disk; the writer has closed its end by now."""
        self._thread.join()
        self.entry.unlink()
