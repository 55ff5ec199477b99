"""Downloads, from a server on this machine: checksums, archives, refusals."""

from __future__ import annotations

import functools
import http.server
import io
import logging
import threading
import tracemalloc
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from graphslam.core.errors import DataError, FormatError, MissingDataError
from graphslam.io import fetch as fetching
from graphslam.io.cards import Card, CardArchive, CardFile
from graphslam.io.catalog import check_files, locate
from graphslam.io.fetch import fetch_dataset
from tests.io.test_catalog import sha, toy_card, write_toy

CONTENT = b"0 1 2\n" * 50
SCHEMES = fetching.SCHEMES


class Quiet(http.server.SimpleHTTPRequestHandler):
    served: list[str] = []  # noqa: RUF012  (one server a test, emptied by the fixture)

    def log_message(self, *args: object) -> None:
        pass

    def do_GET(self) -> None:
        self.served.append(self.path)
        super().do_GET()


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, Path]]:
    """A web server of an empty folder, an empty cache and no data folder."""
    root = tmp_path / "www"
    root.mkdir()
    monkeypatch.delenv("GRAPHSLAM_DATA", raising=False)
    monkeypatch.setenv("GRAPHSLAM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("no_proxy", "*")
    monkeypatch.setattr(fetching, "SCHEMES", ("https", "http"))  # the server here has no certificate
    Quiet.served = []
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(root))) as httpd:
        thread = threading.Thread(target=httpd.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{httpd.server_address[1]}", root
        httpd.shutdown()


def linked(url: str) -> Card:
    """The toy card with links; the packed file's link gives its content."""
    a, b, note = toy_card().files
    return toy_card(
        files=(replace(a, url=f"{url}/a.txt"), replace(b, url=f"{url}/b.bin"), replace(note, url=f"{url}/note.txt"))
    )


def serve(root: Path) -> None:
    (root / "a.txt").write_bytes(CONTENT)
    (root / "b.bin").write_bytes(b"abc")
    (root / "note.txt").write_bytes(b"note")


def test_fetch_checks_and_does_not_fetch_twice(
    server: tuple[str, Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    url, root = server
    serve(root)
    c = linked(url)
    with caplog.at_level(logging.INFO):
        folder = fetch_dataset(c)
    assert folder == tmp_path / "cache/toy" == locate(c)
    assert [k.state for k in check_files(c)] == ["ok"] * 3
    assert (folder / "a.txt").read_bytes() == CONTENT
    for text in ("licence: text", "cite: text", f"downloading {url}/b.bin", "fetching 3 of 3 files"):
        assert text in caplog.text
    assert sorted(Quiet.served) == ["/a.txt", "/b.bin", "/note.txt"]
    with caplog.at_level(logging.INFO):
        fetch_dataset(c)
    assert len(Quiet.served) == 3
    assert "already in" in caplog.text
    # one spoilt file is fetched again, alone
    (folder / "sub/b.bin").write_bytes(b"xyz")
    fetch_dataset(c)
    assert Quiet.served[3:] == ["/b.bin"]
    assert [k.state for k in check_files(c)] == ["ok"] * 3


def test_a_spoilt_packed_file_does_not_hide_the_good_plain_one(server: tuple[str, Path], tmp_path: Path) -> None:
    url, root = server
    serve(root)
    write_toy(tmp_path / "cache")
    packed = tmp_path / "cache/toy/a.txt.gz"
    packed.write_bytes(b"spoilt")
    fetch_dataset(linked(url))
    assert not packed.exists()
    assert [k.state for k in check_files(linked(url))] == ["ok"] * 3


def test_wrong_content_is_refused_and_leaves_nothing(server: tuple[str, Path], tmp_path: Path) -> None:
    url, root = server
    serve(root)
    (root / "b.bin").write_bytes(b"abd")
    with pytest.raises(DataError, match=r"b\.bin: checksum of the downloaded file differs"):
        fetch_dataset(linked(url))
    assert not (tmp_path / "cache/toy/sub/b.bin").exists()
    left = {p.name for p in (tmp_path / "cache").rglob("*") if p.is_file()}
    assert left <= {"a.txt"}
    with pytest.raises(MissingDataError, match="data fetch toy"):
        locate(linked(url))


def test_no_such_file_and_no_server(server: tuple[str, Path]) -> None:
    url, _ = server
    with pytest.raises(MissingDataError, match=r"download failed.*404"):
        fetch_dataset(linked(url))
    with pytest.raises(MissingDataError, match="download failed"):
        fetch_dataset(linked("http://127.0.0.1:9"))


def test_no_direct_download_says_where_to_get_it(server: tuple[str, Path]) -> None:
    with pytest.raises(MissingDataError, match=r"'toy' has no direct download.*wanted a copy from there"):
        fetch_dataset(toy_card())


def test_data_that_is_already_there_is_not_downloaded(
    server: tuple[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url, _ = server
    monkeypatch.setenv("GRAPHSLAM_DATA", str(tmp_path / "data"))
    write_toy(tmp_path / "data")
    assert fetch_dataset(linked(url)) == tmp_path / "data/toy"
    assert Quiet.served == []


def zipped(**members: bytes) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as z:
        for name, content in members.items():
            z.writestr(name, content)
    return out.getvalue()


def archived(url: str, *, sha256: str | None = None) -> Card:
    return toy_card(archives=(CardArchive(url=f"{url}/set.zip", members=("a.txt", "b.bin"), sha256=sha256),))


def test_archive_members_are_found_checked_and_put_in_place(server: tuple[str, Path], tmp_path: Path) -> None:
    url, root = server
    data = zipped(**{"Deep/er/A.TXT": CONTENT, "b.bin": b"abc", "evil.sh": b"rm"})
    (root / "set.zip").write_bytes(data)
    for digest in (None, sha(data)):
        folder = fetch_dataset(archived(url, sha256=digest))
        files = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
        assert files == {"a.txt", "sub/b.bin"}  # nothing else, and no archive left
        assert [k.state for k in check_files(archived(url))] == ["ok", "ok", "missing"]
        (folder / "a.txt").unlink()
    assert Quiet.served == ["/set.zip", "/set.zip"]


@pytest.mark.parametrize(
    ("members", "kind", "message"),
    [
        ({"../../a.txt": CONTENT, "b.bin": b"abc"}, FormatError, "outside itself; got ../../a.txt"),
        ({"/etc/a.txt": CONTENT, "b.bin": b"abc"}, FormatError, "outside itself"),
        ({"..\\a.txt": CONTENT, "b.bin": b"abc"}, FormatError, "outside itself"),
        ({"a.txt": CONTENT + b"x", "b.bin": b"abc"}, DataError, "differs from the description of the data set"),
        ({"a.txt": CONTENT[:-1] + b"x", "b.bin": b"abc"}, DataError, "differs from the description of the data set"),
        ({"b.bin": b"abc"}, MissingDataError, "does not hold a.txt"),
    ],
)
def test_bad_archives(
    server: tuple[str, Path], tmp_path: Path, members: dict[str, bytes], kind: type[Exception], message: str
) -> None:
    url, root = server
    (root / "set.zip").write_bytes(zipped(**members))
    before = {p for p in tmp_path.rglob("*") if "cache" not in p.parts}
    with pytest.raises(kind, match=message):
        fetch_dataset(archived(url))
    assert {p for p in tmp_path.rglob("*") if "cache" not in p.parts} == before
    assert not list((tmp_path / "cache").rglob("*.zip"))
    assert not list((tmp_path / "cache").rglob("*.part"))


def test_truncated_archive(server: tuple[str, Path]) -> None:
    url, root = server
    data = zipped(**{"a.txt": CONTENT, "b.bin": b"abc"})
    for cut in (len(data) // 2, len(data) - 5):
        (root / "set.zip").write_bytes(data[:cut])
        with pytest.raises(FormatError, match="truncated or corrupt"):
            fetch_dataset(archived(url))
    (root / "set.zip").write_bytes(data)
    with pytest.raises(DataError, match="checksum of the downloaded file differs"):
        fetch_dataset(archived(url, sha256="0" * 64))


def test_a_bomb_stays_folded(server: tuple[str, Path]) -> None:
    """A member that unfolds to more than the card says is read one byte too far, not to its end."""
    url, root = server
    (root / "set.zip").write_bytes(zipped(**{"a.txt": b"\0" * 200_000_000, "b.bin": b"abc"}))
    tracemalloc.start()
    with pytest.raises(DataError, match="differs from the description of the data set"):
        fetch_dataset(archived(url))
    held = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert held < 20_000_000


def test_optional_file_may_be_missing_from_the_archive(server: tuple[str, Path]) -> None:
    url, root = server
    (root / "set.zip").write_bytes(zipped(**{"a.txt": CONTENT, "b.bin": b"abc"}))
    c = archived(url)
    archive = replace(c.archives[0], members=("a.txt", "b.bin", "note.txt"))
    folder = fetch_dataset(replace(c, archives=(archive,)))
    assert not (folder / "note.txt").exists()
    assert isinstance(c.files[2], CardFile)


class Elsewhere(http.server.BaseHTTPRequestHandler):
    """Sends everybody to another address."""

    to = ""
    asked = 0

    def log_message(self, *args: object) -> None:
        pass

    def do_GET(self) -> None:
        type(self).asked += 1
        self.send_response(302)
        self.send_header("Location", self.to)
        self.end_headers()


@pytest.fixture
def elsewhere(server: tuple[str, Path]) -> Iterator[str]:
    Elsewhere.asked = 0
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Elsewhere) as httpd:
        threading.Thread(target=httpd.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        yield f"http://127.0.0.1:{httpd.server_address[1]}"
        httpd.shutdown()


def test_only_https_is_asked(server: tuple[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    url, root = server
    serve(root)
    monkeypatch.setattr(fetching, "SCHEMES", SCHEMES)  # as they are
    for address in (url, "ftp://127.0.0.1", f"file://{root}"):
        with pytest.raises(DataError, match="address of another scheme"):
            fetch_dataset(linked(address))
    assert Quiet.served == []
    assert not list((tmp_path / "cache").rglob("*.txt"))


@pytest.mark.parametrize("to", ["file:///etc/passwd", "ftp://127.0.0.1/a"])
def test_redirects_to_another_scheme_are_refused(elsewhere: str, to: str) -> None:
    Elsewhere.to = to
    with pytest.raises(DataError, match="address of another scheme"):
        fetch_dataset(linked(elsewhere))
    assert Elsewhere.asked == 1


def test_redirects_are_followed_and_not_for_ever(elsewhere: str, server: tuple[str, Path]) -> None:
    url, root = server
    serve(root)
    Elsewhere.to = f"{url}/a.txt"
    a = linked(elsewhere).files[0]
    folder = fetch_dataset(toy_card(files=(a,)))
    assert (folder / "a.txt").read_bytes() == CONTENT
    (folder / "a.txt").unlink()
    Elsewhere.to = f"{elsewhere}/again"
    with pytest.raises(DataError, match="too many redirects"):
        fetch_dataset(toy_card(files=(a,)))


def test_a_download_that_does_not_end_is_cut(server: tuple[str, Path], tmp_path: Path) -> None:
    url, root = server
    serve(root)
    (root / "b.bin").write_bytes(b"abc" + bytes(1_000_000))
    with pytest.raises(DataError, match="download is larger than the description"):
        fetch_dataset(linked(url))
    assert not list((tmp_path / "cache").rglob("*b.bin*"))
