"""Damage to files, by what they hold: arrays, JSON, text, bytes. The same generator gives the same damage."""

from __future__ import annotations

import bz2
import gzip
import io
import json
import lzma
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Rng = np.random.Generator
ODD_NUMBERS = (np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324, 0.0, -0.0, -1.0, 2.0**63, 1e300)
ODD_WORDS = ("nan", "NaN", "inf", "-inf", "1e309", "1e308", "-1", "0", "99999999999999999999", "x", "1,5", "", "0x10",
             "1_000", "\x00", "é", "--", "1e", "9" * 400, "#", "[", "true")  # fmt: skip
ODD_VALUES: tuple[Any, ...] = (
    None, True, False, -1, 0, 2**31, 2**63, 10**30, 10**400, 1e308, float("nan"), float("inf"), "", "text",
    "../../etc/passwd",
    "/etc/passwd", "\ud800", [], {}, [[]], {"a": 1}, [None], "9" * 10_000, [0] * 1000,
)  # fmt: skip


def pick(rng: Rng, values: Any) -> Any:
    """One of the values."""
    return values[int(rng.integers(len(values)))]


# --- bytes ---


def damage_bytes(rng: Rng, data: bytes) -> bytes:
    """Flipped bits, cut, repeated, inserted or overwritten stretches."""
    raw = bytearray(data)
    kind = int(rng.integers(7))
    if not raw:
        return bytes(rng.integers(0, 256, 20, dtype=np.uint8))
    at = int(rng.integers(len(raw)))
    if kind == 0:
        for _ in range(int(rng.integers(1, 9))):
            raw[int(rng.integers(len(raw)))] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        del raw[at:]
    elif kind == 2:
        del raw[at : at + int(rng.integers(1, 64))]
    elif kind == 3:
        raw[at:at] = rng.integers(0, 256, int(rng.integers(1, 64)), dtype=np.uint8).tobytes()
    elif kind == 4:
        n = int(rng.integers(1, 9))
        raw[at : at + n] = pick(rng, (b"\xff", b"\x00", b"\x7f", b"\x80")) * n
    elif kind == 5:
        raw[at:at] = raw[at : at + int(rng.integers(1, 200))]
    else:
        raw[:] = raw[::-1] if rng.random() < 0.1 else raw + b"\x00" * int(rng.integers(1, 2000))
    return bytes(raw)


# --- text ---


def damage_text(rng: Rng, data: bytes) -> bytes:
    """Tokens and lines dropped, repeated, swapped or replaced; bytes that are no UTF-8; a very long line."""
    kind = int(rng.integers(10))
    if kind == 0:
        at = int(rng.integers(len(data) + 1))
        return data[:at] + pick(rng, (b"\xff\xfe", b"\xc3", b"\x00", b"\xe2\x80\xa8", b"\r", b"\x0b")) + data[at:]
    if kind == 1:
        return data + b"7 " * 50_000 + b"\n"
    lines = data.decode("utf-8", "replace").split("\n")
    k = int(rng.integers(len(lines)))
    separator = "," if "," in lines[k] else "\t" if "\t" in lines[k] else " "
    words = lines[k].split(separator)
    w = int(rng.integers(len(words)))
    if kind == 2:
        del lines[k]
    elif kind == 3:
        lines.insert(int(rng.integers(len(lines))), lines[k])
    elif kind == 4:
        j = int(rng.integers(len(lines)))
        lines[k], lines[j] = lines[j], lines[k]
    elif kind == 5:
        lines[k] = lines[k][: int(rng.integers(len(lines[k]) + 1))]
    else:
        if kind == 6:
            del words[w]
        elif kind == 7:
            words.insert(w, words[w])
        else:
            words[w] = pick(rng, ODD_WORDS) if rng.random() < 0.8 else f"1e{int(rng.integers(-330, 330))}"
        lines[k] = separator.join(words)
    return "\n".join(lines).encode("utf-8", "surrogatepass")


# --- JSON ---


