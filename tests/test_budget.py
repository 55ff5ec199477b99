"""Size and shape of the package, held from above: ``pytest tests/test_budget.py -s`` prints every figure.

The limits stand in ``budget.toml``. A change may lower them, never raise them.
"""

from __future__ import annotations

import ast
import dataclasses
import tomllib
import typing
from collections import Counter, defaultdict
from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from tests.test_layers import FILES, LAYER, ROOT, links, module_of, package_of

LIMITS = tomllib.loads((Path(__file__).parent / "budget.toml").read_text())
LONGEST_FUNCTION = 80
"""Lines, docstring not counted."""
MOST_PARAMETERS = 8
LONGEST_MODULE = 500
TREES = {path: ast.parse(path.read_text()) for path in FILES}


def place(path: Path) -> str:
    return str(path.relative_to(ROOT))


def is_kernel(path: Path) -> bool:
    return path.name.endswith("kernels.py")


def functions(tree: ast.AST) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    return (n for n in ast.walk(tree) if isinstance(n, (ast.FunctionDef, ast.AsyncFunctionDef)))


def length(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function without its decorators and its docstring."""
    first = function.body[0]
    lines = (function.end_lineno or 0) - function.lineno + 1
    if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str):
        lines -= (first.end_lineno or 0) - first.lineno + 1
    return lines


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    a = function.args
    names = [x.arg for x in (*a.posonlyargs, *a.args, *a.kwonlyargs)]
    return len(names) - (bool(names) and names[0] in ("self", "cls"))


def long_functions(*, kernels: bool = False) -> list[str]:
    """Functions over 80 lines outside kernels, or in kernels."""
    return [
        f"{place(path)}:{f.name} ({length(f)})"
        for path, tree in TREES.items()
        if is_kernel(path) == kernels
        for f in functions(tree)
        if length(f) > LONGEST_FUNCTION
    ]


def long_kernels() -> list[str]:
    return long_functions(kernels=True)


def wide_functions(*, kernels: bool = False) -> list[str]:
    """Functions of more than eight parameters outside kernels and the command line, or in kernels."""
    return [
        f"{place(path)}:{f.name} ({parameters(f)})"
        for path, tree in TREES.items()
        if is_kernel(path) == kernels and "app/cli/" not in place(path)
        for f in functions(tree)
        if parameters(f) > MOST_PARAMETERS
    ]


def wide_kernels() -> list[str]:
    return wide_functions(kernels=True)


def long_modules() -> list[str]:
    counts = {place(path): path.read_text().count("\n") for path in FILES}
    return [f"{p} ({n})" for p, n in counts.items() if n > LONGEST_MODULE]


def shared_names() -> dict[str, list[str]]:
    """Public functions and classes of modules that stand in two or more modules: name → where."""
    homes = defaultdict(list)
    for path, tree in TREES.items():
        for n in tree.body:
            if isinstance(n, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)) and not n.name.startswith("_"):
                homes[n.name].append(place(path))
    return {name: files for name, files in sorted(homes.items()) if len(set(files)) > 1}


def option_fields() -> int:
    """Fields of the dataclasses that make up the options of a run and of every front end of the wheel."""
    from graphslam.app.run.config import RunConfig

    found: dict[type, int] = {}

    def parts(hint: object) -> list[object]:
        inner = typing.get_args(hint)
        return [p for i in inner for p in parts(i)] if inner else [hint]

    def add(kind: object) -> None:
        if isinstance(kind, type) and dataclasses.is_dataclass(kind) and kind not in found:
            found[kind] = len(dataclasses.fields(kind))
            for hint in typing.get_type_hints(kind).values():
                for part in parts(hint):
                    add(part)

    add(RunConfig)
    for entry in entry_points(group="graphslam.frontends"):
        if entry.value.startswith("graphslam_frontends."):
            add(typing.get_type_hints(entry.load())["config"])
    return sum(found.values())


def circles() -> list[list[str]]:
    """Groups of files that import each other in a circle, imports for annotations alone included."""
    edges = links(FILES, annotations=True)
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found = []

    def visit(v: str) -> None:  # Tarjan
        index[v] = low[v] = len(index)
        stack.append(v)
        for w in sorted(edges[v]):
            if w not in index:
                visit(w)
                low[v] = min(low[v], low[w])
            elif w in stack:
                low[v] = min(low[v], index[w])
        if low[v] == index[v]:
            group = stack[stack.index(v) :]
            del stack[stack.index(v) :]
            if len(group) > 1:
                found.append(sorted(group))

    for v in sorted(edges):
        if v not in index:
            visit(v)
    return found


def room_lines() -> Counter[str]:
    """Lines of Python of every layer, docstrings and comments included."""
    counts: Counter[str] = Counter()
    for path in FILES:
        counts[package_of(module_of(path)) or "graphslam"] += path.read_text().count("\n")
    return counts


def held(what: str, value: int) -> None:
    """A figure is at most its limit, and the limit is not left far above it."""
    limit = LIMITS["counts"][what]
    assert value <= limit, f"{what}: {value}, limit {limit} (tests/budget.toml)"
    assert limit <= value * 1.03 + 3, f"{what}: {value}; lower the limit {limit} in tests/budget.toml"


def test_lines_of_the_wheel() -> None:
    counts = room_lines()
    print()
    for room, n in sorted(counts.items()):
        print(f"{n:7,} lines in {room}, limit {LIMITS['lines'][room]:,}")
    print(f"{counts.total():7,} lines in all, limit {LIMITS['counts']['lines']:,}")
    held("lines", counts.total())
    assert {r: n for r, n in counts.items() if n > LIMITS["lines"][r]} == {}


def test_a_part_above_its_goal_says_why() -> None:
    counts = {room.removeprefix("graphslam."): n for room, n in room_lines().items()}
    goals = LIMITS["goals"]
    listed = [part for g in goals for part in g["parts"]]
    assert sorted(listed) == sorted(counts.keys() - {"graphslam"})
    print()
    for g in goals:
        n = sum(counts[part] for part in g["parts"])
        print(f"{n:7,} lines in {', '.join(g['parts'])}, goal {g['lines']:,}: {g.get('above', 'reached')}")
        assert (n > g["lines"]) == ("above" in g), g


@pytest.mark.parametrize("what", ["long_functions", "long_kernels", "wide_functions", "wide_kernels", "long_modules"])
def test_functions_and_modules_are_short(what: str) -> None:
    found = globals()[what]()
    print(f"\n{len(found)} {what.replace('_', ' ')}:", *found, sep="\n  ")
    held(what, len(found))


def test_options_of_a_run() -> None:
    n = option_fields()
    print(f"\n{n} option fields")
    held("option_fields", n)


def test_a_public_name_has_one_meaning() -> None:
    found = shared_names()
    print(f"\n{len(found)} public names that stand in two or more modules:")
    print(*(f"  {name}: {', '.join(files)}" for name, files in found.items()), sep="\n")
    held("shared_names", len(found))


def test_no_new_import_circles() -> None:
    found = circles()
    print(f"\n{len(found)} import circles:", *(", ".join(g) for g in found), sep="\n  ")
    held("circles", len(found))


def test_docstrings_of_layers_give_their_number() -> None:
    """``Layer 4: ...`` in the docstring of a package is the number in the table of ``test_layers.py``."""
    wrong = {}
    for package, number in LAYER.items():
        folder = (
            ROOT / "frontends" / package if package == "graphslam_frontends" else ROOT.joinpath(*package.split("."))
        )
        first = (ast.get_docstring(ast.parse((folder / "__init__.py").read_text())) or "").split(":")[0]
        if first != f"Layer {number}":
            wrong[package] = (first, f"Layer {number}")
    assert wrong == {}
