"""``report.html``: what a run did, decided and measured, on one page that needs no network, script or other file."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from pathlib import Path

from graphslam.app.markup import note, page
from graphslam.app.report_figures import figures
from graphslam.app.report_folder import Kind, read_folder
from graphslam.app.report_loops import hypotheses, loops
from graphslam.app.report_sections import events, evidence, graph, metrics, problems, records, times, what_was_run
from graphslam.app.report_verdict import verdict_lines
from graphslam.core.atomic import atomic_open
from graphslam.core.errors import GraphSlamError, RunFolderError
from graphslam.core.markup import element, join

logger = logging.getLogger(__name__)

PAGE = "report.html"
_PARTS = {
    "figures": figures,
    "run": what_was_run,
    "records": records,
    "metrics": metrics,
    "graph": graph,
    "loops": loops,
    "hypotheses": hypotheses,
    "evidence": evidence,
    "events": events,
    "times": times,
    "missing": problems,  # last: the others note what they did not find
}
_TITLES = {
    "run": "Report of a run",
    "interrupted": "Report of a run that was not finished",
    "merged": "Report of a merge",
}


@dataclass(frozen=True, slots=True)
class Report:
    """A page.

    Parameters
    ----------
    html : str
    kind : {"run", "interrupted", "merged"}
        Of the folder.
    problems : dict of str to str
        Part of the folder → why it is not in the page.
    """

    html: str
    kind: Kind
    problems: dict[str, str]


def make_report(folder: str | Path) -> Report:
    """The page of a run folder or a merged folder, finished or not.

    The same folder gives the same page. Two runs of the same configuration differ in its part ``times`` alone.

    Raises
    ------
    RunFolderError
        Neither a run folder nor a merged one. What is missing inside one, or damaged, is said in the page.
    """
    found = read_folder(folder)
    title = f"{_TITLES[found.kind]}: {found.name}"
    head = [element("h1", title), verdict_lines(found)]
    links = element("nav", *(element("a", name, href=f"#{name}") for name in _PARTS))
    made = [part(found) for part in _PARTS.values()]
    foot = note(
        "Written by graphslam from the files of the folder; nothing in it was measured anew but its NEES by submap."
    )
    html = page(title, [join(head, "\n"), links, *made, foot])
    return Report(html, found.kind, dict(found.problems))


def write_report(folder: str | Path, out: str | Path | None = None) -> Path:
    """Write the page of a folder; returns the file.

    Parameters
    ----------
    folder : path
    out : path, optional
        Default: ``report.html`` in the folder.

    Raises
    ------
    RunFolderError
        No run folder, or the page cannot be written.
    """
    return save_report(make_report(folder), Path(folder) / PAGE if out is None else Path(out))


def save_report(report: Report, file: Path) -> Path:
    """Write a page, whole or not at all."""
    try:
        with atomic_open(file, "w") as stream:
            stream.write(report.html)
    except OSError as error:
        raise RunFolderError(f"{file}: cannot be written ({error.strerror})") from None
    return file


def report_beside(folder: str | os.PathLike[str]) -> Path | None:
    """Write the page of what was just finished; its failure is said, and undoes nothing."""
    try:
        return write_report(Path(folder))
    except GraphSlamError as error:
        logger.warning("no report: %s", error)
        return None
