"""Rerun's web viewer and one file for it to play, for a browser on this machine and nobody else.

Rerun's own server listens to the whole network, and its viewer reports to its makers from within the browser. This one
listens on 127.0.0.1, and its pages may ask nothing of any other address: the browser itself refuses (Content Security
Policy). The viewer comes from the package rerun-notebook, so it opens without a network.
"""

import contextlib
import shutil
import threading
from collections.abc import Iterator
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import cast

from steelnb.errors import FileMissingError, SettingsError

HERE = Path(__file__).parent
LOCALHOST = "127.0.0.1"
POLICY = "; ".join(
    (
        "default-src 'none'", "script-src 'self' 'wasm-unsafe-eval'", "style-src 'self' 'unsafe-inline'",
        "connect-src 'self'", "img-src 'self' data: blob:", "font-src 'self' data:", "worker-src 'self' blob:",
        "base-uri 'none'", "form-action 'none'",
    )
)  # fmt: skip
TYPES = {
    ".html": "text/html; charset=utf-8", ".js": "text/javascript; charset=utf-8", ".css": "text/css; charset=utf-8",
    ".wasm": "application/wasm", ".rrd": "application/octet-stream",
}  # fmt: skip
RECORDING = "recording.rrd"


class _Handler(BaseHTTPRequestHandler):
    """Answers for the few files that there are. A name that another site took on for this address is refused."""

    protocol_version = "HTTP/1.1"

    def __init__(self, files: dict[str, Path], *rest) -> None:  # type: ignore[no-untyped-def]
        self._files = files
        super().__init__(*rest)

    def do_GET(self) -> None:
        self._answer(body=True)

    def do_HEAD(self) -> None:
        self._answer(body=False)

    def _answer(self, body: bool) -> None:
        port = cast(tuple[str, int], self.server.server_address)[1]
        known = self.headers.get("Host") in (f"{LOCALHOST}:{port}", f"localhost:{port}")
        path = self._files.get(self.path.partition("?")[0]) if known else None
        if path is None:
            self.send_error(HTTPStatus.NOT_FOUND if known else HTTPStatus.FORBIDDEN)
            return
        try:
            file = path.open("rb")
        except OSError:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        with file, contextlib.suppress(ConnectionError):  # the reader may close the page at any time
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", TYPES[path.suffix])
            self.send_header("Content-Length", str(path.stat().st_size))
            self.send_header("Content-Security-Policy", POLICY)
            self.send_header("Referrer-Policy", "no-referrer")
            self.send_header("X-Content-Type-Options", "nosniff")
            self.send_header("Cache-Control", "no-store" if path.suffix == ".rrd" else "no-cache")
            self.end_headers()
            if body:
                shutil.copyfileobj(file, self.wfile, 1 << 20)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""


class WebViewer(ThreadingHTTPServer):
    """The viewer on one .rrd file, at `address`. Raises `SettingsError` for a port that cannot be had."""

    daemon_threads = True

    def __init__(self, rrd: Path, port: int = 0) -> None:
        if not 0 <= port < 1 << 16:
            raise SettingsError(f"port = {port}: expected 0 (any free one) to 65535")
        files = {f"/{name}": HERE / name for name in ("view.js", "view.css")}
        files |= {"/": HERE / "view.html", f"/{RECORDING}": rrd}
        files |= {f"/{name}": _assets() / name for name in ("widget.js", "widget.css", "re_viewer_bg.wasm")}
        try:
            super().__init__((LOCALHOST, port), partial(_Handler, files))
        except OSError as fault:
            raise SettingsError(
                f"port = {port}: {fault.strerror or fault}; expected a free one, or 0 for any"
            ) from None

    @property
    def address(self) -> str:
        """Where the page is."""
        return f"http://{LOCALHOST}:{self.server_address[1]}/"


@contextlib.contextmanager
def served(rrd: Path, port: int = 0) -> Iterator[str]:
    """The address at which a file can be seen within the `with`."""
    with serve_behind(rrd, port) as server:
        try:
            yield server.address
        finally:
            server.shutdown()


def serve_behind(rrd: Path, port: int = 0) -> WebViewer:
    """A viewer that is served by a thread, as long as the process lives or until it is shut down.

    Raises `FileMissingError` for a file that is not there, and `SettingsError` as `WebViewer`.
    """
    if not rrd.is_file():
        raise FileMissingError(f"{rrd}: does not exist; expected an .rrd file")
    server = WebViewer(rrd, port)
    threading.Thread(target=server.serve_forever, args=(0.1,), daemon=True).start()
    return server


def _assets() -> Path:
    """The folder of the web viewer; found without importing it, since that looks at an address of the internet."""
    from importlib.util import find_spec

    spec = find_spec("rerun_notebook")
    folder = Path(spec.origin).parent / "static" if spec and spec.origin else HERE
    if not (folder / "widget.js").is_file():
        raise FileMissingError(f"{folder / 'widget.js'}: not there; expected the package rerun-notebook")
    return folder
