"""Files for package indexes, containers and citations are correct and agree, and a release is made."""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from click.testing import CliRunner

ROOT = Path(__file__).resolve().parents[1]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
FORMS = sorted(p for p in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml") if p.name != "config.yml")
CITATION = yaml.safe_load((ROOT / "CITATION.cff").read_text())
# names of conda-forge that are others than those of PyPI
CONDA = {"matplotlib": "matplotlib-base"}


def hadolint(path: Path) -> subprocess.CompletedProcess[str]:
    tool = Path(sys.executable).parent / "hadolint"
    if not tool.is_file():
        pytest.skip("hadolint is not installed: pip install --editable '.[dev]'")
    return subprocess.run([str(tool), str(path)], capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("schema", "path"),
    [
        ("github-workflows", ROOT / ".github/workflows/ci.yml"),
        ("github-issue-config", ROOT / ".github/ISSUE_TEMPLATE/config.yml"),
        ("citation-file-format", ROOT / "CITATION.cff"),
        *(("github-issue-forms", p) for p in FORMS),
    ],
    ids=lambda x: x.name if isinstance(x, Path) else "",
)
def test_file_follows_its_schema(schema: str, path: Path, tmp_path: Path) -> None:
    checker = pytest.importorskip("check_jsonschema", reason="pip install --editable '.[dev]'")
    command = ["--builtin-schema", f"vendor.{schema}"]
    done = CliRunner().invoke(checker.main, [*command, str(path)])
    assert done.exit_code == 0, done.output
    wrong = tmp_path / "wrong.yml"
    wrong.write_text(re.sub(r"^(on|body|title|blank_issues_enabled):", "other:", path.read_text(), flags=re.M))
    assert CliRunner().invoke(checker.main, [*command, str(wrong)]).exit_code == 1


def test_containerfile_is_clean(tmp_path: Path) -> None:
    done = hadolint(ROOT / "Containerfile")
    assert done.returncode == 0, done.stdout
    wrong = tmp_path / "Containerfile"
    wrong.write_text((ROOT / "Containerfile").read_text().replace("python:3.12-slim", "python:latest"))
    assert hadolint(wrong).returncode == 1
    for line in re.findall(r"^COPY (?!--)(.+) \S+$", (ROOT / "Containerfile").read_text(), re.M):
        assert all((ROOT / name).exists() for name in line.split()), line


def test_workflow_calls_the_steps_of_ci() -> None:
    workflow = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())
    steps = [s.get("run", "") for s in workflow["jobs"]["ci"]["steps"]]
    assert "bash .ci/run" in steps
    assert (ROOT / ".ci" / "run").is_file()


@pytest.mark.parametrize("path", FORMS, ids=lambda p: p.stem)
def test_issue_form_asks_for_doctor_and_for_the_check_of_the_log(path: Path) -> None:
    labels = [f["attributes"]["label"] for f in yaml.safe_load(path.read_text())["body"]]
    assert any("graphslam doctor" in name for name in labels)
    assert any("graphslam data check" in name for name in labels)


def test_citation_names_the_project_as_its_metadata_do() -> None:
    urls = PROJECT["urls"]
    assert {"Homepage", "Documentation", "Source", "Issues", "Changelog"} <= set(urls)
    assert (CITATION["url"], CITATION["repository-code"]) == (urls["Homepage"], urls["Source"])
    assert [a["name"] for a in CITATION["authors"]] == [a["name"] for a in PROJECT["authors"]]
    bibtex = "\n".join(re.findall(r"^```bibtex\n(.*?)^```$", (ROOT / "docs/cite.md").read_text(), re.M | re.S))
    plain = bibtex.replace("{", "").replace("}", "")
    for paper in CITATION["references"]:
        assert paper["title"] in plain
        assert f"year = {paper['year']}" in re.sub(r" +", " ", plain)
    for author in PROJECT["authors"]:
        assert author["name"] in plain


