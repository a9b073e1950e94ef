"""A Dask scheduler and its workers as processes of their own, each started again when it dies."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Cluster:
    """Use as a context: a scheduler and ``workers`` workers on loopback, whose logs go to ``folder``."""

    def __init__(self, folder: Path, workers: int = 2) -> None:
        self.folder, self.port = folder, free_port()
        self.address = f"tcp://127.0.0.1:{self.port}"
        common = ["--host", "127.0.0.1", "--no-dashboard"]
        self.commands = {"scheduler": ["dask_scheduler", *common, "--port", str(self.port)]}
        for k in range(workers):
            own = [self.address, "--nthreads", "1", "--no-nanny", "--local-directory", str(folder), "--name", str(k)]
            self.commands[f"worker-{k}"] = ["dask_worker", *own, *common]
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.started: dict[str, int] = dict.fromkeys(self.commands, 0)
        self._end = threading.Event()
        self._watch = threading.Thread(target=self._supervise)

    def __enter__(self) -> "Cluster":
        for name in self.commands:
            self._start(name)
        self._watch.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._watch.join()
        for process in self.processes.values():
            process.kill()
            process.wait()

    def kill(self, name: str) -> None:
        """SIGKILL; the supervisor starts it again."""
        self.processes[name].send_signal(signal.SIGKILL)

    def _start(self, name: str) -> None:
        module, *options = self.commands[name]
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        with (self.folder / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.{module}", *options], stdout=log, stderr=log,
                env={**os.environ, **threads},
            )  # fmt: skip
        self.started[name] += 1

    def _supervise(self) -> None:
        while not self._end.wait(0.05):
            for name, process in list(self.processes.items()):
                if process.poll() is not None:
                    time.sleep(0.1)  # let the port go
                    self._start(name)
