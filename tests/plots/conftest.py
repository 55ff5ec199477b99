"""Here pictures are drawn in full."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.pictures import full_pictures


@pytest.fixture(autouse=True)
def _full_pictures() -> Iterator[None]:
    with full_pictures():
        yield
