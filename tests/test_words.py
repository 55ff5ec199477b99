"""Plain words: private idioms in what users and developers read (texts, docstrings, comments, pages) only get fewer.

``PATTERNS`` are idioms that a reader has to read twice, each with what to write instead. ``words_ratchet.toml`` holds
how often they occur in each file; a file may have neither more nor fewer than that. After a text was made plainer, or a
file was moved, write the new counts (refused where the sum of all counts would rise)::

    python tests/test_words.py --write

``python tests/test_words.py FILE ...`` prints every occurrence in these files (without FILE: in all).
"""

from __future__ import annotations

import ast
import functools
import io
import json
import re
import sys
import tokenize
import tomllib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RATCHET = ROOT / "tests" / "words_ratchet.toml"
# idiom → plain words
PATTERNS = {
    r"\bhonest(y|ly)?\b": "consistent",
    r"\bboast\w*": "overconfident",
    r"\bclaims? too much\b|\btoo sure\b|\bsurer of (itself|themselves)\b": "overconfident",
    r"\btoo careful\b": "conservative",
    r"\blasting\b|\berrors? (that )?lasts?\b": "systematic, time-correlated",
    r"\bforet(ell|ells|old|elling)\b": "predict",
    r"\bsightings?\b": "observation, detection",
    r"\bfeign\w*": "is spurious, causes spurious",
    r"\bden(y|ies|ied|ying)\b(?!-)": "contradict, reject",
    r"\b(hangs?|hung) (on|from)\b": "is attached to, depends on",
    r"\b(is|are|was|were|be|been|being) told\b|\btold (apart|of|by|from|the)\b|\bnobody was told\b": "given, estimated",
    r"\btells? (of|from|which|what|whether|apart)\b": "shows, identifies",
    r"\bspen(t|d|ds|ding)\b": "use (of a measurement), take (of time)",
    r"\bgone on with\b|\b(to )?go on with\b": "resume, continue",
    r"\bas (it|they) came\b": "unchanged",
    r"\bthe word (on|of|for)\b|\bno word (for|of|on)\b|\bword points\b|\binto any word\b": "verdict",
    r"\bput together wrongly\b": "false data association",
    r"\bstands? (twice|in the ledger|for|beside|in others|alone|below|above)\b": "is",
    r"\bstated noise\b|\bnoise (that )?(is|was|are) stated\b": "noise model, assumed noise",
    r"\b(state|states) (more|less|too little|too much) noise\b": "increase the sigma",
    r"\bwhat (is|was|are|were|has been|can|cannot) (be )?(told|said|taken|seen|known|made|left|asked)\b": "a noun",
    r"\b[Ww]hat (it|they|nobody|no \w+) (says?|said|holds?|tells?|told|buys?|costs?)\b": "a noun",
    r"\b(which|that) is said\b|\band said\b|\bis said (where|so|of|to|in)\b": "is reported",
    r"\bmanieth\b|\bso (many|much) (that|topologies|of)\b": "every n-th, a number",
    r"\bspeaks? against\b|\bspeaks? for\b": "contradicts, supports",
    r"\bby (another|an other|two) ways?\b": "along another path, independently",
    r"\bhand(s|ed) (over|on|out)\b": "output, returned",
    r"\b(is|are|was|were|be) taken (for|from|by|as|in|out|to|if|where|whole|apart)\b": "used, assumed, removed",
    r"\bfor granted\b": "assumed",
    r"\bheld against\b|\bholds? .{0,20}\bagainst\b": "compared with",
    r"\bgives? (the|a) lie\b|\bthe lie\b": "reveals",
    r"\blet go of\b": "freed",
    r"\bstoreys?\b": "layer",
    r"\b(a|the|this|that|own|each|of) rooms?\b(?! (is|has|with|of) \d)": "module, package",
    r"\bverbs?\b": "command, function",
    r"\bjoiners?\b": "map-joining method",
    r"\bcards?\b": "data set description",
    r"\bdrawn (worlds?|garages?|robots?|campus\w*|streets?|buildings?|at random|anew)\b|\bdraws? (worlds?|a world)\b": (
        "random, sampled"
    ),
    r"\b(soft )?ties (between|of|to|and|two|the|them|a)\b|\ba tie\b|\bthe ties?\b": "loop closure, constraint",
    r"\b(all|all the|stored|these|its) figures\b|\bfigures (say|have|stand|that|are|were)\b": "metrics, values",
    r"\b(by|with|on|of|from) itself alone\b|\bfrom its log alone\b": "without other data",
    r"\b(no|not any) truth\b|\bthe truth\b|\btruth (is|was) (known|given)\b": "ground truth",
    r"\bin silence\b": "without a message",
    r"\bmend(s|ed|ing)?\b": "correct, repair",
    r"\bwitness(es)?\b": "test, check",
    r"\b(nothing|nobody) (else )?(speaks|says|holds|tells|has driven|in it|measures|could have)\b": "a named subject",
    r"\bby its own (judg\w+|word|account)\b": "by its own test",
    r"\ba word (on|for|about)\b": "a statement",
    r"\b(the )?ways? (is|are|of a|between two|that was driven|driven)\b(?! (more|to))": "path, trajectory",
    r"\bsecond (pass|passes)\b|\bpasses? (of|deny|that|over|between)\b": "traversal",
    r"\bone (hears|asks|says|tells)\b|\ba reader asks\b": "a named subject",
    r"\blook(s|ed)? (why|where|whether)\b": "check",
    r"\b(is|are|be|was) (lost|gone|kept|put) back\b|\bkept back\b": "withheld",
}
# idiom in names of code (parts between underscores and capitals) → what to call it
NAMES = {
    "sighting": "observation, detection",
    "sightings": "observations, detections",
    "lasting": "biases, correlated",
    "unheld": "unobservable",
    "honest": "consistent",
    "honesty": "consistency",
    "dishonest": "inconsistent",
    "witness": "check",
    "feigned": "spurious, noise_induced",
    "pretended": "spurious, noise_induced",
    "denied": "contradicted",
    "foretell": "predict",
    "foretold": "predicted",
}
PACKAGE_NAMES = NAMES | {
    **dict.fromkeys(("said", "say", "says"), "text, message, findings"),
    "told": "known, given, estimated",
    "taken": "used, chosen, accepted",
    "gone": "removed, travelled",
    **dict.fromkeys(("settle", "settled", "settling"), "converge, choose, resolve"),
    **dict.fromkeys(("sure", "surely", "surer"), "significant, reliable, sigma"),
    **dict.fromkeys(("tie", "tied", "ties"), "link, loop, constraint, attached"),
    **dict.fromkeys(("way", "ways"), "path, route, length, variant"),
}
"""Outside the tests."""
_PARTS = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")
_COMPILED = {re.compile(p, re.IGNORECASE): plain for p, plain in PATTERNS.items()}
_CODE = re.compile(r"``[^`]*``|`[^`\n]*`|\]\([^)\n]*\)|^ *(>>>|\.\.\.) .*$|\b\w+\.[\w{][^\s,;)]*", re.M)
"""Code, links, names with a dot (options, files): no words."""
_COMMAND = "python tests/test_words.py --write"


