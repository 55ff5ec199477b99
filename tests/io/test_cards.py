"""Data-set cards: every one that ships, and what is wrong with bad ones."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from graphslam.core.errors import FormatError, UnknownNameError
from graphslam.io.cards import Card, cards_folder, find_card, list_cards, read_card
from graphslam.io.catalog import check_file
from graphslam.io.readers import list_readers

CARDS = list_cards()


def test_there_are_cards_and_they_are_the_files() -> None:
    assert {c.name for c in CARDS} == {p.stem for p in cards_folder().glob("*.toml")}
    assert {"victoria-park", "victoria-park-local-maps", "victoria-park-graph", "posegraphs"} <= {c.name for c in CARDS}


@pytest.mark.parametrize("c", CARDS, ids=lambda c: c.name)
def test_card_says_what_a_user_must_know(c: Card) -> None:
    for text in (c.title, c.records, c.source, c.obtained_from, c.citation, c.licence, c.terms):
        assert len(text) > 3
    assert c.caveats
    assert re.match(r"https?://", c.source)
    assert c.reader is None or c.reader in list_readers() or c.reader == "pose-network"
    for f in c.files:
        assert f.url is None or f.url.startswith("https://")
        if f.path.endswith((".gz", ".bz2", ".xz")):
            assert f.content_sha256 is not None
            assert (f.content_bytes or 0) > f.bytes
    names = {f.plain_path or f.path for f in c.files}
    for a in c.archives:
        assert set(a.members) <= names
    assert c.name in c._repr_html_()


def test_readme_lists_every_card() -> None:
    folder = Path(__file__).resolve().parents[2] / "datasets"
    rows = re.findall(
        r"^\| `([a-z0-9-]+)` \| ([a-z-]+) \|.*\| (direct|by hand) \|$", (folder / "README.md").read_text(), re.M
    )
    assert sorted(rows) == sorted((c.name, c.kind, "direct" if c.fetchable else "by hand") for c in CARDS)


@pytest.mark.data
@pytest.mark.parametrize("c", CARDS, ids=lambda c: c.name)
def test_checksums_are_those_of_the_recorded_data(c: Card, data_dir: Path) -> None:
    folder = data_dir / c.folder
    if not folder.is_dir():
        if os.environ.get("CI"):
            pytest.fail(f"{c.folder} is not in this data root, and this is CI")
        pytest.skip(f"{c.folder} is not in this data root")
    assert {check_file(folder, f).state for f in c.files} == {"ok"}


def test_unknown_name_offers_close_ones() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown data set 'victoria-prak'; did you mean victoria-park"):
        find_card("victoria-prak")
    with pytest.raises(UnknownNameError, match=r"unknown data set 'zzz'; known: carmen"):
        find_card("zzz")


GOOD = """format = "graphslam.card/1"
name = "toy"
title = "t"
kind = "sensor-log"
folder = "toy"
records = "r"
source = "https://example.org"
obtained_from = "o"
citation = "c"
licence = "l"
terms = "t"
caveats = ["c"]
files = [ { path = "a.txt.gz", bytes = 3, sha256 = "HASH", content_bytes = 9, content_sha256 = "HASH" } ]
""".replace("HASH", "0" * 64)


def test_good_card(tmp_path: Path) -> None:
    path = tmp_path / "toy.toml"
    path.write_text(GOOD)
    c = read_card(path)
    assert c.files[0].plain_path == "a.txt"
    assert not c.fetchable
    assert c.bytes == 3


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('format = "graphslam.card/1"', 'format = "graphslam.card/9"', "unknown format"),
        ('name = "toy"', 'name = "other"', "differs from its file name"),
        ('kind = "sensor-log"', 'kind = "film"', "unknown kind"),
        ('title = "t"', "title = 3", "title is not of type str"),
        ('title = "t"', 'titel = "t"', "unknown key 'titel'"),
        ('title = "t"', "", "incomplete"),
        ('folder = "toy"', 'folder = "../toy"', "leaves the folder"),
        ('folder = "toy"', 'folder = "/toy"', "leaves the folder"),
        ('path = "a.txt.gz"', 'path = "b/../../a.txt.gz"', "leaves the folder"),
        ('path = "a.txt.gz"', 'path = "c:\\\\a.txt.gz"', "leaves the folder"),
        ('path = "a.txt.gz"', 'path = "a.txt"', "not compressed"),
        ("bytes = 3", "bytes = -3", "bytes is not of type int"),
        ("bytes = 3", "bytes = true", "bytes is not of type int"),
        (", content_bytes = 9", "", "bad checksum"),
        ('sha256 = "0', 'sha256 = "x', "bad checksum"),
        ("files = [ {", "files = [] \nfile = [ {", "unknown key 'file'"),
        ('caveats = ["c"]', 'caveats = "c"', "caveats is not of type"),
        ('caveats = ["c"]', "caveats = [", "not TOML"),
    ],
)
def test_bad_cards_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in GOOD
    path = tmp_path / "toy.toml"
    path.write_text(GOOD.replace(old, new, 1))
    with pytest.raises(FormatError, match=message):
        read_card(path)