def damage_json(rng: Rng, data: bytes) -> bytes:
    """A value of another type, a key that is missing, new or given twice, deep nesting."""
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):  # of a file that is damaged for the second time
        return damage_text(rng, data)
    places: list[tuple[Any, Any]] = []

    def walk(v: Any) -> None:
        inside = v.items() if isinstance(v, dict) else enumerate(v) if isinstance(v, list) else ()
        for k, x in inside:
            places.append((v, k))
            walk(x)

    walk(value)
    kind = int(rng.integers(8))
    if not places or kind == 0:
        return damage_text(rng, data)
    holder, key = pick(rng, places)
    if kind == 1:
        deep = pick(rng, (50, 500, 100_000))
        holder[key] = "@deep@"
        return json.dumps(value).replace('"@deep@"', "[" * deep + "]" * deep).encode()
    if kind == 2 and isinstance(holder, dict):
        again = json.dumps({key: holder[key]})[1:-1]
        text = json.dumps(value)
        return text.replace(again, f"{again}, {again}", 1).encode()
    if kind == 3:
        del holder[key]
    elif kind == 4 and isinstance(holder, list):
        holder.append(holder[key])
    elif kind == 5 and isinstance(holder[key], (int, float)):
        holder[key] = float(pick(rng, ODD_NUMBERS)) if rng.random() < 0.5 else holder[key] * pick(rng, (-1, 2, 1e12))
    elif kind == 6:
        other, k = pick(rng, places)
        holder[key], other[k] = json.loads(json.dumps(other[k])), json.loads(json.dumps(holder[key]))
    else:
        holder[key] = pick(rng, ODD_VALUES)
    return json.dumps(value).encode("utf-8", "surrogatepass")


def damage_lines(rng: Rng, data: bytes) -> bytes:
    """JSON, one object a line."""
    lines = data.split(b"\n")
    k = int(rng.integers(len(lines)))
    if not lines[k] or rng.random() < 0.2:
        return damage_text(rng, data)
    lines[k] = damage_json(rng, lines[k])
    return b"\n".join(lines)


# --- npz ---


def npy(array: np.ndarray) -> bytes:
    """An array in NumPy's format."""
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, allow_pickle=False)
    return stream.getvalue()


def damage_array(rng: Rng, a: np.ndarray) -> np.ndarray:
    """Another type, another shape, or numbers that mean nothing."""
    kind = int(rng.integers(8))
    if kind == 0:
        with np.errstate(all="ignore"):
            wanted = pick(rng, ("<f4", ">f8", "<i8", "<i4", "|u1", "|b1", "<U8", "<c16", "<f2", ">i8", "<u8"))
            return a.astype(wanted) if a.dtype.kind != "U" or wanted == "<U8" else np.zeros(a.shape, wanted)
    if kind == 1:
        return pick(rng, (a.reshape(-1), a[None], a.reshape(*a.shape, 1), a.T, a.reshape(-1)[:0]))
    if kind == 2 and a.ndim:
        axis = int(rng.integers(a.ndim))
        return np.take(a, range(int(rng.integers(a.shape[axis] + 1))), axis=axis)
    if kind == 3 and a.ndim:
        return np.concatenate([a, a[: int(rng.integers(1, 4))]])
    if kind == 4 and a.ndim and len(a) > 1:
        return a[rng.permutation(len(a))]
    out = np.array(a)
    if out.size == 0:
        return np.zeros(3)
    at = np.unravel_index(int(rng.integers(out.size)), out.shape)
    if out.dtype.kind == "f":
        out[at] = pick(rng, ODD_NUMBERS) if rng.random() < 0.7 else out[at] * pick(rng, (-1.0, 0.0, 1e6, 1e-6))
        if kind == 7:
            out[...] = out[at]
    elif out.dtype.kind in "iu":
        info = np.iinfo(out.dtype)
        out[at] = pick(rng, (info.min, info.max, 0, 7))
    elif out.dtype.kind == "b":
        out[at] = not out[at]
    else:
        out = np.asarray(pick(rng, ("", "x" * 1000, "../x", "{", '{"a": NaN}', "\x01")))
    return out


HEADERS = (
    "{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999, 512), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }",
    "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
    "{'descr': '<U99999999', 'fortran_order': False, 'shape': (1,), }",
    "{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1,), }",
    "{'descr': '<f8', 'fortran_order': 7, 'shape': (1,), }",
    "{'shape': (1,), }",
    "__import__('os').abort()",
    "(" * 200 + ")" * 200,
    "{'descr': '<f8', 'fortran_order': False, 'shape': (1,",
    "\\",
    "{'descr': '<M8[s]', 'fortran_order': False, 'shape': (1,), }",
)


