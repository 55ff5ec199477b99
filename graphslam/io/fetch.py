"""Download of data sets into the cache; the size and checksum of every file are checked."""

from __future__ import annotations

import hashlib
import logging
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from urllib.parse import urljoin, urlsplit

from graphslam.core.atomic import atomic_open
from graphslam.core.errors import DataError, FormatError, MissingDataError
from graphslam.core.reading import most_bytes
from graphslam.io.cards import Card, CardArchive, CardFile, find_card
from graphslam.io.catalog import cache_folder, check_file, data_roots

log = logging.getLogger(__name__)
TIMEOUT = 60.0
"""Time without an answer after which a download fails [s]."""
SCHEMES = ("https",)
"""Allowed schemes of addresses and of redirects."""
MOST_REDIRECTS = 5


def fetch_dataset(data: Card | str, *, progress: bool = False) -> Path:
    """Make all files of a data set available locally; download files that are missing or differ.

    Parameters
    ----------
    progress : bool
        Show a progress bar for every download.

    Returns
    -------
    Path
        Folder with the files: the cache, or the data root that already had them.
    """
    c = find_card(data) if isinstance(data, str) else data
    log.info("%s: %s", c.name, c.title)
    log.info("%s: licence: %s. %s", c.name, c.licence, c.terms)
    log.info("%s: please cite: %s", c.name, c.citation)
    for root in data_roots():
        states = [check_file(root / c.folder, f) for f in c.files]
        if all(s.state == "ok" or (s.state == "missing" and s.file.optional) for s in states):
            log.info("%s: already in %s, checksums agree", c.name, root / c.folder)
            return root / c.folder
    if not c.fetchable:
        raise MissingDataError(
            f"data set {c.name!r} has no direct download",
            where=c.source,
            wanted=f"a copy from there (ours came from {c.obtained_from}), in a folder {c.folder}/ of a data root",
        )
    target = cache_folder() / c.folder
    target.mkdir(parents=True, exist_ok=True)
    todo = [f for f in c.files if check_file(target, f).state != "ok"]
    log.info("%s: fetching %d of %d files into %s", c.name, len(todo), len(c.files), target)
    unpack: dict[str, list[CardFile]] = {}
    archives: dict[str, CardArchive] = {}
    for f in todo:
        archive = c.archive_of(f)
        if f.url:
            _fetch_file(c, f, target, progress)
        elif archive:
            unpack.setdefault(archive.url, []).append(f)
            archives[archive.url] = archive
        else:
            log.info("%s: %s has no direct download; it is not needed", c.name, f.path)
    for url, wanted in unpack.items():
        packed = _download(c, url, target, f".{PurePosixPath(url).name}", archives[url].sha256, most_bytes(), progress)
        try:
            _unpack(packed, wanted, target)
        finally:
            packed.unlink(missing_ok=True)
    return target


def _fetch_file(c: Card, f: CardFile, target: Path, progress: bool) -> None:
    """Download a file, or its uncompressed content if that has a checksum."""
    assert f.url is not None
    name, digest, size = f.path, f.sha256, f.bytes
    if f.plain_path and f.content_bytes is not None:
        name, digest, size = f.plain_path, f.content_sha256 or "", f.content_bytes
    folder = target / PurePosixPath(name).parent
    folder.mkdir(parents=True, exist_ok=True)
    if f.plain_path:
        (target / f.path).unlink(missing_ok=True)  # a damaged compressed file would hide the plain one
    _download(c, f.url, folder, PurePosixPath(name).name, digest, size, progress)


