"""JupyterLab as a reader uses it: open notebook 00, run it, move a slider, and see the picture change."""

import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
from playwright.sync_api import Browser, Page

from workflow.run_notebooks import OWN

ROOT = Path(__file__).parents[2]
FOR_PAGE_MS = 60_000
FOR_FLIGHT_MS = 300_000  # kernels are compiled where the cache is empty
HEIGHT_PX = 1000
LONG, SHORT = "duration_s = 40.0", "duration_s = 8.0"
"""Duration of the flight, short since the scene is drawn in software here."""
DRAWN = ".js-plotly-plot canvas"
STATUS = ".widget-html"
DONE = f"{STATUS} >> text=computed in"
# The curves' values in Plotly, which say more than pixels.
ERRORS = "() => Array.from(document.querySelector('.js-plotly-plot')?._fullData?.at(-1).y ?? [])"
CHANGED = f"before => {{ const now = ({ERRORS})(); return now.length && now.join() !== before.join(); }}"


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[str]:
    """The address of a JupyterLab on a copy of the notebook, with the project's settings and nobody else's; ended with
    all its kernels."""
    (tmp_path / "notebooks").mkdir()
    shutil.copy(ROOT / "notebooks" / "runs.toml", tmp_path / "notebooks")
    notebook = (ROOT / "notebooks" / "00_explore.ipynb").read_text(encoding="utf-8")
    assert LONG in notebook
    (tmp_path / "notebooks" / "00_explore.ipynb").write_text(notebook.replace(LONG, SHORT), encoding="utf-8")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    own = {name: str(tmp_path / name) for name in ("IPYTHONDIR", "JUPYTER_RUNTIME_DIR", "JUPYTER_CONFIG_DIR")}
    seen = os.environ | OWN | own | {"JUPYTER_CONFIG_PATH": str(ROOT / "scripts" / "jupyterlab")}
    command = [sys.executable, "-m", "jupyterlab", "--no-browser", f"--port={port}", "--ServerApp.port_retries=0"]
    command += [f"--notebook-dir={tmp_path}", "--IdentityProvider.token=", "--allow-root"]
    with (tmp_path / "log.txt").open("wb") as log:
        process = subprocess.Popen(command, cwd=tmp_path, env=seen, stdout=log, stderr=log, start_new_session=True)
    address = f"http://127.0.0.1:{port}"
    try:
        for _ in range(600):
            assert process.poll() is None, (tmp_path / "log.txt").read_text()
            try:
                urllib.request.urlopen(f"{address}/api", timeout=5).close()
                break
            except OSError:
                time.sleep(0.1)
        yield address
    finally:
        lab = psutil.Process(process.pid)
        for started in [lab, *lab.children(recursive=True)]:
            started.kill()
        process.wait()


@pytest.fixture
def page(chromium: Browser, lab: str) -> Iterator[Page]:
    """A page of that JupyterLab. Requests to other hosts are refused."""
    with chromium.new_context(viewport={"width": 1400, "height": HEIGHT_PX}) as context:
        context.route(
            lambda address: not address.startswith((lab, lab.replace("http", "ws"), "data:", "blob:")),
            lambda route: route.abort(),
        )
        yield context.new_page()


def test_the_notebook_to_explore_runs_and_its_picture_follows_the_slider(page: Page, lab: str) -> None:
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(f"{lab}/lab/tree/notebooks/00_explore.ipynb?reset")
    page.wait_for_selector(".jp-Notebook", timeout=FOR_PAGE_MS)
    page.wait_for_selector("text=| Idle", timeout=FOR_PAGE_MS)  # before that, Run All runs nothing
    page.get_by_role("menuitem", name="Run", exact=True).click()
    page.locator("li[data-command='runmenu:run-all']").click()
    canvas = page.wait_for_selector(DRAWN, timeout=FOR_FLIGHT_MS)
    assert canvas is not None
    page.wait_for_selector(DONE, timeout=FOR_FLIGHT_MS)  # until then the picture is that of the drift
    assert page.locator("[data-mime-type='application/vnd.jupyter.error']").count() == 0
    assert page.locator("[data-mime-type='application/vnd.jupyter.stderr']").count() == 0

    box = page.locator(".js-plotly-plot").bounding_box()
    assert box is not None
    assert 0 < box["y"] < box["y"] + box["height"] < HEIGHT_PX, "the picture is seen without scrolling"
    before, sentence = page.evaluate(ERRORS), page.locator(STATUS)
    assert len(before) > 15
    text = sentence.inner_text()
    page.locator(".jupyter-widgets.widget-slider", has_text="level ×").locator(".noUi-handle").focus()
    page.keyboard.press("PageUp")
    page.wait_for_function(CHANGED, arg=before, timeout=FOR_FLIGHT_MS)
    page.wait_for_selector(DONE, timeout=FOR_FLIGHT_MS)
    after = page.evaluate(ERRORS)
    assert len(after) == len(before)
    assert not np.allclose(after, before, atol=1e-6)
    assert sentence.inner_text() != text
    assert page.locator(DRAWN).count() > 0
    assert page.locator(".jp-Dialog").count() == 0
    assert errors == []
