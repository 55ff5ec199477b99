"""Registry of readers, and choice of the reader from the content of a source.

A reader is registered under the entry point ``graphslam.readers``; its value is a :class:`~graphslam.io.reader.Reader`:

.. code-block:: toml

    [project.entry-points."graphslam.readers"]
    my-format = "my_package:READER"

Those of this package are in :data:`graphslam.io.recognise.BUILT_IN`. Options of a reader are the keyword arguments of
its function; they are converted by their annotations.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

from graphslam.core.errors import FormatError, GraphSlamError, MissingDataError
from graphslam.core.plugins import load_plugin, plugins, unknown
from graphslam.io.reader import Reader
from graphslam.io.recognise import BUILT_IN
from graphslam.io.source_probe import ReaderMatch, SourceProbe

GROUP = "graphslam.readers"


@cache
def list_readers() -> dict[str, Reader]:
    """All readers by name, in the order in which they are tried: those of other packages first."""
    out: dict[str, Reader] = {}
    for name in plugins(GROUP):
        found = load_plugin(GROUP, "reader", name)
        if not isinstance(found, Reader):
            raise GraphSlamError(f"entry point {name!r} of {GROUP} is no Reader; got {type(found).__name__}")
        out[name] = found
    return {**out, **{k: v for k, v in BUILT_IN.items() if k not in out}}


def find_reader(name: str) -> Reader:
    """The reader with this name."""
    try:
        return list_readers()[name]
    except KeyError:
        raise unknown(GROUP, "reader", name, list_readers()) from None


@dataclass(frozen=True, slots=True)
class RecognisedSource:
    """Reader of a source.

    Parameters
    ----------
    name, found : str
        Name of the reader, and its description of the source.
    also : tuple of str
        ``name: found`` for other readers that can also read the source.
    """

    name: str
    found: str
    also: tuple[str, ...] = ()


def recognise(path: Path) -> RecognisedSource:
    """The first reader that can read a source; :class:`MissingDataError` or :class:`FormatError` if there is none."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise MissingDataError("neither a file nor a folder", where=str(path), got="a pipe, socket or device")
    look = SourceProbe(path)
    whole: list[tuple[str, ReaderMatch]] = []
    nearly: list[tuple[str, ReaderMatch]] = []
    for name, r in list_readers().items():
        claim = r.recognise(look)
        if claim is not None:
            (nearly if claim.missing else whole).append((name, claim))
    if whole:
        name, claim = whole[0]
        return RecognisedSource(name, claim.found, tuple(f"{n}: {c.found}" for n, c in whole[1:]))
    if nearly:
        name, claim = nearly[0]
        raise MissingDataError(
            f"nothing here is complete; nearest is reader {name!r}",
            where=str(path),
            got=claim.found,
            wanted=claim.missing,
        )
    raise FormatError(
        f"no reader knows this {'file' if path.is_file() else 'folder'}",
        where=str(path),
        got=f"{look}{_advice(look)}",
        wanted="one of the sources that `graphslam data readers` lists, or --reader NAME",
    )


_ADVICE = {
    ".pcap": "packets of a lidar: convert them to clouds (PCD, LAS) or a bag with the maker's tool",
    ".png": "images: no camera is read",
    ".jpg": "images: no camera is read",
    ".npy": "arrays without a header that says what they are: build a SensorLog in Python and save_log it",
    ".npz": "arrays without a header that says what they are: build a SensorLog in Python and save_log it",
    ".e57": "E57: export it as LAS or PLY",
    ".zip": "an archive: unpack it first",
    ".tar": "an archive: unpack it first",
    ".7z": "an archive: unpack it first",
}


def _advice(look: SourceProbe) -> str:
    advice = next((text for end, text in _ADVICE.items() if end in look.by_ending), "")
    if look.path.is_file() and not advice and (first := look.lines(look.path, 1)):
        advice = f"first line {first[0][:60]!r}"
    return f"; {advice}" if advice else ""
