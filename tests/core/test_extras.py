"""Extras: what is missing is said in one sentence, and the table is that of the distribution."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import pytest

from graphslam.core.cluster import connect_cluster
from graphslam.core.errors import GraphSlamError, MissingDataError
from graphslam.core.extras import EXTRAS, import_extra

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("extra", EXTRAS)
def test_a_missing_package_names_its_extra_in_one_line(extra: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in EXTRAS[extra].modules:
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(MissingDataError, match=rf"graphslam-submaps\[{extra}\]") as error:
            import_extra(module, "what is wanted", where="a file")
        assert str(error.value).startswith("a file: what is wanted needs ")
        assert "\n" not in str(error.value)


def test_a_cluster_names_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(GraphSlamError, match=r"graphslam-submaps\[cluster\]"):
        connect_cluster("127.0.0.1:1")


def test_the_distribution_offers_every_extra_and_all_of_them_together() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    offered = project["optional-dependencies"]
    assert set(EXTRAS) <= set(offered)
    assert offered["all"] == [f"graphslam-submaps[{','.join(EXTRAS)}]"]
    base = " ".join(project["dependencies"])
    assert not [m for e in EXTRAS.values() for m in (*e.modules, "scikit-image") if m in base]
