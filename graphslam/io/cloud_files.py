"""Reader of one cloud from one file: BIN (KITTI), PLY, PCD, LAS, LAZ; points, and their times if present.

Headers are parsed strictly, and sizes are compared with the file before memory is allocated. Points that are not finite
are dropped, and so are points at the origin, which drivers write for a missing return.
"""

from __future__ import annotations

import io
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import FormatError, MissingDataError
from graphslam.core.extras import import_extra
from graphslam.core.geometry import Array
from graphslam.core.reading import check_size, finite_mask, read_bytes
from graphslam.io.source_probe import file_ending, plain_name

TIME_FIELDS = ("t", "time", "timestamp", "time_stamp", "offset_time", "timestampoffset", "time_offset", "gps_time")
"""Names of fields with point times, in lower case and without the prefix ``scalar_``."""
_PLY_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2"},
    **{"uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4"},
    **{"double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8"},
}
_HEADER = 1 << 16
_PCD = rb"(#.*\n)*\s*VERSION\s"
_KNOWN = "BIN, PLY, PCD, LAS or LAZ"
BIN_COLUMNS = 4
"""Default number of columns of BIN files: x, y, z and intensity of KITTI."""
USUAL_COLUMNS = (3, 4, 5, 6)
"""Numbers of columns that are tested."""


@dataclass(frozen=True, slots=True)
class CloudData:
    """Points of one file.

    Parameters
    ----------
    points : (m, 3)
        Finite [m].
    times : (m,) or None
        Times in the unit of the file.
    field : str
        Name of the field with the times.
    not_finite, at_origin : int
        Numbers of dropped points.
    """

    points: Array
    times: Array | None = None
    field: str = ""
    not_finite: int = 0
    at_origin: int = 0


def clean_cloud(points: Array, times: Array | None = None, field: str = "") -> CloudData:
    """A cloud from the usable ones of ``points`` ``(m, 3)``."""
    finite = np.asarray(finite_mask(points).all(axis=1))
    if times is not None:
        finite &= np.asarray(finite_mask(times))
    with np.errstate(invalid="ignore"):
        zero = finite & (points == 0.0).all(axis=1)
    keep = finite & ~zero
    return CloudData(
        np.ascontiguousarray(points[keep], dtype=np.float64),
        None if times is None else np.ascontiguousarray(times[keep], dtype=np.float64),
        field,
        int((~finite).sum()),
        int(zero.sum()),
    )


def read_cloud(path: str | os.PathLike[str], *, columns: int = 4) -> CloudData:
    """Read one cloud; the format is detected from the first bytes, BIN from the file name extension.

    Parameters
    ----------
    columns : int
        Number of float32 columns of a BIN file, x, y and z first: 4 in KITTI, 5 in nuScenes.
    """
    p = Path(path)
    raw = read_bytes(p)
    if raw.startswith(b"ply"):
        return _ply(raw, str(p))
    if raw[:4] == b"LASF":
        return _las(raw, str(p))
    if re.match(_PCD, raw[:2000]):
        return _pcd(raw, str(p))
    if file_ending(p) == ".bin":
        return _bin(raw, str(p), columns)
    raise FormatError("no cloud of a known format", where=str(p), got=repr(raw[:12]), wanted=_KNOWN)


