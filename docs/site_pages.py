"""Pages of the site that are made of other files: notebooks, public names, the command line, changes.

MkDocs calls these functions (`hooks` in mkdocs.yml). Nothing here is imported by the package.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import posixpath
import re
from pathlib import Path
from typing import Any

import click
import typer
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"\[([^\[\]]*)\]\((?!https?://|#|mailto:)([^)\s#]+)(#[^)]*)?\)")


def on_config(config: Any) -> Any:
    """The tutorials in the table of contents are those that there are."""
    pages = [f"tutorials/{p.stem}.md" for p in sorted((ROOT / "notebooks").glob("*.ipynb"))]
    config.nav = [{"Tutorials": pages} if "Tutorials" in part else part for part in config.nav]
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are made."""
    made = {
        "changelog.md": (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"),
        "contributing.md": (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"),
        "reference/command-line.md": command_line(),
        **reference(),
        **{f"tutorials/{p.stem}.md": tutorial(p) for p in sorted((ROOT / "notebooks").glob("*.ipynb"))},
    }
    for path, text in made.items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Links into the repository become links into the site, or the bare name of a file that the site has not."""
    uri = page.file.src_uri
    # where the page stands in the repository: made ones come from the root, or from notebooks/
    home = {"changelog.md": "", "contributing.md": ""}.get(uri, f"docs/{posixpath.dirname(uri)}")
    home = "notebooks" if uri.startswith("tutorials/") else home

    def there(found: re.Match[str]) -> str:
        text, path, part = found[1], found[2], found[3] or ""
        target = posixpath.normpath(posixpath.join(home, path))
        if target.startswith("notebooks/") and target.endswith(".ipynb"):
            site = f"tutorials/{Path(target).stem}.md"
        elif target.startswith("docs/"):
            site = target.removeprefix("docs/")
        elif target == "CONTRIBUTING.md":
            site = "contributing.md"
        else:
            return text  # a file of the repository, which the site has not
        return f"[{text}]({posixpath.relpath(site, posixpath.dirname(uri) or '.')}{part})"

    return LINK.sub(there, markdown)


def tutorial(path: Path) -> str:
    """A notebook as a page: its text and its code; pictures come when it is run."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    parts = []
    for cell in cells:
        text = "".join(cell["source"]).strip()
        if text:
            parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
    note = f"!!! note\n    Run it yourself, with its pictures: `jupyter lab notebooks/{path.name}`."
    return "\n\n".join([parts[0], note, *parts[1:]]) + "\n"


def reference() -> dict[str, str]:
    """Pages of the public names, each entry made of its docstring."""
    spec = importlib.util.spec_from_file_location("graphslam_names", ROOT / "graphslam" / "__init__.py")
    assert spec is not None
    assert spec.loader is not None
    gs = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(gs)
    functions = """# Functions

The functions of `import graphslam as gs`. Angles are in radians, lengths in metres, times in seconds, unless a name
says otherwise. Errors are a `GraphSlamError` or a [subclass](errors.md).
"""
    types = "# Types\n\nArguments and results of the functions.\n"
    return {
        "reference/verbs.md": functions + entries({**gs._VERBS, **gs._LISTS}, members=False),
        "reference/types.md": types + entries(gs._TYPES, members=True),
        "reference/front-ends.md": "# Front ends\n\nUse the name in `gs.run(..., frontend=)`. The options are "
        "the fields of its configuration.\n" + entries(FRONT_ENDS, members=True),
        "reference/parts.md": parts(),
        "reference/errors.md": "# Errors\n\n::: graphslam.core.errors\n    options:\n      show_root_heading: false\n",
    }


FRONT_ENDS = {
    "FrontEnd": "graphslam_frontends.base",
    "RbpfEkf": "graphslam_frontends.landmarks.rbpf_ekf",
    "RbpfEkfConfig": "graphslam_frontends.landmarks.config",
    "SegSlam": "graphslam_frontends.segslam.front_end",
    "SegSlamConfig": "graphslam_frontends.segslam.config",
    "GridFilterConfig": "graphslam_frontends.grid.config",
    "StepConfig": "graphslam_frontends.odometry.step_config",
    "LidarFrontEnd": "graphslam_frontends.lidar_odometry.front_end",
    "ScanWindow": "graphslam_frontends.scan_window.front_end",
    "BackEndConfig": "graphslam.backend.config",
}


def parts() -> str:
    """The public names of the packages, and the tutorials that use each name."""
    text = """# Modules

The public names of the packages ([architecture](../architecture.md)). The tutorials use them, and you can use them too.
They change more often than functions and types. Example: `from graphslam.plots import plot_scan`, or
`gs.plots.plot_scan`.
"""
    uses = {p.stem: p.read_text(encoding="utf-8") for p in sorted((ROOT / "notebooks").glob("*.ipynb"))}
    for room in sorted(p.parent.name for p in (ROOT / "graphslam").glob("*/__init__.py")):
        module = importlib.import_module(f"graphslam.{room}")
        face: dict[str, str] = getattr(module, "_EXPORTS", {})
        if face:
            text += f"\n## graphslam.{room}\n\n{(module.__doc__ or '').strip()}\n"
        for name, home in sorted((n, m) for m, names in face.items() for n in names.split()):
            shown = [
                f"[{stem[:2]}](../tutorials/{stem}.md)"
                for stem, book in uses.items()
                if re.search(rf"\b{name}\b", book)
            ]
            text += f"\n::: graphslam.{room}.{home}.{name}\n    options:\n      members: false\n"
            text += f"\nTutorials: {', '.join(shown)}\n" if shown else ""
    return text


def entries(names: dict[str, str], *, members: bool) -> str:
    """One entry a name."""
    options = f"    options:\n      members: {'null' if members else 'false'}\n"
    return "".join(
        f"\n::: {module}.{name}\n{options}" for name, module in sorted(names.items(), key=lambda n: n[0].lower())
    )


def command_line() -> str:
    """The help of every command."""
    from graphslam.app.cli import app

    group = typer.main.get_command(app)
    text = ["# Command line\n\nAll commands. `--json` prints one JSON object on stdout. For completion in the shell "
            "run `graphslam --install-completion`.\n"]  # fmt: skip

    def add(command: Any, path: str) -> None:
        context = click.Context(command, info_name=path, terminal_width=100, max_content_width=100)
        if hasattr(command, "list_commands"):  # those of plug-ins, too
            for name in command.list_commands(context):
                add(command.get_command(context, name), f"{path} {name}")
            return
        text.append(f"## {path}\n\n```text\n{command.get_help(context)}\n```\n")

    add(group, "graphslam")
    return "\n".join(text)
