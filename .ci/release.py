"""Make a release: ``python .ci/release.py VERSION``, on a clean main after ``bash .ci/run``.

It writes the version and the date into all files that have them, builds wheels and sdists of both distributions into
``dist/``, imports them, then commits and tags ``vVERSION`` with the changes of that version as its message. If a step
fails, the files are as before. Nothing is pushed or uploaded: the last lines printed are the commands for that.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tomllib
from datetime import date
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
STUDIES = "notebooks/studies"
NOT_RELEASED = "## Not released\n"
# Where the version stands: file, and what comes before it.
PLACES = {
    "pyproject.toml": '^version = "',
    f"{STUDIES}/pyproject.toml": '^version = "',
    "graphslam/__init__.py": '^__version__ = "',
    "CITATION.cff": "^version: ",
    ".ci/recipe.yaml": '^  version: "',
}
VERSION = r"\d+\.\d+\.\d+"


def sh(*command: str, cwd: Path) -> str:
    """Output of a command that has to succeed."""
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}\n{done.stdout}{done.stderr}")
    return done.stdout.strip()


def refuse_unless(ok: bool, why: str) -> None:
    """End with a sentence."""
    if not ok:
        raise SystemExit(f"no release: {why}")


def check(root: Path, version: str, changes: str) -> None:
    """Refuse what would be a wrong release."""
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    refuse_unless(bool(re.fullmatch(VERSION, version)), f"version {version!r}; wanted MAJOR.MINOR.PATCH")
    now = tuple(int(n) for n in project["version"].split("."))
    tagged = sh("git", "tag", "--list", cwd=root).split()
    new = tuple(int(n) for n in version.split("."))
    refuse_unless(f"v{version}" not in tagged, f"the tag v{version} exists")
    refuse_unless(new > now or (new == now and not tagged), f"{version} is not after {project['version']}")
    refuse_unless(not sh("git", "status", "--porcelain", cwd=root), "there are changes that are not committed")
    refuse_unless(sh("git", "branch", "--show-current", cwd=root) == "main", "the branch is not main")
    refuse_unless(bool(changes.strip()), "CHANGELOG.md has nothing under 'Not released'")
    places = [u for u in project["urls"].values() if "example.org" in u]
    refuse_unless(not places, f"[project.urls] has a placeholder: {', '.join(places)}; state where the project is")


def unreleased(root: Path) -> str:
    """The changes since the last release."""
    text = (root / "CHANGELOG.md").read_text(encoding="utf-8")
    refuse_unless(NOT_RELEASED in text, "CHANGELOG.md has no heading 'Not released'")
    return re.split(r"^## ", text.split(NOT_RELEASED, 1)[1], maxsplit=1, flags=re.M)[0]


def write_version(root: Path, version: str, today: str) -> list[str]:
    """Write version and date into the files; returns their names."""
    for name, before in PLACES.items():
        path = root / name
        text, found = re.subn(f"({before}){VERSION}", rf"\g<1>{version}", path.read_text(encoding="utf-8"), flags=re.M)
        refuse_unless(found == 1, f"{name} has {found} lines with the version")
        path.write_text(text, encoding="utf-8")
    major, minor, _ = version.split(".")
    needs = rf'"graphslam-submaps>={major}.{minor},<{major}.{int(minor) + 1}"'
    for name, old, new in (
        (f"{STUDIES}/pyproject.toml", r'"graphslam-submaps>=[\d.]+,<[\d.]+"', needs),
        ("CITATION.cff", r"^date-released: .*\n|^(?=url:)", f"date-released: {today}\n"),
        ("CHANGELOG.md", f"^{NOT_RELEASED}", f"{NOT_RELEASED}\n## {version} ({today})\n"),
    ):
        path = root / name
        text, found = re.subn(old, new, path.read_text(encoding="utf-8"), count=1, flags=re.M)
        refuse_unless(found == 1, f"{name} has no {old}")
        path.write_text(text, encoding="utf-8")
    return [*PLACES, "CHANGELOG.md"]


def build(root: Path, version: str) -> list[Path]:
    """Wheels and sdists of both distributions; the package of the wheel is imported and has that version."""
    out = root / "dist" / version
    for folder in (root, root / STUDIES):
        sh(sys.executable, "-m", "hatchling", "build", "-d", str(out), cwd=folder)
    made = sorted(out.iterdir())
    refuse_unless(len(made) == 4 and all(version in p.name for p in made), f"built {[p.name for p in made]}")
    (wheel,) = out.glob("graphslam_submaps-*.whl")
    test = f"import sys; sys.path.insert(0, {str(wheel)!r}); import graphslam; print(graphslam.__version__)"
    refuse_unless(sh(sys.executable, "-P", "-c", test, cwd=out) == version, "the wheel has another version")
    return made


def release(root: Path, version: str) -> list[Path]:
    """Check, write, build, commit, tag."""
    changes = unreleased(root)
    check(root, version, changes)
    try:
        files = write_version(root, version, date.today().isoformat())
        made = build(root, version)
    except BaseException:
        sh("git", "checkout", "--", ".", cwd=root)
        raise
    sh("git", "add", "--", *files, cwd=root)
    sh("git", "commit", "--message", f"Release {version}", cwd=root)
    message = f"graphslam {version}\n\n{changes.strip()}\n"
    sh("git", "tag", "--annotate", "--cleanup=verbatim", f"v{version}", "--message", message, cwd=root)
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("version", help="MAJOR.MINOR.PATCH")
    version = parser.parse_args().version
    made = release(ROOT, version)
    print("\n".join(str(p.relative_to(ROOT)) for p in made))
    print(f"git push origin main v{version}")
    print(f"python -m twine upload {' '.join(str(p.relative_to(ROOT)) for p in made)}")


if __name__ == "__main__":
    main()
