"""Random inputs are the same on every run, so that a run judges the code alone.

``HYPOTHESIS_PROFILE=random`` draws new ones: what they find becomes an ``@example``.
"""

import gc
import os

import pytest
from hypothesis import settings

import workflow  # noqa: F401 before nbformat: what it leaves out takes seconds to import

settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("random", derandomize=False, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))


LONGEST = ("test_notebooks.py", "test_workflow.py", "test_digests.py", "test_lab.py")
"""Files of minutes; begun last, one of them would keep one worker busy while the other has nothing left."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first: workers take files in this order (``--no-loadscope-reorder``)."""
    items.sort(key=lambda item: LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST))


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """The garbage collector leaves alone what has been imported by now and stays: a tenth of the tests' time."""
    gc.collect()
    gc.freeze()
