"""The verdict of a run: what a user without truth is told, in text, in JSON, and in the report."""

from __future__ import annotations

import ast
import itertools
import json
from fnmatch import fnmatchcase
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import graphslam as gs
from graphslam.app.cli.run import _summary, join_note
from graphslam.app.report.report import make_report
from graphslam.app.run.run import Run
from graphslam.app.run.summary import (
    ADVICE,
    CONSERVATIVE,
    CONSISTENCY_CODES,
    NOTHING,
    NOTHING_KNOWN,
    SMALL_RESIDUALS,
    START,
    length_text,
    summarise_run,
)
from graphslam.app.verdict.checks import findings_from_metrics
from graphslam.app.verdict.figures import RunMetrics
from graphslam.app.verdict.observed import findings_from_run
from graphslam.core.findings import Finding, findings_of_json, headline_of_json, verdict_json, worst_level
from graphslam.evaluate.covariance_assessment import chi_square_ratio_test, consistency_tests_as_json
from tests.reference.page import Page

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    log = gs.simulate("landmark-field", preset="quick", seed=3, gps_rate=1.0, gps_sigma=0.3)
    return gs.run(log, seed=5, out=tmp_path_factory.mktemp("verdict") / "r", progress=False)


def test_text_json_and_report_say_the_same(run: Run) -> None:
    lines = run.verdict
    assert {"streams", "state", "chi2", "nees"} <= {f.code for f in lines}
    stored = json.loads((run.folder / "run.json").read_text())["verdict"]
    assert findings_of_json(stored) == lines
    assert gs.open_run(run.folder).verdict == lines
    text = _summary(run, Path("out"), False)
    page = Page(make_report(run.folder).html)
    shown = [t for _, t in page.verdict]
    for f in lines:
        assert f.text in text
        assert f.text in shown
    headline = headline_of_json(stored)
    assert headline == run.headline == gs.open_run(run.folder).headline
    assert text.count(f"verdict: {headline.text}") == 1
    assert (page.headline, page.text.count(headline.text)) == (headline.text, 1)


def test_every_stream_is_counted(run: Run) -> None:
    rows = {r["name"]: r for r in run.report["streams"]}
    assert set(rows) == set(run.log.streams)
    for name, row in rows.items():
        assert row["offered"] == len(run.log[name].times)
        assert 0 <= row["used"] <= row["offered"]
        assert row["used"] == row["offered"] or row["why"]
    assert rows["landmarks"]["used"] > 0.9 * rows["landmarks"]["offered"]
    assert rows["gps"]["used"] == 0
    assert rows["gps"]["why"].startswith("gps.use is none; every-second")
    assert "(gps.use is none; every-second" in next(f.text for f in run.verdict if f.code == "streams")