def _texts_of_code(path: Path, *, docstrings: bool) -> Iterator[tuple[int, str]]:
    """String literals with a space in them, each with its line; with ``docstrings`` also these, and comments."""
    source = path.read_text(encoding="utf-8")
    tree = ast.parse(source)
    skipped = {id(part) for n in ast.walk(tree) if isinstance(n, ast.JoinedStr) for part in n.values}
    if not docstrings:
        skipped |= {id(n.value) for n in ast.walk(tree) if isinstance(n, ast.Expr)}
    for n in ast.walk(tree):
        text = ""
        if isinstance(n, ast.JoinedStr):
            text = "".join(str(v.value) if isinstance(v, ast.Constant) else "{}" for v in n.values)
        elif isinstance(n, ast.Constant) and isinstance(n.value, str) and id(n) not in skipped:
            text = n.value
        if " " in text:
            yield n.lineno, text
    if docstrings:
        for token in tokenize.generate_tokens(io.StringIO(source).readline):
            if token.type == tokenize.COMMENT:
                yield token.start[0], token.string


def _texts_of_page(path: Path) -> Iterator[tuple[int, str]]:
    """Paragraph lines of Markdown without code."""
    text = path.read_text(encoding="utf-8")
    text = re.sub(r"^(```|~~~).*?^\1", lambda m: "\n" * m[0].count("\n"), text, flags=re.M | re.S)
    yield 1, text


def _texts_of_notebook(path: Path) -> Iterator[tuple[int, str]]:
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "markdown":
            yield 1, "".join(cell["source"])


