"""``report.html``: steps, decisions and metrics of a run on one page that needs no network and no other file."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

from graphslam.app.folders.generations import FolderTransaction, name_inside, new_generation, read_consistently
from graphslam.app.report.figures import report_pictures
from graphslam.app.report.folder import Kind, read_folder
from graphslam.app.report.loops import hypotheses_section, loops_section
from graphslam.app.report.markup import whole_page
from graphslam.app.report.refinement import refinement_section
from graphslam.app.report.scene import report_scene
from graphslam.app.report.sections import (
    control_section,
    events_section,
    evidence_section,
    graph_section,
    metrics_section,
    problems_section,
    records_section,
    times_section,
    verdict_lines,
    what_was_run,
)
from graphslam.core.atomic import atomic_open, check_file_target
from graphslam.core.errors import GraphSlamError, RunFolderError
from graphslam.core.markup import html_element, plain_text

logger = logging.getLogger(__name__)

PAGE = "report.html"
_PARTS = {
    "figures": report_pictures,
    "refinement": refinement_section,
    "run": what_was_run,
    "records": records_section,
    "points": control_section,
    "metrics": metrics_section,
    "graph": graph_section,
    "loops": loops_section,
    "hypotheses": hypotheses_section,
    "evidence": evidence_section,
    "events": events_section,
    "times": times_section,
    "missing": problems_section,  # last, because the other sections record problems
}
_TITLES = {"run": "Report of a run", "interrupted": "Report of an unfinished run", "merged": "Report of a merge"}


@dataclass(frozen=True, slots=True)
class Report:
    """A report page.

    Parameters
    ----------
    kind : {"run", "interrupted", "merged"}
        Of the folder.
    problems : dict of str to str
        Part of the folder → why it is not in the page.
    damage : str
        What is wrong with the result itself; empty if nothing is.
    """

    html: str
    kind: Kind
    problems: dict[str, str]
    damage: str = ""

    def _repr_html_(self) -> str:
        """The page in a notebook, isolated from the notebook's own style and scripts."""
        return html_element("iframe", srcdoc=self.html, style="width: 100%; height: 46rem; border: 0")


def make_report(folder: str | Path) -> Report:
    """The page of a run folder or a merged folder, finished or not.

    The same folder gives the same page. Two runs with the same configuration differ only in the part ``times``.
    """
    return read_consistently(folder, lambda root: _page(Path(folder), root))


def _page(home: Path, root: Path) -> Report:
    found = read_folder(home, root)
    headline, lines = verdict_lines(found)
    shown = report_scene(found)
    html = whole_page(
        title=plain_text(f"{_TITLES[found.kind]}: {found.name}"),
        headline=headline,
        findings=[replace(f, text=plain_text(f.text)) for f in lines],
        scene=shown,
        parts={name: made for name, part in _PARTS.items() if (made := part(found))},
    )
    return Report(html, found.kind, dict(found.problems), found.damage())


def write_report(folder: str | Path, out: str | Path | None = None) -> Path:
    """Write the page of a folder; returns the file.

    Parameters
    ----------
    out : path, optional
        Default: ``report.html`` in the folder.
    """
    return report_and_file(folder, out)[1]


def report_and_file(folder: str | Path, out: str | Path | None = None) -> tuple[Report, Path]:
    """Write the page of a folder; returns the page and its file. See :func:`write_report`."""
    if out is not None:
        check_file_target(out)
    home, report = Path(folder), make_report(folder)
    name = PAGE if out is None else name_inside(home, out)
    if name is None:
        assert out is not None
        return report, _save(report, Path(out))
    with new_generation(home) as new:
        new.adopt(drop=[name])
        report = _page(home, new.path)
        _save(report, new.path / name)
    return report, home / name


def _save(report: Report, file: Path) -> Path:
    try:
        with atomic_open(file, "w") as stream:
            stream.write(report.html)
    except OSError as error:
        raise RunFolderError(f"{file}: cannot be written ({error.strerror})") from None
    return file


def add_report(new: FolderTransaction) -> None:
    """Write the page of a state that is being written; a failure is logged and does not stop the writing."""
    try:
        _save(_page(new.home, new.path), new.path / PAGE)
    except GraphSlamError as error:
        logger.warning("no report: %s", error)
