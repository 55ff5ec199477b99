"""What matching keeps of closed maps: as much as is said, the last that was asked for."""

from __future__ import annotations

import pytest

from graphslam_frontends.segslam import matching
from graphslam_frontends.segslam.matching import RecentCache


def test_what_was_asked_for_longest_ago_goes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matching, "KEPT_BYTES", 10)
    made: list[str] = []

    def maker(key: str, size: int):
        def make() -> bytes:
            made.append(key)
            return bytes(size)

        return make

    kept: RecentCache[str, bytes] = RecentCache(len)
    for key in ("a", "b", "a"):
        kept.of(key, maker(key, 4))
    assert made == ["a", "b"]
    kept.of("c", maker("c", 4))  # 12 bytes: b was asked for longest ago
    assert list(kept) == ["a", "c"]
    assert len(kept.of("d", maker("d", 50))) == 50  # larger than all that may be kept, and yet there
    assert list(kept) == ["d"]
    assert kept.of("b", maker("b", 3)) == bytes(3)
    assert made == ["a", "b", "c", "d", "b"]
    kept.keep(lambda key: key == "x")
    assert not kept
