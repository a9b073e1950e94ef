"""Flights in a browser that reaches no other machine: rerun's viewer as `steelnb view --web` shows it, in a notebook's
frame, and the page of notebook 09, which stays when no kernel is there."""

import io
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, Route

from steelnb import gallery
from steelnb.figures.scene import TRACKS
from steelnb.viewer.layout import BARS
from steelnb.viewer.web import served
from tests.viewer.test_log import fly

ROOT = Path(__file__).parents[2]
VIEW = {"width": 1100, "height": 700}
DRAWN_S = 120.0
"""A viewer of 60 MB is compiled, and drawn without a graphics card."""
OWN = """
[your-own-recording]
notebook = "09_your_own_recording.ipynb"
title = "Your own recording"
full = {}
smoke = { duration_s = 8.0, play_rate = 20.0, sensor = "report" }
"""


@contextmanager
def alone(chromium: Browser, address: str) -> Iterator[tuple[Page, list[str]]]:
    """A page that gets nothing from any other address, and a list of what it asked for there."""
    asked: list[str] = []

    def refuse(route: Route) -> None:
        asked.append(route.request.url)
        route.abort()

    with chromium.new_context(viewport=VIEW) as context:
        context.route(lambda url: not url.startswith((address, "data:", "blob:")), refuse)
        yield context.new_page(), asked


def shares(page: Page, colours: dict[str, str]) -> dict[str, int]:
    """How many pixels of the page have nearly each colour."""
    with Image.open(io.BytesIO(page.screenshot())) as image:
        pixels = np.asarray(image.convert("RGB"), dtype=int)
    wanted = {name: np.array(list(bytes.fromhex(colour[1:]))) for name, colour in colours.items()}
    return {name: int((np.abs(pixels - colour).max(axis=2) < 24).sum()) for name, colour in wanted.items()}


def wait_until(drawn: Callable[[], bool], page: Page) -> None:
    until_s = time.monotonic() + DRAWN_S
    while not drawn():
        assert time.monotonic() < until_s, "nothing of the flight was drawn"
        page.wait_for_timeout(500)


@pytest.fixture(scope="module")
def rrd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fly(tmp_path_factory.mktemp("view") / "flight.rrd")


@pytest.mark.slow
@pytest.mark.parametrize("framed", [False, True], ids=["page", "frame"])
def test_the_viewer_draws_the_flight_and_asks_nobody(
    chromium: Browser, rrd: Path, framed: bool, tmp_path: Path
) -> None:
    colours = {"drifting": TRACKS["drifting"], "corrected": TRACKS["corrected"], "bars": BARS}
    with served(rrd) as address, alone(chromium, address) as (page, asked):
        if framed:
            page.set_content(f'<iframe src="{address}" style="width: 100%; height: 95vh; border: 0"></iframe>')
        else:
            page.goto(address)
        view = page.frame_locator("iframe") if framed else page
        view.locator("canvas").first.wait_for(timeout=1000 * DRAWN_S)
        wait_until(lambda: all(count > 30 for count in shares(page, colours).values()), page)
        assert page.locator("text=error").count() == 0
    assert asked == []


def test_the_policy_of_the_page_is_what_keeps_it_from_asking(chromium: Browser, rrd: Path) -> None:
    with served(rrd) as address, alone(chromium, address) as (page, asked):
        page.goto(address)
        fetched = "url => fetch(url, {mode: 'no-cors'}).then(() => 'sent', () => 'refused')"
        for url in (
            "https://tel.rerun.io/api/pog",
            "https://api.github.com/",
            "http://127.0.0.1:9/",
            "http://[::1]:9/",
        ):
            assert page.evaluate(fetched, url) == "refused"
        assert page.evaluate(fetched, f"{address}view.css") == "sent"
    assert asked == []


@pytest.mark.slow
def test_the_page_of_notebook_09_shows_the_flight_without_a_kernel(
    chromium: Browser, tmp_path_factory: pytest.TempPathFactory
) -> None:
    root = tmp_path_factory.mktemp("own")
    (root / "notebooks").mkdir()
    (root / "notebooks" / "experiments.toml").write_text(OWN, encoding="utf-8")
    shutil.copy(ROOT / "notebooks" / "09_your_own_recording.ipynb", root / "notebooks")
    made = gallery.make(["your-own-recording"], "smoke", root=root)
    address = made.pages[0].as_uri()
    complaints: list[str] = []
    with alone(chromium, address) as (page, asked):
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(address, wait_until="load")
        pictures = page.locator("img").element_handles()
        assert len(pictures) == 4
        for picture in pictures:
            assert picture.evaluate("picture => picture.naturalWidth") > 0
        assert page.locator("iframe").count() == 0
        assert page.locator("p.note", has_text="make lab").count() == 1
        plot = page.locator(".plot")
        plot.scroll_into_view_if_needed()
        page.wait_for_function("() => document.querySelector('.plot')._fullLayout?.scene._scene.glplot")
        colours = {"drifting": TRACKS["drifting"], "corrected": TRACKS["corrected"]}
        wait_until(lambda: all(count > 30 for count in shares(page, colours).values()), page)
    assert asked == []
    assert complaints == []