def damage_npz(rng: Rng, data: bytes) -> bytes:
    """Members dropped, renamed, exchanged, repeated, of another type or shape, or with headers that lie."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {m.filename: archive.read(m) for m in archive.infolist()}
            arrays = {k: np.lib.format.read_array(io.BytesIO(v), allow_pickle=False) for k, v in members.items()}
    except Exception:
        return damage_bytes(rng, data)
    names = list(members)
    name = pick(rng, names)
    kind = int(rng.integers(11))
    twice = None
    if kind == 0:
        del members[name]
    elif kind == 1:
        members[pick(rng, ("other.npy", "../x.npy", "/x.npy", "x", "é.npy"))] = members.pop(name)
    elif kind == 2:
        other = pick(rng, names)
        members[name], members[other] = members[other], members[name]
    elif kind == 3:
        twice = name
    elif kind == 4:
        head = pick(rng, HEADERS).encode().ljust(117) + b"\n"
        members[name] = b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + members[name][128:]
    elif kind == 5:
        members[name] = damage_bytes(rng, members[name])
    else:
        members[name] = npy(np.asarray(damage_array(rng, arrays[name])))
    stream = io.BytesIO()
    packing = pick(rng, (zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA))
    with zipfile.ZipFile(stream, "w", packing) as archive:
        for k, v in members.items():
            archive.writestr(k, v)
        if twice is not None:
            import warnings

            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                archive.writestr(twice, members[twice])
    return stream.getvalue()


# --- files and folders ---

_PACKED: dict[str, tuple[Callable[[bytes], bytes], Callable[[bytes], bytes]]] = {
    ".gz": (gzip.decompress, lambda b: gzip.compress(b, mtime=0)),
    ".xz": (lzma.decompress, lzma.compress),
    ".bz2": (bz2.decompress, bz2.compress),
}
_BY_ENDING: dict[str, Callable[[Rng, bytes], bytes]] = {
    **dict.fromkeys((".npz",), damage_npz),
    **dict.fromkeys((".json",), damage_json),
    **dict.fromkeys((".jsonl",), damage_lines),
    **dict.fromkeys((".txt", ".dat", ".tum", ".csv", ".toml", ".g2o", ".graph", ".clf", ".yaml", ".log"), damage_text),
}


def damage_file(rng: Rng, path: Path) -> str:
    """Damage one file; says what was done."""
    data = path.read_bytes()
    packed = _PACKED.get(path.suffix)
    if packed is not None and rng.random() < 0.8:
        inner = _BY_ENDING.get(path.with_suffix("").suffix, damage_bytes)
        try:
            content = packed[0](data)
        except Exception:
            content = data
        path.write_bytes(packed[1](inner(rng, content)))
        return f"{path.name}: {inner.__name__} inside"
    damage = _BY_ENDING.get(path.suffix, damage_bytes) if rng.random() < 0.85 else damage_bytes
    path.write_bytes(damage(rng, data))
    return f"{path.name}: {damage.__name__}"


def damage(rng: Rng, root: Path) -> str:
    """Damage a file of a folder, once or twice; or make files missing, empty, links, folders or each other."""
    files = [root] if root.is_file() else sorted(p for p in root.rglob("*") if p.is_file())
    damages = []
    for _ in range(1 if rng.random() < 0.8 else 2):
        files = [f for f in files if f.is_file()]
        if not files:
            break
        path = pick(rng, files)
        kind = rng.random()
        if kind < 0.9:
            damages.append(damage_file(rng, path))
            continue
        if kind < 0.92:
            path.unlink()
        elif kind < 0.94:
            path.write_bytes(b"")
        elif kind < 0.96:
            path.unlink()
            path.mkdir()
        elif kind < 0.98:
            path.write_bytes(pick(rng, files).read_bytes())
        else:
            path.unlink()
            path.symlink_to(pick(rng, ("/etc/hostname", path.name, "nowhere")))
        damages.append(f"{path.name}: missing, empty, a folder, another file or a link ({kind:.3f})")
    return "; ".join(damages)
