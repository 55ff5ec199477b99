"""Every fault of landmark front ends and of GPS has an outcome that a user without truth sees."""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import graphslam as gs
from graphslam.app.data_check import check_source
from graphslam.app.run.run import Run
from graphslam.core.errors import GraphSlamError
from graphslam.core.geometry import se2_between, wrap_angle
from graphslam.core.log import SensorLog
from graphslam.core.records import LandmarkObservations
from graphslam_studies.faults import landmarks as inject
from tests.faults.landmark_rows import KNOWN, ROWS, Row, table
from tests.faults.sample import one_of_each
from tests.io import small_sources as small

PAGE = Path(__file__).resolve().parents[2] / "docs" / "notes" / "faults.md"
CERTAIN = 0.999


@functools.cache
def clean_log(kind: str) -> SensorLog:
    """A minute of driving: 260 scans of 6 to 8 landmarks; ranges to beacons all round; or with GPS."""
    if kind == "gps":
        return gs.simulate("landmark-field", seed=2, preset="quick", gps_rate=1.0, gps_sigma=0.3)
    if kind == "field":
        return gs.simulate("landmark-field", seed=2, preset="quick")
    if kind == "velocities":
        return inject.measured_velocities(clean_log("field"))
    if kind == "increments":
        return inject.measured_increments(clean_log("field"))
    log = gs.simulate("landmark-field", seed=2, preset="quick", field_of_view=2 * np.pi, max_range=40.0, landmarks=16)
    z = log["landmarks"]
    ranges = LandmarkObservations.range_only(
        times=z.times, offsets=z.offsets, ranges=z.ranges, range_sigma=z.sigmas[:, 0], ids=z.ids, max_range=z.max_range
    )
    return SensorLog(name=log.name, streams={**log.streams, "landmarks": ranges}, truth=log.truth, meta=log.meta)


@dataclass(frozen=True)
class Score:
    """A run against the truth that it did not have: RMS error of the path [m], and NEES of the submaps' ends."""

    error: float
    nees: float
    dof: int

    @property
    def over_confident(self) -> bool:
        return self.nees > stats.chi2.ppf(CERTAIN, self.dof)


def score(run: Run, log: SensorLog) -> Score:
    assert log.truth is not None
    path, solution = log.truth.trajectory, run.solution
    t = np.array([run.submaps[0].interval[0], *(s.interval[1] for s in run.submaps)])
    base, *_ = inside_truth = path.interpolate(t.clip(path.times[0], path.times[-1]))  # shifted stamps reach beyond it
    true = inside_truth[1:]
    error = se2_between(np.broadcast_to(base, true.shape), true) - solution.poses[solution.exit_nodes]
    error[:, 2] = wrap_angle(error[:, 2])
    columns = (3 * (solution.exit_nodes - 1)[:, None] + np.arange(3)).ravel()
    P, e = solution.joint_covariance()[np.ix_(columns, columns)], error.ravel()
    ours = run.map.trajectory
    inside = (ours.times >= path.times[0]) & (ours.times <= path.times[-1])
    there = path.interpolate(ours.times[inside])
    there = se2_between(np.broadcast_to(base, there.shape), there)
    off = np.linalg.norm(there[:, :2] - ours.poses[inside, :2], axis=1)
    return Score(float(np.sqrt(np.mean(off**2))), float(e @ np.linalg.solve(P, e)), len(e))


@functools.cache
def clean_run(frontend: str, kind: str) -> Run:
    config = {"gps": {"use": "all"}} if kind == "gps" else KNOWN
    return gs.run(inject.clean(clean_log(kind)), frontend=frontend, seed=1, config=config, progress=False)


@functools.cache
def clean_score(frontend: str, kind: str) -> Score:
    return score(clean_run(frontend, kind), clean_log(kind))


def judge(row: Row) -> tuple[str, list[str], Score | None]:
    """What a user sees of the fault, the codes of the lines that are not good, and the score."""
    log = clean_log(row.log)
    try:
        run = gs.run(row.inject(log), frontend=row.frontend, seed=1, config=row.config, progress=False)
    except GraphSlamError as error:
        return "refused", [str(error)], None
    return "made", [f.code for f in run.verdict if f.level in ("look", "bad")], score(run, log)


@pytest.mark.parametrize("row", one_of_each(ROWS, lambda r: (r.sensor, r.fault)), ids=lambda r: r.id)
def test_a_fault_has_its_outcome(row: Row) -> None:
    made, lines, found = judge(row)
    if row.outcome == "refused":
        assert made == "refused", lines
        assert row.shows in lines[0]
        return
    assert made == "made", lines
    assert found is not None
    shown = [c for c in lines if row.shows and re.fullmatch(row.shows, c)]
    assert shown or not row.shows, f"no line {row.shows} among {lines}"
    if row.outcome == "handled":
        clean = clean_score(row.frontend, row.log)
        assert not found.over_confident
        assert found.error < max(5.0 * clean.error, 1.0)
    # never silently wrong with a confident covariance
    assert shown or not found.over_confident


@pytest.mark.parametrize(("frontend", "kind"), sorted({(r.frontend, r.log) for r in ROWS}))
def test_a_log_without_a_fault_is_not_blamed(frontend: str, kind: str) -> None:
    run = clean_run(frontend, kind)
    codes = {f.code for f in run.verdict if f.level == "bad"}
    assert codes == ({"particles"} if frontend == "rbpf-slam" else set())  # one filter over a whole log always is wrong


def test_tables_whose_observations_are_late_are_corrected_and_the_verdict_says_so(tmp_path: Path) -> None:
    """Noise of a table is estimated from it, and the offset of its clocks with it."""
    small.tables(tmp_path, seconds=60.0)
    file = tmp_path / "observations.csv"
    head, *rows = file.read_text().splitlines()
    late = [",".join([f"{float(t) + 1.0:.6f}", *rest]) for t, *rest in (row.split(",") for row in rows)]
    file.write_text("\n".join([head, *late]) + "\n")
    run = gs.run(tmp_path, seed=1, progress=False)
    said = next(f.text for f in run.verdict if f.code == "calibrated")
    assert re.search(r"odometry stamps (1\.0|0\.9)\d* ± 0\.0\d+ s too early — corrected", said)
    times, _, _, pose = small.drive(60.0)
    true = pose[np.searchsorted(times + 1.0, run.map.trajectory.times.clip(times[0] + 1.0, times[-1] + 1.0))]
    off = se2_between(true[:1], true) - se2_between(run.map.trajectory.poses[:1], run.map.trajectory.poses)
    assert np.linalg.norm(off[:, :2], axis=1).max() < 0.15
    assert any(n.finding.code == "not-tested" and "clock" in n.finding.text for n in check_source(tmp_path))


def test_the_page_shows_these_rows() -> None:
    assert table() in PAGE.read_text(encoding="utf-8")


def test_every_row_is_there_once() -> None:
    assert len({r.id for r in ROWS}) == len(ROWS)
