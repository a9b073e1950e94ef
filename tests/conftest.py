"""Random inputs are the same on every run, so that failures depend on the code alone.

``HYPOTHESIS_PROFILE=random`` draws new inputs. Failures found with them become an ``@example``.
"""

import gc
import os

import pytest
from hypothesis import settings

settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("random", derandomize=False, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))


LONGEST = ("test_notebooks.py", "test_docs.py", "test_workflow.py", "test_digests.py", "test_lab.py")
"""Files that take minutes. If one of them began last, one worker would be idle until it ends."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first: workers take files in this order (``--no-loadscope-reorder``)."""
    items.sort(key=lambda item: LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST))


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """Exclude everything imported so far from garbage collection, which saves a tenth of the tests' time."""
    gc.collect()
    gc.freeze()