def codes_of(file: Path) -> set[str]:
    """Codes of the findings of a module that may be bad or worth a look; ``x`` where a name is put in."""
    out = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if not (isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Finding" and len(node.args) == 3):
            continue
        level, code, _ = node.args
        if isinstance(level, ast.Constant) and level.value in ("", "good", "ok", "missing"):
            continue
        if isinstance(code, ast.JoinedStr):
            out.add("".join(str(v.value) if isinstance(v, ast.Constant) else "x" for v in code.values))
        elif isinstance(code, ast.Constant):
            out.add(code.value)
    return out - {"headline"}


SOURCES = [*(ROOT / "graphslam").rglob("*.py"), *(ROOT / "frontends").rglob("*.py")]
CODES = set().union(*(codes_of(file) for file in SOURCES if file.name != "doctor.py"))
"""Codes of all findings that may be bad or worth a look, as they stand in the code."""


def test_every_finding_that_may_be_bad_says_what_to_do() -> None:
    assert len(CODES) > 60
    assert not [c for c in CODES if not any(fnmatchcase(c, pattern) for pattern in ADVICE)]


def figures(
    converged: bool | None, chi2: float | None, nees: float | None, loops: float | None, own: float | None = None
) -> RunMetrics:
    m = {"submaps": 7.0, "path_length": 305.2, "gap": 0.0}
    if nees is not None:
        m |= {"nees_per_dof": nees, "nees_dof": 42.0, "path_rmse_aligned": 0.0412}
    if loops is not None:
        m |= {"loops_value": loops, "loops_dof": 400.0}
    report: dict[str, Any] = {} if converged is None else {"converged": converged}
    if chi2 is not None:
        row = {"class": "submap", "dof": 300.0, "rows": 300, "chi2": 300.0 * chi2, "chi2_per_dof": chi2}
        report["graph"] = {"classes": [row]}
    if own is not None:
        report["evidence"] = consistency_tests_as_json(chi_square_ratio_test("χ²", "map", own, 300.0 if own else 2.0))
    return RunMetrics(report, m)


RATIOS = (None, 0.3, 1.0, 1.19, 6.3)
"""Of χ²/dof and NEES/dof: not known, far below the bounds, consistent, between 95 % and 99.9 % (of χ²), far above."""


def test_the_first_line_is_never_greener_than_the_lines_below_it() -> None:
    """Over combinations of figures and of lines that the run saw itself."""
    seen = [*itertools.product(("good", "look", "bad"), ("passes", "calibration", "gps-not-used", "new-one"))]
    one = [[Finding(level, code, "x.")] for level, code in seen]
    extra = [[], *one, one[1] + one[6], one[4] + one[9]]
    headlines = set()
    every = itertools.product((True, False), RATIOS, RATIOS, (None, 1.0, 1.8), (None, 0.0, 0.3, 1.0, 2.0))
    for converged, chi2, nees, loops, own in every:
        figs = figures(converged, chi2, nees, loops, own)
        for more in extra:
            lines = [*findings_from_metrics(figs), *more]
            first = summarise_run(figs, lines)
            level = worst_level(lines) or "good"
            (word,) = [w for w, start in START.items() if first.text.startswith(start)]
            assert first.level == ("" if level == "good" and word == "not tested" else level)
            bad = {f.code for f in lines if f.level == "bad"}
            assert (word == "wrong") == bool(bad - CONSISTENCY_CODES)
            over = bad & CONSISTENCY_CODES or own == 2.0 or (nees or 0.0) > 2.0
            assert (word == "overconfident") == bool(over and word != "wrong")
            if word == "consistent":
                assert nees in (1.0, 1.19) or own == 1.0 or (nees is own is None and chi2 in (1.0, 1.19))
                assert "power" in first.text
            if (chi2, nees, loops) == (None, None, None) and own in (None, 0.0) and not bad:
                assert word == "not tested"
            assert len(first.text) < 470
            do = first.text.partition("To do: ")[2].rstrip(".")
            held = {f.code: f.level for f in lines if f.code in ("chi2", "nees")}
            if held["nees"] != "good":
                assert "covariances match the true" not in first.text
            if own in (None, 0.0, 1.0) and held["nees"] != "look":
                assert do != CONSERVATIVE
            if held["chi2"] != "good" or any(f.code == "consistency-test" for f in lines):
                assert "residuals match" not in first.text
            at = {f.code for f in lines if f.level == level}
            if level in ("look", "bad"):
                named = {c for c, text in ADVICE.items() if text == do} | {do.partition("“")[2].rstrip("”")}
                assert do in (CONSERVATIVE, SMALL_RESIDUALS) or any(fnmatchcase(c, n) for c in at for n in named), (
                    do,
                    at,
                )
                assert level == "look" or do not in (CONSERVATIVE, SMALL_RESIDUALS)
            else:
                assert do in (NOTHING, NOTHING_KNOWN)
            headlines.add(first.text)
    assert len(headlines) > 300


def test_the_first_line_says_what_was_made_and_what_to_do() -> None:
    figs = figures(True, 1.0, 6.3, None)
    assert summarise_run(figs, findings_from_metrics(figs)).text == (
        "Overconfident: errors are larger than the covariances; 1 point marked “bad” — 305 m in 7 submaps, no loop "
        "closures; path error 4.1 cm (RMSE, ground truth); residuals match the noise model (χ²/dof 1); true errors are "
        "larger than the covariances (NEES/dof 6.3). To do: repeat with other seeds (--seed 1, 2, …) before you use "
        "its covariances."
    )
    own = Finding("bad", "calibration", "Ranges are long. To do: check the unit of the ranges.")
    (cause,) = (summarise_run(figs, [*findings_from_metrics(figs), own]).text,)
    assert cause.endswith("To do: check the unit of the ranges.")
    consistent = figures(True, 1.0, 1.0, None)
    assert summarise_run(consistent, findings_from_metrics(consistent)).text.endswith(f"To do: {NOTHING}.")
    unknown = figures(True, 1.0, None, None)
    assert "true error unknown" in summarise_run(unknown, findings_from_metrics(unknown)).text
    assert summarise_run(unknown, findings_from_metrics(unknown)).text.endswith(f"To do: {NOTHING_KNOWN}.")
    assert [length_text(x) for x in (4012.0, 305.2, 1.263, 0.0412, 0.0063)] == [
        *("4.01 km", "305 m", "1.26 m", "4.1 cm", "6.3 mm")
    ]


def test_loops_that_disagree_are_read_by_the_verdict() -> None:
    """A mounting that is wrong by a metre shows nowhere else: the figure must reach the user."""
    solved = {"converged": True}
    dof = 400.0
    for value, expected in ((1.05, []), (1.76, ["bad"])):
        lines = findings_from_metrics(RunMetrics(solved, {"loops_value": value, "loops_dof": dof, "gap": 0.0}))
        assert [f.level for f in lines if "disagreement of loop closures" in f.text] == expected


def test_what_is_reported_of_many_submaps_is_reported_twice_and_counted() -> None:
    def submap(key: int) -> SimpleNamespace:
        rows = [Finding("look", "scans-unobservable", f"Submap {key}: nothing holds it.").as_row()]
        rows += [Finding("", "note", text).as_row() for text in ("one", "two", "three")] if key == 0 else []
        return SimpleNamespace(key=key, report={"findings": rows})

    found = findings_from_run([], submaps=[submap(k) for k in range(20)])  # type: ignore[misc]
    assert [f.text for f in found if f.code == "note"] == ["one", "two", "three"]
    unobservable = [f.text for f in found if f.code == "scans-unobservable"]
    assert len(unobservable) == 3
    assert unobservable[0] == "Submap 0: nothing holds it."
    assert "18 more submaps (2, 3, 4" in unobservable[2]
    assert not [f for f in findings_from_run([], submaps=[submap(0), submap(1)]) if "more submaps" in f.text]


def test_what_is_no_finding_of_ours_is_left_out() -> None:
    good = Finding("bad", "x", "y")
    value = verdict_json(good, [good])
    for row in (
        {"level": "worse", "code": "x", "text": "y"},
        {"level": "bad"},
        3,
        None,
        {"level": [], "code": "", "text": ""},
    ):
        value["lines"].append(row)
    assert findings_of_json(value) == [good]
    assert findings_of_json({"lines": 3}) == findings_of_json(None) == []


def test_the_note_on_the_join_is_one_that_consistent_runs_do_not_get(run: Run) -> None:
    """Two-sided bounds at the join's own degrees of freedom; and a cause that a check names comes first."""

    def noted(chi2: float, dof: float, verdict: list[Finding]) -> list[str]:
        rows = [{"key": "join_chi2_per_dof", "value": chi2}, {"key": "join_dof", "value": dof}]
        return join_note(SimpleNamespace(metric_rows=rows, report={"covariance_scale": 1.0}, verdict=verdict))

    assert join_note(run) == []
    assert noted(1.5, 20, []) == []
    assert "covariance_scale=1.5" in noted(1.5, 200, [])[0]
    assert "covariance_scale=0.8" in noted(0.8, 2000, [])[0]
    (line,) = noted(1.5, 200, [Finding("bad", "calibration", "x"), Finding("", "streams", "y")])
    assert "calibration" in line
    assert "covariance_scale" not in line


def test_two_maps_that_explain_a_log_are_reported() -> None:
    """What is in either, how far they lie apart, and what is in dispute."""
    place = {"loops": [[3, 4, 5], [7]], "nodes": [[14, 19], [94, 99]], "times": [[42.0, 57.0], [282.0, 297.0]]}
    facts = {
        "loops": [[3, 4, 5], [7]],
        **{"apart_max": 8.125, "apart_median": 0.4, "apart_max_node": 95, "apart_max_time": 285.0},
        "places": [place],
    }

    def said(report: dict[str, Any]) -> list[Finding]:
        return [f for f in findings_from_metrics(RunMetrics(report, {}, [])) if f.code == "two-maps"]

    (line,) = said({"two_maps": facts})
    assert line.level == "bad"
    assert "one with loops 3, 4, 5, one with loop 7 —" in line.text
    assert "up to 8.12 m (at 285 s; median 0.40 m)" in line.text
    assert "42 to 57 s and 282 to 297 s" in line.text
    assert "may follow either map" not in line.text
    assert line.code in ADVICE
    assert said({}) == []
    two = {**facts, "places": [place, place]}
    assert "Each of these places may follow either map" in said({"two_maps": two})[0].text
