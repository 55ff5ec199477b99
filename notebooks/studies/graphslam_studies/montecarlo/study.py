"""Monte-Carlo studies: run what is not yet done, keep every trial, make one tidy table and what follows from it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from graphslam.app.folders.generations import new_generation
from graphslam.app.machine import one_blas_thread, versions
from graphslam.core.errors import ConfigError, GraphSlamError, UnknownNameError
from graphslam.core.markup import html_element, html_table, join_parts
from graphslam.core.plugins import plugins
from graphslam.core.progress import Bar
from graphslam_studies.montecarlo.definition import GROUP, StudyDefinition, find_study, fingerprint, source_digest
from graphslam_studies.montecarlo.executors import Executor, Job, execute, hold_one_thread
from graphslam_studies.montecarlo.folder import StudyFolder
from graphslam_studies.montecarlo.interrupt import watch_interrupts
from graphslam_studies.montecarlo.trials import Measurement, check_measurements, trial_seed

logger = logging.getLogger(__name__)

# Of all versions, those that draw or describe do not change a figure.
_NOT_COMPUTING = ("matplotlib",)


@dataclass(frozen=True)
class Study:
    """What a study has found so far.

    Parameters
    ----------
    identity : dict
        Name, seed, quick, fingerprints of the worlds' configurations, versions.
    table : DataFrame
        ``world, run, algorithm, submap, quantity, value``; the same for every executor, also after a stop.
    timings : DataFrame
        The same columns; measured times, which no run repeats.
    failures : DataFrame
        ``world, run, seed, error`` of the trials that failed.
    sources : frozenset of str
        Digests of the code that ran the trials; more than one where it was changed in between.
    """

    definition: StudyDefinition
    folder: StudyFolder
    identity: dict[str, Any]
    table: pd.DataFrame = field(repr=False)
    timings: pd.DataFrame = field(repr=False)
    failures: pd.DataFrame = field(repr=False)
    sources: frozenset[str] = frozenset()

    @classmethod
    def read(cls, definition: StudyDefinition, folder: StudyFolder) -> Study:
        """Collect all finished trials of a folder."""
        found = folder.collect()
        identity = folder.identity()
        return cls(definition, folder, identity, found.table, found.timings, found.failures, found.sources)

    @property
    def runs(self) -> dict[str, int]:
        """Finished runs of each world."""
        counts = self.table.groupby("world")["run"].nunique()
        return {world: int(counts.get(world, 0)) for world in self.worlds}

    @property
    def worlds(self) -> tuple[str, ...]:
        """Worlds with a finished or failed trial, in the study's order."""
        present = {*self.table["world"], *self.failures["world"]}
        return tuple(w for w in self.definition.worlds(bool(self.identity["quick"])) if w in present)

    def report(self) -> dict[str, pd.DataFrame]:
        """The study's named summary tables."""
        return self.definition.report(self.table, self.timings)

    def plot_consistency(
        self, quantity: str = "pose_nees", *, world: str | None = None, ax: Any = None, **options: Any
    ) -> Any:
        """Consistency index along the run; see :func:`graphslam_studies.plots.study.plot_ci`."""
        from graphslam_studies.plots.study import plot_ci

        return plot_ci(ax, self._of(self.table, world), quantity, **options)

    def plot_rms(self, *, world: str | None = None, **options: Any) -> Sequence[Any]:
        """RMS errors of poses and features; see :func:`graphslam_studies.plots.study.plot_rms_panels`."""
        from graphslam_studies.plots.study import plot_rms_panels

        return plot_rms_panels(self._of(self.table, world), **options)

    def plot_errors(self, algorithm: str | None = None, *, world: str | None = None, **options: Any) -> Sequence[Any]:
        """Error of one run with its 3σ band; see :func:`graphslam_studies.plots.study.plot_error_panels`."""
        from graphslam_studies.plots.study import plot_error_panels

        return plot_error_panels(self._of(self.table, world), algorithm, **options)

    def plot_time(self, *, world: str | None = None, ax: Any = None, **options: Any) -> Any:
        """Cumulative time along the run; see :func:`graphslam_studies.plots.study_time.plot_cumulative_time`."""
        from graphslam_studies.plots.study_time import plot_cumulative_time

        return plot_cumulative_time(ax, self._of(self.timings, world), **options)

    def _of(self, table: pd.DataFrame, world: str | None) -> pd.DataFrame:
        """Rows of one world; of the first where none is named."""
        if world is None and self.worlds:
            world = self.worlds[0]
        if world not in self.worlds:
            raise UnknownNameError("finished world", str(world), self.worlds)
        return table[table["world"] == world]

    def __repr__(self) -> str:
        runs = ", ".join(f"{w}: {n}" for w, n in self.runs.items())
        return f"Study({self.definition.name!r}: runs {runs or 'none'}; {len(self.failures)} failed)"

    def _repr_html_(self) -> str:
        runs = [
            {"world": w, "runs": n, "failed": int((self.failures["world"] == w).sum())} for w, n in self.runs.items()
        ]
        parts: list[str] = [
            html_element("b", f"Study {self.definition.name}"),
            f": {self.definition.description}",
            html_table(runs, ["world", "runs", "failed"]),
        ]
        try:
            for title, rows in self.report().items():
                parts.append(
                    html_element(
                        "details", html_element("summary", title), html_table(rows.to_dict("records"), list(rows))
                    )
                )
        except GraphSlamError as error:
            parts.append(html_element("p", f"no report: {error}"))
        return join_parts(parts)


