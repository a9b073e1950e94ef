"""The test of tables of calls that are refused."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import pytest

from steelnb.core.errors import InputError


def refused_by_name(refused: Mapping[str, Sequence[Callable[[], Any]]]) -> Callable[[str], None]:
    """A test that each call of a table is refused in one line that begins with the name of its argument or field."""

    @pytest.mark.parametrize("name", refused)
    def test(name: str) -> None:
        for call in refused[name]:
            with pytest.raises(InputError, match=rf"^{name}\b") as refusal:
                call()
            assert "\n" not in str(refusal.value)

    return test