def _texts() -> Iterator[tuple[Path, int, str]]:
    """All that users and developers read: file, line, text."""
    for folder in ("graphslam", "frontends", "notebooks"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            found = _texts_of_code(path, docstrings=folder != "notebooks" or path.parent.name == "cli")
            yield from ((path, line, text) for line, text in found)
    for path in [ROOT / f"{n}.md" for n in ("README", "CHANGELOG", "CONTRIBUTING")] + sorted(ROOT.glob("docs/**/*.md")):
        yield from ((path, line, text) for line, text in _texts_of_page(path))
    for path in sorted(ROOT.glob("notebooks/*.ipynb")):
        yield from ((path, line, text) for line, text in _texts_of_notebook(path))


def occurrences() -> dict[str, list[str]]:
    """File → its idioms, each as ``line: …text around it… (what to write)``."""
    out: dict[str, list[str]] = {}
    for path, line, words in _texts():
        text = _CODE.sub("", words)
        for pattern, plain in _COMPILED.items():
            for m in pattern.finditer(text):
                near = text[max(0, m.start() - 40) : m.end() + 40].replace("\n", " ")
                at = line + (text.count("\n", 0, m.start()) if path.suffix == ".md" else 0)
                out.setdefault(path.relative_to(ROOT).as_posix(), []).append(f"{at}: “{m[0]}” in …{near}… → {plain}")
    return out


def idioms_in_names(source: str, idioms: dict[str, str]) -> list[str]:
    """Names of variables, parameters, attributes, functions, classes with a part in ``idioms``, and lines."""
    rows: set[tuple[int, str]] = set()
    for n in ast.walk(ast.parse(source)):
        for field in ("id", "attr", "arg", "name", "asname"):
            name = getattr(n, field, None)
            if isinstance(name, str):
                rows.add((getattr(n, "lineno", 0), name))
    parts = {name: [part.lower() for part in _PARTS.findall(name)] for _, name in rows}
    return [f"{k}: {name} → {idioms[p]}" for k, name in sorted(rows) for p in parts[name] if p in idioms]


@functools.cache
def _found() -> dict[str, list[str]]:
    return occurrences()


def recorded() -> dict[str, int]:
    return dict(tomllib.loads(RATCHET.read_text(encoding="utf-8")).get("counts", {})) if RATCHET.is_file() else {}


def test_no_file_has_more_idioms_than_recorded() -> None:
    found, allowed = _found(), recorded()
    more = [f"{name}: {len(f)} > {allowed.get(name, 0)}\n  " + "\n  ".join(f) for name, f in found.items()
            if len(f) > allowed.get(name, 0)]  # fmt: skip
    assert not more, "private idioms; write plainer words:\n" + "\n".join(more)


def test_counts_are_those_recorded() -> None:
    found = {name: len(f) for name, f in _found().items()}
    fewer = [f"{name}: {found.get(name, 0)} < {n}" for name, n in recorded().items() if found.get(name, 0) < n]
    assert not fewer, f"plainer than recorded; record it with `{_COMMAND}`:\n" + "\n".join(fewer)


def test_names_are_plain() -> None:
    found: dict[str, list[str]] = {}
    for folder in ("graphslam", "frontends", "notebooks", "tests"):
        idioms = NAMES if folder == "tests" else PACKAGE_NAMES
        for path in sorted((ROOT / folder).rglob("*.py")):
            source = path.read_text(encoding="utf-8")
            if path != Path(__file__) and any(idiom in source.lower() for idiom in idioms):
                rows = idioms_in_names(source, idioms)
                found |= {str(path.relative_to(ROOT)): rows} if rows else {}
    assert not found, "private idioms in names:\n" + "\n".join(f"{name}: {rows}" for name, rows in found.items())


def test_an_idiom_in_a_name_is_found() -> None:
    source = "def f(honest_x):\n    return honest_x.sightings\nclass LastingError: ...\nblasting = 'honest'\n"
    names = [row.split()[1] for row in idioms_in_names(source, NAMES)]
    assert names == ["honest_x", "honest_x", "sightings", "LastingError"]
    assert [row.split()[1] for row in idioms_in_names("said = away.way\n", PACKAGE_NAMES)] == ["said", "way"]


def test_worst_pages_are_plain() -> None:
    """Pages that had the most idioms when they were first counted, wherever they are now."""
    worst = tomllib.loads(RATCHET.read_text(encoding="utf-8"))["worst_at_the_start"]
    assert len(worst) == 12
    left = {name: found for name, found in _found().items() if Path(name).name in worst}
    assert not left


def test_an_idiom_is_found(tmp_path: Path) -> None:
    page, code = tmp_path / "a.md", tmp_path / "b.py"
    page.write_text("An honest map, `honest` in code.\n```python\nhonest = 1\n```\n", encoding="utf-8")
    code.write_text('def f(x):\n    """Honest."""\n    raise ValueError(f"{x} is honest")\n', encoding="utf-8")
    honest = next(p for p in _COMPILED if "honest" in p.pattern)
    assert [len(honest.findall(_CODE.sub("", t))) for _, t in _texts_of_page(page)] == [1]
    assert [t for _, t in _texts_of_code(code, docstrings=False)] == ["{} is honest"]
    code.write_text('x = 1  # honest\n"""Honest words."""\n', encoding="utf-8")
    assert [t for _, t in _texts_of_code(code, docstrings=True)] == ["Honest words.", "# honest"]


if __name__ == "__main__":
    all_found = occurrences()
    if "--write" in sys.argv:
        old = recorded()
        now = {name: len(f) for name, f in sorted(all_found.items())}
        if old and sum(now.values()) > sum(old.values()):
            sys.exit(f"the counts rise from {sum(old.values())} to {sum(now.values())}: write plainer texts first")
        head = RATCHET.read_text(encoding="utf-8").partition("[counts]")[0]
        rows = "".join(f'"{name}" = {n}\n' for name, n in now.items())
        RATCHET.write_text(f"{head}[counts]\n{rows}", encoding="utf-8")
        print(f"{sum(now.values())} idioms in {len(now)} files")
    else:
        wanted = [Path(a).resolve().relative_to(ROOT).as_posix() for a in sys.argv[1:]]
        for name, found in sorted(all_found.items(), key=lambda r: len(r[1])):
            if not wanted or name in wanted:
                print(f"{name}: {len(found)}", *found, sep="\n  ")