def study(
    name: str,
    trials: int | None = None,
    *,
    out: str | Path | None = None,
    worlds: Sequence[str] | None = None,
    seed: int = 0,
    workers: int | str | None = None,
    quick: bool = False,
    progress: bool = True,
) -> Study:
    """See :func:`graphslam.study`."""
    definition = find_study(name)
    known = tuple(definition.worlds(quick))
    for world in worlds or ():
        if world not in known:
            raise UnknownNameError("world", world, known)
    chosen = [w for w in known if not worlds or w in worlds]
    count = definition.default_trials(quick) if trials is None else trials
    if count < 1:
        raise ConfigError(f"{count} trials; wanted at least 1")
    functions = {w: definition.trial(w, quick) for w in known}
    identity = {
        "name": name,
        "seed": int(seed),
        "quick": bool(quick),
        "worlds": {w: fingerprint(f) for w, f in functions.items()},
        "versions": {k: v for k, v in versions().items() if k not in _NOT_COMPUTING},
    }
    with StudyFolder.start(out if out is not None else f"study-{definition.name}", identity) as folder:
        # run by run through all worlds, so that a study that is stopped has as many runs of each
        wanted = [(w, k) for k in range(count) for w in chosen]
        return _run(definition, folder, functions, wanted, seed, workers, progress)


def _run(
    definition: StudyDefinition,
    folder: StudyFolder,
    functions: Mapping[str, Callable[[int], Iterable[Measurement]]],
    wanted: Sequence[tuple[str, int]],
    seed: int,
    workers: int | str | None,
    progress: bool,
) -> Study:
    """Run the trials ``(world, number)`` that are not in the folder yet, and write what follows from all of them."""
    processes, address = (None, workers) if isinstance(workers, str) else (workers, None)
    executor: Executor = "dask" if address else "serial" if processes is None else "processes"
    there, source = folder.finished(), source_digest()
    jobs = {
        f"{w}/{k}": (w, k, Job(f"{w}/{k}", functions[w], trial_seed(seed, k)))
        for w, k in wanted
        if not there.get((w, k))
    }
    outcomes = execute(
        [job for _, _, job in jobs.values()],
        executor=executor,
        workers=processes,
        address=address,
        prepare=None if executor == "serial" else hold_one_thread,
    )
    try:
        with (
            watch_interrupts() as interrupt,
            closing(outcomes),  # ends the workers, whatever happens here
            one_blas_thread(),
            Bar(total=len(wanted), name=definition.name, shown=progress) as bar,
        ):
            bar.update(len(wanted) - len(jobs))
            for outcome in outcomes:
                interrupt.check()
                w, k, job = jobs[outcome.job.name]
                error = outcome.error or check_measurements(outcome.values)
                if error:
                    logger.warning("trial %s (seed %d) failed: %s", job.name, job.seed, error)
                folder.write_trial(w, k, job.seed, () if error else outcome.values, error, outcome.details, source)
                bar.update()
    except KeyboardInterrupt:
        logger.warning("stopped; writing what is done, and the same call goes on from there")
        write_results(Study.read(definition, folder), figures=False)
        raise
    result = Study.read(definition, folder)
    write_results(result)
    return result


