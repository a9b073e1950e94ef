"""Every page of a gallery in a browser without network: pictures have pixels, views a canvas, nothing overflows."""

import shutil
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, Request

from steelnb import gallery
from tests.test_gallery import EXPERIMENTS, make_project

ROOT = Path(__file__).parents[2]
EXPLORE = """
[explore]
notebook = "00_explore.ipynb"
title = "Explore"
full = {}
smoke = { duration_s = 8.0, sensor = "report" }
"""
PAGES = ["index.html", "explore.html", "long.html"]
READERS = {"light": {"width": 1280, "height": 900}, "dark": {"width": 390, "height": 844}}
# The number of distinct colours of a picture or a canvas, drawn small.
COLOURS = """element => {
    const canvas = document.createElement("canvas");
    canvas.width = canvas.height = 64;
    const context = canvas.getContext("2d", {willReadFrequently: true});
    context.drawImage(element, 0, 0, 64, 64);
    return new Set(new Uint32Array(context.getImageData(0, 0, 64, 64).data.buffer)).size;
}"""
SIDEWAYS = "() => document.documentElement.scrollWidth - document.documentElement.clientWidth"


@pytest.fixture(scope="module")
def pages(chromium: Browser, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The gallery of a tiny project and of the notebook to explore."""
    root = make_project(tmp_path_factory.mktemp("project"), EXPERIMENTS + EXPLORE)
    shutil.copy(ROOT / "notebooks" / "00_explore.ipynb", root / "notebooks")
    made = gallery.make(["explore", "long"], "smoke", root=root)
    assert {path.name for path in made.pages} | {"index.html"} == set(PAGES)
    return made.index.parent


@pytest.mark.parametrize("scheme", READERS)
@pytest.mark.parametrize("name", PAGES)
def test_a_page_shows_all_it_holds_and_asks_for_nothing(chromium: Browser, pages: Path, name: str, scheme: str) -> None:
    complaints: list[str] = []
    asked: list[str] = []

    def note(request: Request) -> None:
        if not request.url.startswith(("data:", "blob:")):
            asked.append(request.url)

    with chromium.new_context(viewport=READERS[scheme], color_scheme=scheme, offline=True) as context:
        page: Page = context.new_page()
        page.on("request", note)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
        page.goto((pages / name).as_uri(), wait_until="load")
        for picture in page.locator("img").element_handles():
            assert picture.evaluate("picture => picture.naturalWidth") > 0
            assert picture.evaluate(COLOURS) > 10
            assert picture.evaluate("picture => picture.clientWidth") <= READERS[scheme]["width"]
        for view in page.locator(".plot").all():
            view.locator(".main-svg").first.wait_for()
        if name == "explore.html":
            canvas = page.locator(".plot canvas").first
            canvas.wait_for()
            page.wait_for_function("() => document.querySelector('.plot')._fullLayout.scene._scene.glplot")
            assert len(set(pixels(canvas.screenshot()))) > 10
        ground = page.evaluate("() => getComputedStyle(document.body).backgroundColor")
        assert ground == {"light": "rgb(255, 255, 255)", "dark": "rgb(20, 24, 30)"}[scheme]
        assert page.evaluate(SIDEWAYS) == 0
        assert page.locator("nav a, article a").first.get_attribute("href")
    assert asked == [(pages / name).as_uri()]
    assert complaints == []


def pixels(picture: bytes) -> list[tuple[int, ...]]:
    """The colours of a PNG file, of every seventh pixel."""
    import io

    from PIL import Image

    with Image.open(io.BytesIO(picture)) as image:
        return list(image.convert("RGB").get_flattened_data())[::7]


def test_every_link_of_the_index_leads_to_a_page(chromium: Browser, pages: Path) -> None:
    with chromium.new_context(offline=True) as context:
        page = context.new_page()
        page.goto((pages / "index.html").as_uri())
        for link in {link.get_attribute("href") for link in page.locator("article a").all()}:
            assert link is not None
            assert (pages / link).is_file()
        page.locator("article h2 a").first.click()
        page.locator("nav a", has_text="All notebooks").click()
        assert page.url == (pages / "index.html").as_uri()


def test_a_view_can_be_turned(chromium: Browser, pages: Path) -> None:
    with chromium.new_context(offline=True) as context:
        page = context.new_page()
        page.goto((pages / "explore.html").as_uri())
        page.locator(".plot canvas").first.wait_for()
        page.locator(".plot").scroll_into_view_if_needed()
        eye = "() => JSON.stringify(document.querySelector('.plot')._fullLayout.scene._scene.getCamera().eye)"
        before = page.evaluate(eye)
        box = page.locator(".plot #scene, .plot .gl-container").first.bounding_box()
        assert box is not None
        page.mouse.move(box["x"] + 300, box["y"] + 200)
        page.mouse.down()
        page.mouse.move(box["x"] + 400, box["y"] + 220, steps=8)
        page.mouse.up()
        page.wait_for_function(f"before => ({eye})() !== before", arg=before)
