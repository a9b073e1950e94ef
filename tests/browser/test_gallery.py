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


@pytest.fixture(scope="module")
def whole(chromium: Browser, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The gallery of this project at its smoke budget; `tests/test_notebooks.py` looks at the same runs."""
    made = gallery.make([], "smoke", output=tmp_path_factory.mktemp("gallery"), root=ROOT)
    assert not made.missing
    return made.index.parent


@pytest.mark.parametrize("scheme", READERS)
@pytest.mark.parametrize("name", PAGES)
def test_a_page_shows_all_it_holds_and_asks_for_nothing(chromium: Browser, pages: Path, name: str, scheme: str) -> None:
    assert look(chromium, pages / name, scheme) == []


def test_every_page_of_the_project_shows_all_it_holds_and_asks_for_nothing(chromium: Browser, whole: Path) -> None:
    found = {
        path.name: look(chromium, path, list(READERS)[k % 2]) for k, path in enumerate(sorted(whole.glob("*.html")))
    }
    assert len(found) > len(list((ROOT / "notebooks").glob("*.ipynb")))
    assert {name: faults for name, faults in found.items() if faults} == {}


def look(chromium: Browser, path: Path, scheme: str) -> list[str]:
    """Open a page as one of `READERS`, and say what is wrong with it."""
    faults: list[str] = []
    width, address = READERS[scheme]["width"], path.as_uri()

    def note(request: Request) -> None:
        if not request.url.startswith(("data:", "blob:")) and request.url != address:
            faults.append(f"asks for {request.url}")

    with chromium.new_context(viewport=READERS[scheme], color_scheme=scheme, offline=True) as context:
        page: Page = context.new_page()
        page.on("request", note)
        page.on("pageerror", lambda error: faults.append(f"error: {error}"))
        page.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
        page.goto(address, wait_until="load")
        for k, picture in enumerate(page.locator("img").element_handles()):
            if picture.evaluate("picture => picture.naturalWidth") == 0 or picture.evaluate(COLOURS) <= 10:
                faults.append(f"picture {k} is empty")
            if picture.evaluate("picture => picture.clientWidth") > width:
                faults.append(f"picture {k} is wider than the window")
        for view in page.locator(".plot").all():
            view.locator(".main-svg").first.wait_for()
        for canvas in page.locator(".plot .gl-container canvas").all()[:1]:
            canvas.wait_for()
            page.wait_for_function("() => document.querySelector('.plot:has(canvas)')._fullLayout.scene._scene.glplot")
            if len(set(pixels(canvas.screenshot()))) <= 10:
                faults.append("the 3D view is empty")
        if path.name == "explore.html" and not page.locator(".plot canvas").count():
            faults.append("no 3D view")
        ground = page.evaluate("() => getComputedStyle(document.body).backgroundColor")
        if ground != {"light": "rgb(255, 255, 255)", "dark": "rgb(20, 24, 30)"}[scheme]:
            faults.append(f"{ground} is no {scheme} ground")
        if page.evaluate(SIDEWAYS):
            faults.append(f"{page.evaluate(SIDEWAYS)} pixels wider than a window of {width}")
        if not page.locator("nav a, article a").first.get_attribute("href"):
            faults.append("leads nowhere")
    return faults


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
