"""Random inputs are the same on every run, so that a run judges the code alone.

``HYPOTHESIS_PROFILE=random`` draws new ones: what they find becomes an ``@example``.
"""

import gc
import math
import os

import pytest
from hypothesis import settings

import workflow  # noqa: F401 before nbformat: what it leaves out takes seconds to import
from steelnb import cli_progress

settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("random", derandomize=False, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """The garbage collector leaves alone what has been imported by now and stays: a tenth of the tests' time."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def no_lines_about_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """However slow the machine, a command called in a test prints what it has to say and no stages."""
    monkeypatch.setattr(cli_progress, "LINE_PERIOD_S", math.inf)