def open_study(folder: str | Path, definition: StudyDefinition | str | None = None) -> Study:
    """See :func:`graphslam.open_study`."""
    opened = StudyFolder(folder)
    if definition is None:
        name = str(opened.identity()["name"])
        if name not in plugins(GROUP):
            raise UnknownNameError("study", name, [*plugins(GROUP), "your own, with open_study(folder, definition)"])
        definition = name
    return Study.read(find_study(definition) if isinstance(definition, str) else definition, opened)


def write_results(result: Study, *, figures: bool = True) -> list[Path]:
    """Write ``table.csv``, ``timings.csv``, ``report.md`` and ``figures/`` as a new state; paths of the figures.

    Whatever a report or figure cannot say with so few runs, no trial is lost: the trials are there.
    """
    folder = result.folder
    made: list[Path] = []
    tables: dict[str, pd.DataFrame] = {}
    problems = []
    if len(result.sources) > 1:
        problems.append(f"the code was changed between trials: they were run by {len(result.sources)} versions of it")
    with new_generation(folder.path) as new:
        new.write_table("table.csv", result.table)
        new.write_table("timings.csv", result.timings)
        if len(result.table):
            try:
                tables = result.report()
            except GraphSlamError as error:
                problems.append(f"no tables: {error}")
            if figures:
                try:
                    made = list(result.definition.figures(result.table, result.timings, new.figures))
                except GraphSlamError as error:
                    problems.append(f"no figures: {error}")
        for problem in problems:
            logger.warning("%s: %s", result.definition.name, problem)
        made = [p.relative_to(new.path) for p in made]
        new.write_text("report.md", _report(result, tables, made, problems))
    return [folder.path / p for p in made]


def _report(result: Study, tables: dict[str, pd.DataFrame], figures: list[Path], problems: list[str]) -> str:
    """The report as Markdown; ``figures`` as they lie in the folder."""
    d, identity = result.definition, result.identity
    counts = pd.DataFrame(
        [(w, n, int((result.failures["world"] == w).sum())) for w, n in result.runs.items()],
        columns=["world", "runs", "failed"],
    )
    parts = [
        f"# {d.name}",
        d.description,
        f"Seed {identity['seed']}{', quick' if identity['quick'] else ''}. "
        + ", ".join(f"{k} {v}" for k, v in identity["versions"].items())
        + ".",
        markdown_table(counts) if len(counts) else "No trial is finished.",
        *[f"**{p}**" for p in problems],
    ]
    if len(result.failures):
        parts += [f"## Failed trials: {len(result.failures)}", markdown_table(result.failures)]
    for title, found in tables.items():
        parts += [f"## {title}", markdown_table(found)]
    if figures:
        parts += ["## Figures", *[f"![{p.stem}]({p.as_posix()})" for p in figures]]
    return "\n\n".join(parts) + "\n"


def markdown_table(frame: pd.DataFrame) -> str:
    """A table as Markdown; numbers with four digits, missing ones as a dash, bars in texts escaped."""

    def cell(value: Any) -> str:
        if value is None or value is pd.NA or (isinstance(value, float) and value != value):
            return "-"
        if isinstance(value, float):
            return f"{value:.4g}"
        return " ".join(str(value).replace("|", r"\|").split())

    names = [str(c) for c in frame.columns]
    rows = [[cell(v) for v in row] for row in frame.itertuples(index=False, name=None)]
    lines = [names, ["---"] * len(names), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
