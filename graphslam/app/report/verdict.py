"""The first lines of a report: the verdict of the run, or where it stopped."""

from __future__ import annotations

from graphslam.app.report.folder import ReportFolder
from graphslam.app.run.verdict import Figures, verdict
from graphslam.core.findings import Finding, headline
from graphslam.core.markup import Markup, element, join


def figures_of(folder: ReportFolder) -> Figures:
    """What the verdict is read from."""
    return Figures(folder.report, folder.values(), folder.events or [], folder.sessions)


def verdict_lines(folder: ReportFolder) -> Markup:
    """A headline, and lines with a colour each; the words say the same as the colours."""
    found = interrupted(folder) if folder.kind == "interrupted" else verdict(figures_of(folder))
    said = headline(found)
    return join(
        [
            element("p", said.text, class_=f"headline {said.level}"),
            element("ul", *(element("li", f.text, class_=f.level) for f in found), class_="verdict"),
        ]
    )


def interrupted(folder: ReportFolder) -> list[Finding]:
    """Lines of a run that was not finished."""
    return [
        Finding("bad", "interrupted", f"Not finished. {stopped(folder)}"),
        Finding("", "resume", "Go on with it: the same command once more, of “run” with --resume."),
    ]


def stopped(folder: ReportFolder) -> str:
    """Where an interrupted run stopped."""
    if not folder.submaps:
        return "It stopped before its first submap was finished."
    last = folder.submaps[-1]
    try:
        until = f"{float(last['interval'][1]):.2f} s"
        first = f"{float(folder.submaps[0]['interval'][0]):.2f} s"
    except (KeyError, TypeError, ValueError, IndexError):
        until = first = "an unknown time"
    return (
        f"It stopped after submap {last.get('key')} ({len(folder.submaps)} submaps, {first} to {until} of the log); "
        "nothing was solved yet that is on disk. How much of the log was left is not in the folder."
    )
