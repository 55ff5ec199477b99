"""Pages of the site that are made of other files: notebooks with outputs, gallery, public names, command line, changes.

MkDocs calls these functions (`hooks` in mkdocs.yml). Nothing here is imported by the package. Outputs of notebooks come
from the cache of `notebook_outputs.py`; a notebook that is not in it is shown without outputs, and its page says so.
"""

from __future__ import annotations

import base64
import html
import importlib
import importlib.util
import json
import posixpath
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import click
import typer
from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

from docs.notebook_outputs import NOTEBOOKS, cached

ROOT = Path(__file__).resolve().parents[1]
ROLE = re.compile(r":(?:func|class|meth|mod|attr|data|exc):(<code>)~?")
LINK = re.compile(r"\[([^\[\]]*)\]\((?!https?://|#|mailto:)([^)\s#]+)(#[^)]*)?\)")


def on_config(config: Any) -> Any:
    """The tutorials in the table of contents are those that there are."""
    pages = [f"tutorials/{p.stem}.md" for p in NOTEBOOKS]
    config.nav = [{"Tutorials": pages} if "Tutorials" in part else part for part in config.nav]
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are made."""
    tutorials = [Tutorial.of(path) for path in NOTEBOOKS]
    made: dict[str, str | bytes] = {
        "changelog.md": (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"),
        "contributing.md": (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"),
        "reference/command-line.md": command_line(),
        **reference(),
    }
    for t in tutorials:
        made[f"tutorials/{t.stem}.md"] = t.text
        made |= {f"tutorials/{name}": picture for name, picture in t.pictures.items()}
    for path, content in made.items():
        files.append(File.generated(config, path, content=content))
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

    if uri == "gallery.md":
        markdown += gallery([Tutorial.of(path) for path in NOTEBOOKS])
    return FORMULA.sub(lambda m: typeset(m[1]), LINK.sub(there, markdown))


FORMULA = re.compile(r"^\$\$\n(.+?)\n\$\$$", re.M | re.S)


def on_page_content(html: str, page: Any, config: Any, files: Files) -> str:
    """Names in docstrings are shown as code, without the roles of Sphinx before them."""
    return ROLE.sub(r"\1", html)


def typeset(tex: str) -> str:
    """A formula as MathML, which browsers draw without a script."""
    lines = [convert(line, display="block") for line in tex.split("\n")]
    return '<div class="formula">' + "".join(lines) + "</div>"


USER_PARTS = ("Start", "Your log", "Tutorials", "Concepts", "Sensors")


def on_page_context(context: Any, page: Any, config: Any, nav: Any) -> Any:
    """A page for users ends with the next one, if its text does not name another."""
    parts = [a.title for a in page.ancestors]
    if page.next_page is not None and parts and parts[-1] in USER_PARTS and "<p>Next: " not in page.content:
        to = page.next_page
        page.content += f'\n<p>Next: <a href="{to.file.url_relative_to(page.file)}">{html.escape(to.title)}</a>.</p>'
    return context


@dataclass
class Tutorial:
    """A notebook as a page."""

    stem: str
    title: str
    text: str
    pictures: dict[str, bytes] = field(default_factory=dict)
    """PNG by file name, in the order of the page."""

    @classmethod
    def of(cls, path: Path) -> Tutorial:
        """Text, code, and the outputs if the cache has them."""
        known = cached(path)
        cells = json.loads((known if known.exists() else path).read_text(encoding="utf-8"))["cells"]
        run = f"Run it yourself: `jupyter lab notebooks/{path.name}`."
        note = "This site was built without running the notebooks (`make docs EXECUTE=0`): no outputs."
        if known.exists():
            note = "Outputs are those of the quick mode (`GRAPHSLAM_QUICK=1`): smaller worlds, fewer runs."
        title = "".join(cells[0]["source"]).split("\n")[0].removeprefix("# ")
        page = cls(stem=path.stem, title=title, text="")
        parts = []
        for cell in cells:
            text = "".join(cell["source"]).strip()
            if cell["cell_type"] == "markdown":
                parts.append(text)
            elif text:
                parts.append(f'<a id="{cell["id"]}"></a>\n\n```python\n{text}\n```')
                parts += [page.shown(output, f"{cell['id']}-{k}") for k, output in enumerate(cell["outputs"])]
        page.text = "\n\n".join([parts[0], f"!!! note\n    {run} {note}", *parts[1:]]) + "\n"
        return page

    def shown(self, output: dict[str, Any], name: str) -> str:
        """One output as Markdown: a picture, a table or text."""
        if output["output_type"] == "error":
            return f'<pre class="output">{html.escape(str(output["evalue"]))}</pre>'
        if output["output_type"] == "stream":
            return (
                f'<pre class="output">{html.escape("".join(output["text"]))}</pre>'
                if output["name"] == "stdout"
                else ""
            )
        data = {kind: "".join(v) if isinstance(v, list) else v for kind, v in output.get("data", {}).items()}
        if "application/vnd.jupyter.widget-view+json" in data:  # a slider works in a live notebook only
            return ""
        if "image/png" in data:
            file = f"{self.stem}-{name}.png"
            self.pictures[file] = base64.b64decode(data["image/png"])
            return f'<p><img alt="Output of the cell above" src="{file}"></p>'
        if "text/html" in data:
            table = re.sub(r"<style.*?</style>|\n\s*|border=\"1\"", "", data["text/html"], flags=re.S)
            return f'<div class="output">{table}</div>'
        return f'<pre class="output">{html.escape(data.get("text/plain", ""))}</pre>'


MOST_PICTURES = 4
"""Of a tutorial in the gallery."""


def gallery(tutorials: list[Tutorial]) -> str:
    """Pictures, each a link to the code that draws it."""
    text = [""]
    if not any(t.pictures for t in tutorials):
        text.append(
            "!!! note\n    This site was built without running the notebooks (`make docs EXECUTE=0`): no pictures.\n"
        )
    for t in (t for t in tutorials if t.pictures):
        names = list(t.pictures)
        some = names[:: -(-len(names) // MOST_PICTURES)]
        cells = [re.sub(r"-\d+\.png$", "", n.removeprefix(f"{t.stem}-")) for n in some]
        links = [f"[![{t.title}](tutorials/{n})](tutorials/{t.stem}.md#{c})" for n, c in zip(some, cells)]
        text.append(f"## {t.title}\n\n" + "\n".join(links) + "\n{: .gallery }\n")
    return "\n".join(text)


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
    uses = {p.stem: p.read_text(encoding="utf-8") for p in NOTEBOOKS}
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
