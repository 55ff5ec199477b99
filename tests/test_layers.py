"""Layers: a module imports only from its own package or from a lower layer."""

from __future__ import annotations

import ast
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LAYER = {
    "graphslam.core": 0,
    "graphslam.linear": 1,
    "graphslam.evidence": 1,
    "graphslam.registration": 1,
    "graphslam.graph": 2,
    "graphslam_frontends": 2,
    "graphslam.association": 3,
    "graphslam.calibrate": 3,
    "graphslam.solve": 4,
    "graphslam.skeleton": 4,
    "graphslam.join": 5,
    "graphslam.refine": 5,
    "graphslam.loops": 5,
    "graphslam.maps": 6,
    "graphslam.evaluate": 7,
    "graphslam.io": 6,
    "graphslam.sim": 6,
    "graphslam.plots": 8,
    "graphslam.backend": 8,
    "graphslam.app": 9,
}
# third-party packages and the only places that may import them
CONFINED = {
    "gtsam": ("graphslam/graph/", "graphslam/solve/", "graphslam/io/g2o"),
    "matplotlib": ("graphslam/plots/",),
    "typer": ("graphslam/app/",),
    "open3d": (),
    "skimage": (),
    "trimesh": (),
    "small_gicp": ("graphslam/registration/",),
}
FILES = sorted([*ROOT.glob("graphslam/**/*.py"), *ROOT.glob("frontends/**/*.py")])
BESIDE = sorted(ROOT.glob("notebooks/studies/graphslam_studies/**/*.py"))
"""The studies: a distribution of its own, which plugs in."""


def package_of(module: str) -> str | None:
    parts = module.split(".")
    if module == "graphslam.__main__":  # the command line
        return "graphslam.app"
    if parts[0] == "graphslam_frontends":
        return parts[0]
    return ".".join(parts[:2]) if parts[0] == "graphslam" and len(parts) > 1 else None


def module_of(path: Path) -> str:
    """Name under which a file is imported; the folders ``frontends`` and ``notebooks/studies`` are on the path."""
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    return name.removeprefix("frontends.").removeprefix("notebooks.studies.")


def imports(path: Path) -> list[str]:
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [a.name for a in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}: relative import"
            found += [f"{node.module}.{a.name}" for a in node.names]
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_module_imports_only_own_package_or_below(path: Path) -> None:
    module = module_of(path)
    own = package_of(module)
    if own is None:  # graphslam/__init__.py offers the verbs lazily and imports nothing of ours
        assert not [i for i in imports(path) if i.startswith("graphslam")]
        return
    for name in imports(path):
        assert not name.startswith(("tests", "graphslam_studies")), f"{module} imports {name}, which the wheel has not"
        target = package_of(name)
        if target in LAYER and target != own:
            assert LAYER[target] < LAYER[own], f"{module} (layer {LAYER[own]}) imports {name} (layer {LAYER[target]})"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_heavy_packages_stay_in_their_rooms(path: Path) -> None:
    rel = str(path.relative_to(ROOT))
    for name in imports(path):
        top = name.split(".")[0]
        if top in CONFINED:
            assert rel.startswith(CONFINED[top]), f"{rel} imports {name}"
        if top == "numba":
            assert rel == "graphslam/core/jit.py" or path.name.endswith("kernels.py"), f"{rel} imports numba"