def _download(c: Card, url: str, folder: Path, name: str, digest: str | None, most: int, progress: bool) -> Path:
    import pooch
    import requests

    log.info("%s: downloading %s", c.name, url)
    # quiet: pooch recommends to add an unknown hash to the code; here the members of an archive are checked instead
    pooch.get_logger().setLevel("WARNING")
    (folder / name).unlink(missing_ok=True)  # without a known hash pooch would keep an old file
    try:
        return Path(
            pooch.retrieve(
                url,
                known_hash=None if digest is None else f"sha256:{digest}",
                fname=name,
                path=folder,
                downloader=lambda address, file, _: _stream(address, file, most, progress),
            )
        )
    except requests.exceptions.RequestException as error:
        raise MissingDataError(
            f"download failed ({type(error).__name__}: {error}); get the files by hand from {c.source}", where=url
        ) from None
    except ValueError as error:
        if "hash" not in str(error):
            raise DataError(f"download failed ({error})", where=url) from None
        raise DataError(
            "checksum of the downloaded file differs from the description of the data set; the file was deleted",
            where=url,
            wanted=f"sha256 {digest}",
        ) from None


def _stream(url: str, file: str, most: int, progress: bool) -> None:
    """Download an address to a file, at most ``most`` bytes; every redirect must have an allowed scheme."""
    import requests

    from graphslam.core.progress import Bar

    with requests.Session() as session:
        at = url
        for _ in range(MOST_REDIRECTS + 1):
            scheme = urlsplit(at).scheme
            if scheme not in SCHEMES:
                raise DataError("address of another scheme; nothing was asked", where=at, got=scheme, wanted=SCHEMES[0])
            with session.get(at, stream=True, timeout=TIMEOUT, allow_redirects=False) as answer:
                if answer.is_redirect:
                    at = urljoin(at, answer.headers["location"])
                    continue
                answer.raise_for_status()
                size = 0
                with open(file, "wb") as out, Bar(total=most, unit="B", unit_scale=True, shown=progress) as bar:
                    for part in answer.iter_content(1 << 16):
                        size += len(part)
                        if size > most:
                            raise DataError(
                                "download is larger than the description of the data set says; the file was deleted",
                                where=at,
                                wanted=f"{most} bytes",
                            )
                        out.write(part)
                        bar.update(len(part))
                return
    raise DataError("too many redirects", where=url, wanted=f"{MOST_REDIRECTS} at most")


def _unpack(packed: Path, wanted: list[CardFile], target: Path) -> None:
    """Extract the wanted files of a zip archive by their base names to their paths below ``target``; no other files."""
    where = packed.name.removeprefix(".")
    try:
        with zipfile.ZipFile(packed) as archive:
            members = archive.infolist()
            for m in members:
                p = PurePosixPath(m.filename.replace("\\", "/"))
                if p.is_absolute() or ".." in p.parts or ":" in m.filename:
                    raise FormatError("archive names a path outside itself", where=where, got=m.filename)
            by_name = {PurePosixPath(m.filename).name.lower(): m for m in members if not m.is_dir()}
            for f in wanted:
                name, size, digest = f.path, f.bytes, f.sha256
                if f.plain_path and f.content_bytes is not None and f.content_sha256 is not None:
                    name, size, digest = f.plain_path, f.content_bytes, f.content_sha256
                member = by_name.get(PurePosixPath(name).name.lower())
                if member is None:
                    if f.optional:
                        log.warning("%s: not in the archive %s", name, where)
                        continue
                    raise MissingDataError(f"archive does not hold {PurePosixPath(name).name}", where=where)
                with archive.open(member) as stream:
                    content = stream.read(size + 1)  # limits the size: protects against zip bombs
                if len(content) != size or hashlib.sha256(content).hexdigest() != digest:
                    raise DataError(
                        f"{member.filename} differs from the description of the data set",
                        where=where,
                        wanted=f"sha256 {digest}",
                    )
                (target / name).parent.mkdir(parents=True, exist_ok=True)
                with atomic_open(target / name) as out:
                    out.write(content)
                if name != f.path:
                    (target / f.path).unlink(missing_ok=True)  # a damaged compressed file would hide it
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise FormatError(f"archive is truncated or corrupt ({error})", where=where) from None