def test_conda_recipe_needs_what_the_package_needs() -> None:
    recipe = yaml.safe_load((ROOT / ".ci" / "recipe.yaml").read_text())
    needs = {}
    for line in PROJECT["dependencies"]:
        name, bounds = re.fullmatch(r"([\w.-]+)(.*)", line).groups()  # type: ignore[union-attr]
        needs[CONDA.get(name, name)] = bounds
    needs["python"] = PROJECT["requires-python"]
    assert dict(line.split(" ", 1) for line in recipe["requirements"]["run"]) == needs
    scripts = [f"{name} = {target}" for name, target in PROJECT["scripts"].items()]
    assert recipe["build"]["python"]["entry_points"] == scripts


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("release", ROOT / ".ci" / "release.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def clone(tmp_path: Path, script: ModuleType) -> Path:
    """A repository with the files of this one that a release touches or packs."""
    root = tmp_path / "clone"
    names = subprocess.check_output(["git", "ls-files"], cwd=ROOT, text=True).split("\n")
    packed = "graphslam/", "frontends/", "datasets/", "notebooks/studies/", ".ci/"
    for name in names:
        if (ROOT / name).is_file() and (name.startswith(packed) or "/" not in name):
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, root / name)
    for name in script.PLACES:
        text = (root / name).read_text().replace("example.org", "example.com")
        (root / name).write_text(text)
    changes = root / "CHANGELOG.md"
    changes.write_text("# Changes\n\n## Not released\n\n* A map.\n\n## 0.1.0\n\nFirst.\n")
    (root / ".gitignore").write_text("dist/\n")
    for command in (
        ("init", "-q", "-b", "main"),
        ("config", "user.name", "A"),
        ("config", "user.email", "a@example.com"),
        ("add", "-A"),
        ("commit", "-q", "-m", "first"),
    ):
        subprocess.run(["git", *command], cwd=root, check=True)
    return root


def test_release_writes_builds_commits_and_tags(clone: Path, script: ModuleType) -> None:
    made = script.release(clone, "0.2.0")
    assert sorted(p.name for p in made) == [
        "graphslam_studies-0.2.0-py3-none-any.whl",
        "graphslam_studies-0.2.0.tar.gz",
        "graphslam_submaps-0.2.0-py3-none-any.whl",
        "graphslam_submaps-0.2.0.tar.gz",
    ]
    tag = script.sh("git", "tag", "--list", "--format=%(refname:short) %(contents)", cwd=clone)
    assert tag.split("\n")[0] == "v0.2.0 graphslam 0.2.0"
    assert "* A map." in tag
    assert script.sh("git", "status", "--porcelain", cwd=clone) == ""
    heads = re.findall(r"^## (.*)$", (clone / "CHANGELOG.md").read_text(), re.M)
    assert heads[0] == "Not released"
    assert re.fullmatch(r"0\.2\.0 \(\d{4}-\d\d-\d\d\)", heads[1])
    assert heads[2:] == ["0.1.0"]
    citation = yaml.safe_load((clone / "CITATION.cff").read_text())
    assert citation["version"] == "0.2.0"
    assert f"({citation['date-released']})" in heads[1]
    studies = tomllib.loads((clone / "notebooks/studies/pyproject.toml").read_text())["project"]
    assert studies["dependencies"] == ["graphslam-submaps>=0.2,<0.3"]
    with pytest.raises(SystemExit, match="nothing under 'Not released'"):
        script.release(clone, "0.3.0")


def test_release_refuses_and_leaves_the_files(clone: Path, script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    for version, why in (("0.2", "wanted MAJOR.MINOR.PATCH"), ("0.0.9", "is not after 0.1.0")):
        with pytest.raises(SystemExit, match=why):
            script.release(clone, version)
    (clone / "new.txt").write_text("x")
    with pytest.raises(SystemExit, match="not committed"):
        script.release(clone, "0.2.0")
    (clone / "new.txt").unlink()

    def fails(root: Path, version: str) -> None:
        assert version in (root / "CITATION.cff").read_text()
        raise SystemExit("a build that fails")

    monkeypatch.setattr(script, "build", fails)
    with pytest.raises(SystemExit, match="a build that fails"):
        script.release(clone, "0.2.0")
    assert script.sh("git", "status", "--porcelain", cwd=clone) == ""
    assert script.sh("git", "tag", cwd=clone) == ""


def test_release_refuses_placeholders_and_versions_agree(script: ModuleType) -> None:
    for name, before in script.PLACES.items():
        found = re.findall(f"{before}({script.VERSION})", (ROOT / name).read_text(), re.M)
        assert found == [PROJECT["version"]], name
    if any("example.org" in u for u in PROJECT["urls"].values()):
        original = script.sh
        script.sh = lambda *command, cwd: "main" if "branch" in command else ""
        try:
            with pytest.raises(SystemExit, match="placeholder"):
                script.check(ROOT, "9.0.0", "* A change.")
        finally:
            script.sh = original