def links(files: list[Path], *, annotations: bool = False) -> dict[str, set[str]]:
    """Module → modules that it imports, also inside functions.

    A block ``if TYPE_CHECKING`` counts only with ``annotations``.
    """
    modules = {module_of(p): p for p in files}
    out = {}
    for module, path in modules.items():
        tree = ast.parse(path.read_text())
        types = {
            id(n)
            for block in ast.walk(tree)
            if isinstance(block, ast.If) and isinstance(block.test, ast.Name) and block.test.id == "TYPE_CHECKING"
            if not annotations
            for statement in block.body
            for n in ast.walk(statement)
        }
        found = set()
        for node in (n for n in ast.walk(tree) if id(n) not in types):
            if isinstance(node, ast.Import):
                found |= {a.name for a in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                names = {f"{node.module}.{a.name}" for a in node.names}
                found |= {n if n in modules else node.module for n in names}
        out[module] = (found & set(modules)) - {module}
    return out


def test_no_files_import_each_other_in_a_circle() -> None:
    try:
        TopologicalSorter(links([*FILES, *BESIDE])).prepare()
    except CycleError as error:
        pytest.fail("import circle: " + " ← ".join(error.args[1]))


def test_a_circle_is_seen_also_inside_functions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    (tmp_path / "a.py").write_text("import b\n")
    (tmp_path / "b.py").write_text("def f():\n    from a import x\n")
    (tmp_path / "c.py").write_text("if TYPE_CHECKING:\n    import d\n")
    (tmp_path / "d.py").write_text("import c\n")
    found = links([tmp_path / f"{n}.py" for n in "abcd"])
    assert found == {"a": {"b"}, "b": {"a"}, "c": set(), "d": {"c"}}


NUMERICS = {"linalg", "einsum", "lstsq", "fft"}


def numerics(tree: ast.AST) -> list[str]:
    """What a file computes itself: linear algebra, distributions, products of matrices."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            names = [a.name for a in node.names]
            module = getattr(node, "module", None) or names[0]
            found += [module] if module.split(".")[0] in ("scipy", "numba", "gtsam") else []
            found += [n for n in names if n.startswith("chi2_")]
        elif isinstance(node, ast.Attribute) and node.attr in NUMERICS:
            found.append(node.attr)
        elif isinstance(node, (ast.BinOp, ast.AugAssign)) and isinstance(node.op, ast.MatMult):
            found.append("@")
    return found


@pytest.mark.parametrize("path", [p for p in FILES if (ROOT / "graphslam" / "app") in p.parents], ids=lambda p: p.stem)
def test_app_leaves_the_numbers_to_others(path: Path) -> None:
    assert numerics(ast.parse(path.read_text())) == []


def test_numbers_are_noticed() -> None:
    lines = (
        "np.linalg.norm(x)",
        "R @ P",
        "from scipy import stats",
        "from a.b import chi2_quantile",
        "np.einsum('i', x)",
    )
    assert all(len(numerics(ast.parse(line))) == 1 for line in lines)
    assert numerics(ast.parse("a = np.mean(x) ** 2")) == []


def test_every_package_has_a_layer() -> None:
    packages = {package_of(module_of(p)) for p in FILES} - {None}
    assert packages <= set(LAYER)


def test_importing_graphslam_imports_nothing_heavy() -> None:
    heavy = ("gtsam", "open3d", "matplotlib", "numba", "scipy")
    verbs = "graphslam.load, graphslam.simulate, graphslam.study"  # a simulation does not wait for what draws maps
    code = f"import sys, graphslam; {verbs}; print([m for m in {heavy} if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


MOST_ARGUMENTS = 8
MORE_ARGUMENTS = {
    "evidence/cast_kernels.py": {"cast_rays"},
    "evidence/mark_kernels.py": {"mark_grids"},
    "evidence/query_kernels.py": {"look_up_values"},
    "evidence/update_kernels.py": {"resolve_writes", "apply_grids", "finalise_writes"},
}
"""Kernels called for every scan, which named tuples would make slower; no others have more arguments."""


def test_kernels_group_their_arrays() -> None:
    """No compiled function has more than eight arguments; arrays that belong together are one named tuple."""
    found: dict[str, set[str]] = {}
    for path in [*FILES, *BESIDE]:
        if not path.name.endswith("kernels.py"):
            continue
        for n in ast.walk(ast.parse(path.read_text())):
            if isinstance(n, ast.FunctionDef):
                a = n.args
                if len([*a.posonlyargs, *a.args, *a.kwonlyargs]) > MOST_ARGUMENTS:
                    found.setdefault("/".join(path.parts[-2:]), set()).add(n.name)
    assert found == MORE_ARGUMENTS


@pytest.mark.parametrize("path", BESIDE, ids=lambda p: str(p.relative_to(ROOT)))
def test_studies_import_no_private_name(path: Path) -> None:
    ours = [i for i in imports(path) if i.startswith(("graphslam.", "graphslam_frontends."))]
    assert not [i for i in ours if any(part.startswith("_") for part in i.split("."))]


def test_every_benchmark_has_a_quick_mode() -> None:
    """``make bench`` runs each of them with ``--quick``."""
    benchmarks = sorted((ROOT / "tests" / "benchmarks").glob("bench_*.py"))
    assert benchmarks
    assert not [b.name for b in benchmarks if '"--quick"' not in b.read_text()]