def bin_columns(paths: list[Path], *, most: int = 1 << 20) -> int:
    """Number of float32 columns of BIN files, estimated from their content.

    The columns (x, y, z, intensity) have different distributions. With a wrong number of columns, each column is a
    mixture of the true ones, and mixtures are closer to the pooled distribution than their parts on average. So the
    Kolmogorov–Smirnov distance of the columns from the pool, averaged over columns, is largest for the true number and
    its multiples; the smallest number within the statistical error of the largest distance is returned.

    Parameters
    ----------
    paths : list of Path
        BIN files with equal columns; files that cannot be read are skipped.
    most : int
        Maximal number of bytes that are read per file.
    """
    raws: list[bytes] = []
    whole = dict.fromkeys(USUAL_COLUMNS, 0)
    for p in paths:
        try:
            size = p.stat().st_size
            with open(p, "rb") as stream:
                raws.append(stream.read(most))
        except OSError:
            continue
        for c in USUAL_COLUMNS:
            whole[c] += size % (4 * c) == 0
    fits = [c for c in USUAL_COLUMNS if 2 * whole[c] > len(raws)]  # a file may be damaged
    values = [np.frombuffer(r[: len(r) // 4 * 4], "<f4") for r in raws]
    total = sum(len(v) for v in values)
    if not fits or total < 300:
        return BIN_COLUMNS
    apart = {c: _columns_apart([v[: len(v) // c * c].reshape(-1, c) for v in values]) for c in fits}
    best = max(apart.values())
    chance = {c: 2.0 * np.sqrt(c / total) for c in apart}  # error of c distances from n / c values each
    if best <= max(chance.values()):
        return BIN_COLUMNS
    return min(c for c in apart if apart[c] > best - chance[c])


def _columns_apart(tables: list[npt.NDArray[np.float32]]) -> float:
    """Mean Kolmogorov–Smirnov distance of the distribution of a column from that of all columns."""
    columns = np.nan_to_num(np.concatenate(tables), nan=3e38, posinf=3e38, neginf=-3e38)
    pool = np.sort(columns, axis=None)
    at = np.unique(pool)
    below = np.searchsorted(pool, at, side="right") / len(pool)
    far = [np.abs(np.searchsorted(np.sort(c), at, side="right") / len(c) - below).max() for c in columns.T]
    return float(np.mean(far))


def count_points(path: str | os.PathLike[str], *, columns: int = 4) -> int:
    """Number of points by the header, if the file is long enough; only compressed files are decoded.

    Parameters
    ----------
    columns : int
        As for :func:`read_cloud`.
    """
    p = Path(path)
    if plain_name(p) != p.name.lower():  # compressed: the size is known only after decompression
        return len(read_cloud(p, columns=columns).points)
    try:
        size = p.stat().st_size
        with open(p, "rb") as stream:
            head = stream.read(_HEADER)
    except OSError as error:
        raise MissingDataError(f"file cannot be read ({error.strerror})", where=str(p)) from None
    if head.startswith(b"ply"):
        layout = _ply_layout(head, str(p))
    elif head[:4] == b"LASF":
        return _las_count(head, size, str(p))
    elif re.match(_PCD, head[:2000]):
        layout = _pcd_layout(head, str(p))
    elif file_ending(p) == ".bin":
        return _bin_count(size, str(p), columns)
    else:
        raise FormatError("no cloud of a known format", where=str(p), got=repr(head[:12]), wanted=_KNOWN)
    if size < layout.least_bytes():
        raise FormatError(
            "file is truncated",
            where=str(p),
            got=f"{size} bytes",
            wanted=f"{layout.least_bytes()} for {layout.count} points",
        )
    return layout.count


def _bin_count(size: int, where: str, columns: int) -> int:
    if not 3 <= columns <= 32:
        raise FormatError("number of columns is impossible", where=where, got=columns, wanted="3 to 32")
    if size % (4 * columns):
        fits = [c for c in (3, 4, 5, 6) if size % (4 * c) == 0]
        raise FormatError(
            f"size is no multiple of {columns} float32",
            where=where,
            got=f"{size} bytes",
            wanted=f"whole points, or option columns ({' or '.join(map(str, fits)) or 'no usual number'} would fit)",
        )
    return size // (4 * columns)


def _bin(raw: bytes, where: str, columns: int) -> CloudData:
    _bin_count(len(raw), where, columns)
    return clean_cloud(np.frombuffer(raw, "<f4").reshape(-1, columns)[:, :3].astype(np.float64))


def columns_cloud(fields: dict[str, npt.NDArray[Any]], where: str) -> CloudData:
    """A cloud from named columns."""
    lower = {k.lower().removeprefix("scalar_"): k for k in fields}
    if not {"x", "y", "z"} <= lower.keys():
        raise FormatError("points have no x, y, z", where=where, got=", ".join(fields)[:200], wanted="x, y, z")
    xyz = np.column_stack([fields[lower[c]].astype(np.float64) for c in "xyz"])
    name = next((lower[n] for n in TIME_FIELDS if n in lower), "")
    times = fields[name].astype(np.float64) if name else None
    return clean_cloud(xyz, times, name)


@dataclass(frozen=True, slots=True)
class _Layout:
    """Layout from the header of a file: first byte of the points, their number, and their encoding.

    ``dtype`` is None for text, of which ``skip`` lines precede the points; ``packed``: columns of a compressed PCD.
    """

    begin: int
    count: int
    labels: list[str]
    dtype: np.dtype[Any] | None = None
    skip: int = 0
    packed: list[tuple[str, str, int]] | None = None

    def least_bytes(self) -> int:
        """Minimal size of the file [bytes]."""
        if self.packed is not None:
            return self.begin + 8
        size = 2 * len(self.labels) if self.dtype is None else self.dtype.itemsize
        return self.begin + self.count * size - (self.dtype is None)  # the last line may end without a break


def _ply_layout(head: bytes, where: str) -> _Layout:
    end = re.search(rb"end_header[ \t]*\r?\n", head[:_HEADER])
    if end is None:
        raise FormatError("PLY header has no end", where=where, wanted="end_header in the first 64 kB")
    form, elements = "", list[tuple[str, int, list[tuple[str, str]]]]()
    for line in head[: end.start()].decode("latin-1").splitlines():
        words = line.split()
        try:
            if words[:1] == ["format"]:
                form = words[1]
            elif words[:1] == ["element"]:
                elements.append((words[1], int(words[2]), []))
            elif words[:1] == ["property"]:
                kind = "list" if words[1] == "list" else _PLY_TYPES[words[1]]
                elements[-1][2].append((words[-1], kind))
        except (IndexError, ValueError, KeyError) as error:
            raise FormatError(f"PLY header is damaged ({error})", where=where, got=line[:80]) from None
    names = [e[0] for e in elements]
    if "vertex" not in names:
        raise FormatError("PLY file holds no vertices", where=where, got=", ".join(names) or None, wanted="vertex")
    at = names.index("vertex")
    _, n, properties = elements[at]
    labels = [p for p, _ in properties]
    lists = [p for p, k in properties if k == "list"]
    if n < 0 or lists or len(set(labels)) != len(labels) or not labels:
        got = f"property {lists[0]!r} is a list" if lists else f"{n} vertices with properties {labels}"
        wanted = "vertices of plain numbers, each name once: write the file without others"
        raise FormatError("vertices of this PLY file are not read", where=where, got=got, wanted=wanted)
    if form == "ascii":
        return _Layout(end.end(), n, labels, skip=sum(e[1] for e in elements[:at]))
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(form)
    if order is None:
        raise FormatError("unknown form of PLY", where=where, got=form, wanted="ascii or binary")
    first = 0
    for _, count, inner in elements[:at]:
        if count < 0 or any(k == "list" for _, k in inner):
            raise FormatError("lists before the vertices are not read", where=where, wanted="vertices first")
        first += count * sum(np.dtype(k).itemsize for _, k in inner)
    dtype = np.dtype([(p, order + k) for p, k in properties])
    return _Layout(end.end() + first, n, labels, dtype)


def _ply(raw: bytes, where: str) -> CloudData:
    layout = _ply_layout(raw[:_HEADER], where)
    body = raw[layout.begin :]
    if layout.dtype is None:
        rows = body.splitlines()[layout.skip : layout.skip + layout.count]
        return columns_cloud(_ascii(rows, layout.count, layout.labels, where), where)
    return columns_cloud(_records(body, layout.count, layout.dtype, where), where)


def _ascii(rows: list[bytes], n: int, labels: list[str], where: str) -> dict[str, npt.NDArray[Any]]:
    if len(rows) < n:
        raise FormatError("file is truncated", where=where, got=f"{len(rows)} points", wanted=n)
    words = [r.split() for r in rows]
    bad = next((k for k, w in enumerate(words) if len(w) != len(labels)), None)
    if bad is not None:
        raise FormatError(
            f"point {bad} has another number of values", where=where, got=len(words[bad]), wanted=len(labels)
        )
    try:
        a = np.array(words, dtype=np.float64).reshape(-1, len(labels))
    except ValueError as error:
        raise FormatError(f"point holds no number ({error})", where=where) from None
    return {c: a[:, k] for k, c in enumerate(labels)}


def _records(body: bytes, n: int, dtype: np.dtype[Any], where: str) -> dict[str, npt.NDArray[Any]]:
    if n * dtype.itemsize > len(body):
        raise FormatError(
            "file is truncated", where=where, got=f"{len(body) // dtype.itemsize} points", wanted=f"{n} of the header"
        )
    a = np.frombuffer(body, dtype, count=n)
    assert dtype.names is not None
    return {c: a[c] for c in dtype.names if a[c].ndim == 1}


def _pcd_layout(head: bytes, where: str) -> _Layout:
    end = re.search(rb"\bDATA\s+(\w+)[ \t]*\r?\n", head[:_HEADER])
    if end is None:
        raise FormatError("PCD header has no end", where=where, wanted="DATA in the first 64 kB")
    header: dict[str, list[str]] = {}
    for line in head[: end.start()].decode("latin-1").splitlines():
        words = line.split("#")[0].split()
        if words:
            header[words[0].upper()] = words[1:]
    try:
        fields = header["FIELDS"] if "FIELDS" in header else header["COLUMNS"]
        sizes, kinds = [int(s) for s in header["SIZE"]], header["TYPE"]
        counts = [int(c) for c in header.get("COUNT", ["1"] * len(fields))]
        n = int(header["POINTS"][0]) if "POINTS" in header else int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
    except (KeyError, IndexError, ValueError) as error:
        raise FormatError(f"PCD header is damaged ({error})", where=where) from None
    codes = {"F": "f", "I": "i", "U": "u"}
    ok = len(fields) == len(sizes) == len(kinds) == len(counts) and n >= 0 and 0 < len(fields) <= 100
    if not ok or any(
        k not in codes or s not in (1, 2, 4, 8) or (k == "F" and s < 4) or not 0 <= c <= 1000
        for k, s, c in zip(kinds, sizes, counts)
    ):
        raise FormatError(
            "PCD header is damaged", where=where, got={k: header.get(k) for k in ("FIELDS", "SIZE", "TYPE", "COUNT")}
        )
    columns = [  # fields named "_" are padding: they may be repeated, and be of no size
        (f"{f}#{i}" if f == "_" else f, f"<{codes[k]}{s}", c)
        for i, (f, k, s, c) in enumerate(zip(fields, kinds, sizes, counts))
        if c
    ]
    if len({c[0] for c in columns}) != len(columns):
        raise FormatError("a field is repeated", where=where, got=fields)
    dtype = np.dtype([(f, d) if c == 1 else (f, d, (c,)) for f, d, c in columns])
    form = end[1].decode().lower()
    if form == "ascii":
        return _Layout(end.end(), n, [f if c == 1 else f"{f}#{j}" for f, _, c in columns for j in range(c)])
    if form not in ("binary", "binary_compressed"):
        raise FormatError("unknown form of PCD", where=where, got=form, wanted="ascii, binary or binary_compressed")
    return _Layout(end.end(), n, fields, dtype, packed=columns if form == "binary_compressed" else None)


def _pcd(raw: bytes, where: str) -> CloudData:
    layout = _pcd_layout(raw[:_HEADER], where)
    body, n = raw[layout.begin :], layout.count
    if layout.dtype is None:
        rows = [r for r in body.splitlines() if r.strip()][:n]
        return columns_cloud(_ascii(rows, n, layout.labels, where), where)
    if layout.packed is None:
        return columns_cloud(_records(body, n, layout.dtype, where), where)
    packed, plain = (int(v) for v in np.frombuffer(body[:8].ljust(8, b"\0"), "<u4"))
    check_size(plain, where)
    if plain != n * layout.dtype.itemsize or packed > len(body) - 8:
        raise FormatError("file is truncated", where=where, got=f"{len(body) - 8} bytes", wanted=f"{packed} packed")
    data = unpack_lzf(body[8 : 8 + packed], plain, where)
    out, at = {}, 0
    for f, d, c in layout.packed:  # stored by field, not by point
        size = np.dtype(d).itemsize * c * n
        if c == 1:
            out[f] = np.frombuffer(data, d, count=n, offset=at)
        at += size
    return columns_cloud(out, where)


def unpack_lzf(data: bytes, size: int, where: str) -> bytes:
    """Decompress LZF (format of liblzf in PCL) to ``size`` bytes."""
    out = bytearray()
    at, end = 0, len(data)
    try:
        while at < end:
            control = data[at]
            at += 1
            if control < 32:  # literal bytes
                if at + control + 1 > end:
                    raise IndexError
                out += data[at : at + control + 1]
                at += control + 1
            else:  # back reference
                length = control >> 5
                if length == 7:
                    length += data[at]
                    at += 1
                begin = len(out) - ((control & 31) << 8) - data[at] - 1
                at += 1
                length += 2
                if begin < 0:
                    raise IndexError
                if begin + length <= len(out):
                    out += out[begin : begin + length]
                else:
                    for k in range(length):
                        out.append(out[begin + k])
            if len(out) > size:
                raise IndexError
    except IndexError:
        raise FormatError("compressed points are damaged", where=where) from None
    if len(out) != size:
        raise FormatError("compressed points are truncated", where=where, got=f"{len(out)} bytes", wanted=size)
    return bytes(out)


def _las(raw: bytes, where: str) -> CloudData:
    laspy = import_extra("laspy", "a LAS file", where=where)
    n = _las_count(raw, len(raw), where)  # before laspy allocates
    try:
        if raw[104] & 0x80 and n:
            _check_chunks(raw, laspy.open(io.BytesIO(raw)).header, where)
        las = laspy.read(io.BytesIO(raw))
        xyz = np.column_stack([np.asarray(las.x), np.asarray(las.y), np.asarray(las.z)]).astype(np.float64)
        times = np.asarray(las.gps_time, np.float64) if "gps_time" in set(las.point_format.dimension_names) else None
    except (MemoryError, KeyboardInterrupt, FormatError):
        raise
    except BaseException as error:  # laspy and lazrs raise other types, also panics of Rust
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise FormatError(f"LAS is damaged ({type(error).__name__}: {error})", where=where) from None
    if times is not None and (not len(times) or np.ptp(times) == 0.0):
        times = None
    return clean_cloud(xyz, times, "" if times is None else "gps_time")


def _las_count(head: bytes, length: int, where: str) -> int:
    if len(head) < 227:
        raise FormatError("LAS header is truncated", where=where, got=f"{len(head)} bytes", wanted="227 or more")
    large = head[247:255] if head[25] >= 4 and len(head) >= 255 else b""
    n = max(int.from_bytes(head[107:111], "little"), int.from_bytes(large, "little"))
    size = int(np.frombuffer(head[105:107], "<u2")[0])
    if not head[104] & 0x80 and n * size > length:
        raise FormatError("file is truncated", where=where, got=f"{length} bytes", wanted=f"{n} points of {size}")
    extra = sum(int.from_bytes(head[k : k + 4], "little") for k in ((100, 243) if head[25] >= 4 else (100,)))
    if extra * 54 > length:  # laspy would try to read all of them, for hours
        raise FormatError("LAS header claims too many records", where=where, got=extra, wanted=f"in {length} bytes")
    check_size(n * 24, where)
    if head[104] & 0x80 and n > 40 * length:
        raise FormatError("LAZ header claims too many points", where=where, got=n, wanted=f"in {length} bytes")
    return n


def _check_chunks(raw: bytes, header: Any, where: str) -> None:
    """Check sizes in a LAZ file: the decoder aborts the process or prints on stderr (a panic) if they are wrong."""
    first = header.offset_to_point_data
    at = int.from_bytes(raw[first : first + 8], "little", signed=True)
    at = int.from_bytes(raw[-8:], "little") if at == -1 else at  # written as a stream: it is in the last 8 bytes
    if not first <= at <= len(raw) - 8 or int(np.frombuffer(raw[at + 4 : at + 8], "<u4")[0]) > len(raw):
        raise FormatError("LAZ is truncated: its table of chunks is not there", where=where, got=f"{len(raw)} bytes")
    lazrs = import_extra("lazrs", "a LAZ file", where=where)
    packing = lazrs.LazVlr(header.vlrs.get("LasZipVlr")[0].record_data)
    points = io.BytesIO(raw)
    points.seek(first)
    chunks = lazrs.read_chunk_table(points, packing)  # points and bytes of each
    if packing.item_size() != header.point_format.size or sum(size for _, size in chunks) > len(raw):
        raise FormatError("LAZ is damaged: the size of its points or chunks is impossible", where=where)
    check_size(max((n for n, _ in chunks), default=0) * packing.item_size(), where)  # the decoder allocates this
