"""The system's headless Chromium, without access to any network."""

import os
import shutil
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, sync_playwright

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-quic",
    "--enable-unsafe-swiftshader",  # 3D views without a graphics card
)


@pytest.fixture(scope="session")
def chromium() -> Iterator[Browser]:
    """The installed browser. Tests that need one are skipped if there is none."""
    path = next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip(f"none of {', '.join(NAMES)} is installed; on Debian: sudo apt-get install chromium")
    sandbox = () if os.getuid() else ("--no-sandbox",)  # Chromium refuses one to root
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=[*FLAGS, *sandbox])
        yield browser
        browser.close()
