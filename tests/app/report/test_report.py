"""The report: a whole page that asks for nothing, says what the folder says, and what the folder lacks."""

from __future__ import annotations

import base64
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import graphslam as gs
from graphslam.app.cli import app
from graphslam.app.report.report import PAGE, make_report, write_report
from graphslam.core.errors import OutputError, RunFolderError
from graphslam.core.log import SensorLog
from tests.app.report.test_markup import HOSTILE
from tests.reference.page import Page

PARTS = [
    "figures",
    "refinement",
    "run",
    "records",
    "metrics",
    "graph",
    "loops",
    "hypotheses",
    "evidence",
    "events",
    "times",
]


@pytest.fixture(scope="module")
def log() -> SensorLog:
    return gs.simulate("landmark-field", preset="quick", seed=3, gps_rate=1.0, gps_sigma=0.3)


def finished(log: SensorLog, out: Path) -> Path:
    options = {"gps": {"use": "every-second"}, "frontend": {"particles": 20}}
    gs.run(log, seed=5, out=out, solver="batch", config=options, progress=False)
    return out


@pytest.fixture(scope="module")
def folder(log: SensorLog, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return finished(log, tmp_path_factory.mktemp("report") / "run")


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "copy"))


@pytest.fixture(scope="module")
def whole(folder: Path) -> Page:
    return read(folder)


def read(folder: Path) -> Page:
    return checked(make_report(folder).html)


def checked(html: str) -> Page:
    page = Page(html)
    page.check_alone()
    drawn = [json.loads(code) for values, code in page.scripts if values.get("id") == "scene"]
    first = ["curves"] if drawn and drawn[0]["curves"] else []
    assert list(page.sections) == [*first, *PARTS, "missing"]
    return page


def test_a_run_writes_its_page(folder: Path, whole: Page) -> None:
    text = (folder / PAGE).read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE html>")
    assert make_report(folder).html == text
    assert "://" not in re.sub(r"base64,[A-Za-z0-9+/=]+", "", text)
    page = whole
    figures = {p.read_bytes() for p in (folder / "figures").glob("*.png")}
    shown = [base64.b64decode(s.partition(",")[2]) for s in page.sources]
    assert figures < set(shown)
    assert len(shown) == len(figures) + 1  # NEES by submap
    assert all(s.startswith(b"\x89PNG\r\n\x1a\n") for s in shown)
    assert page.sections["missing"].endswith("Nothing.")


def test_the_verdict_is_that_of_the_figures(folder: Path, whole: Page) -> None:
    m = {r["key"]: r["value"] for r in json.loads((folder / "metrics.json").read_text())}
    lines = {text.split(":")[0].split(".")[0]: (kind, text) for kind, text in whole.verdict}
    kind, text = lines["solution"]
    assert kind == "good"
    assert f"{m['objective']:.6g}" in text
    classes = json.loads((folder / "run.json").read_text())["graph"]["classes"]
    chi2, dof = (sum(c[k] for c in classes) for k in ("chi2", "dof"))
    # without kernels: Σ χ² is the objective, and the dof is scalars less unknowns
    assert chi2 == pytest.approx(m["objective"])
    states = sum(c["rows"] for c in classes) - dof
    assert states == pytest.approx(m["states"], abs=1e-6)
    kind, text = lines["chi-square of the graph"]
    assert text.startswith(f"chi-square of the graph: {chi2 / dof:.3g} per degree of freedom [")
    low, high = (float(x) for x in re.search(r"\[(\S+), (\S+);", text).groups())
    assert (kind == "good") == (low < chi2 / dof < high)
    assert ("residuals match" in text) == (low < chi2 / dof < high)
    assert any(f"{m['nees_per_dof']:.3g}" in text for _, text in lines.values())


@pytest.mark.parametrize(
    ("key", "value", "kind", "said"),
    [
        ("nees_per_dof", 9.0, "bad", "overconfident"),
        ("nees_per_dof", 0.01, "look", "conservative"),
        ("gap", 5.0, "look", "lower by 5"),
        ("gap", 1e-9, "good", "is no lower"),
        ("gap", None, "good", "not compared with a batch"),
    ],
)
def test_the_verdict_follows_them(copy: Path, key: str, value: float | None, kind: str, said: str) -> None:
    rows = json.loads((copy / "metrics.json").read_text())
    (row,) = [r for r in rows if r["key"] == key]
    row["value"] = value
    (copy / "metrics.json").write_text(json.dumps(rows))
    assert [k for k, text in read(copy).verdict if said in text] == [kind]


def test_an_unsolved_run_is_called_so(copy: Path) -> None:
    report = json.loads((copy / "run.json").read_text())
    (copy / "run.json").write_text(json.dumps(report | {"converged": False}))
    assert read(copy).verdict[0] == ("bad", "solution: not converged — the graph is not at its optimum.")


def test_an_imu_of_other_axes_is_reported_at_once(copy: Path) -> None:
    event = {"event": "imu-axes", "stream": "imu", "verdict": "as stated", "words": "x and y swapped <i>"}
    with (copy / "events.jsonl").open("a") as stream:
        stream.write(json.dumps(event) + "\n")
    assert not [t for _, t in read(copy).verdict if "swapped" in t]
    with (copy / "events.jsonl").open("a") as stream:
        stream.write(json.dumps(event | {"verdict": "wrong"}) + "\n")
    assert ("bad", "IMU imu: x and y swapped <i>") in read(copy).verdict


def test_metrics_stand_with_unit_direction_and_bounds(folder: Path, whole: Page) -> None:
    rows = json.loads((folder / "metrics.json").read_text())
    page = whole
    shown = {r["metric"]: r for r in page.table("metrics", "metric", "direction").records()}
    times = {r["metric"]: r for r in page.table("times", "metric", "value").records()}
    m = {r["key"]: r["value"] for r in rows}
    missing = []
    for r in rows:
        if r["key"].startswith("seconds_"):
            continue
        cells = shown.get(r["key"]) or times.get(r["key"])
        if cells is None:
            missing.append(r["key"])
            continue
        assert cells["value"] == ("–" if r["value"] is None else f"{r['value']:.6g}"), r["key"]
        assert cells["unit"] == r["unit"]
    # bounds stand beside the figure they are of
    assert missing
    assert all(k.endswith(("_low", "_high")) for k in missing)
    for name in ("consistency_gps_chi2_per_dof", "gps_nis_each_value"):
        stem = name.removesuffix("_chi2_per_dof").removesuffix("_value")
        assert shown[name]["95 % bounds"] == f"{m[f'{stem}_low']:.3g} to {m[f'{stem}_high']:.3g}"
    assert shown["pose_rmse"]["direction"] == "lower is better"
    assert shown["nees_per_dof"]["direction"] == "1 is consistent"
    assert "times_real_time" in times


def test_graph_records_and_evidence(folder: Path, whole: Page) -> None:
    report, page = json.loads((folder / "run.json").read_text()), whole
    rows = {r["class of factor"]: r for r in page.table("graph", "class of factor").records()}
    for c in report["graph"]["classes"]:
        r = rows[c["class"]]
        assert (r["factors"], r["verdict"]) == (str(c["factors"]), c["verdict"])
        assert r["χ²/dof"] == f"{c['chi2_per_dof']:.6g}"
        assert float(r["95 % from"]) == pytest.approx(c["low"], rel=1e-5)
    assert set(rows) == {"submap", "gps"}
    read_ = {r["stream"]: r for r in page.table("records", "stream", "used").records()}
    assert {k: int(r["records"]) for k, r in read_.items()} == report["records_read"]
    spent = {(r["stream"], r["used by"]): r for r in page.table("evidence", "used by").records()}
    assert set(spent) == {
        ("controls", "submap"),
        ("landmarks", "submap"),
        ("gps", "GPS fix"),
        ("-", "path of submap"),
    }
    assert spent["gps", "GPS fix"]["factors"] == rows["gps"]["factors"]
    assert read_["gps"]["used"] == f"in {rows['gps']['factors']} factors"
    assert "Metadata of the log" in page.sections["run"]
    assert "particles = 20" in page.sections["run"]


def test_the_same_run_gives_the_same_page_but_for_times(log: SensorLog, folder: Path, tmp_path: Path) -> None:
    again = finished(log, tmp_path / "elsewhere" / "run")
    pages = [(p / PAGE).read_text(encoding="utf-8") for p in (folder, again)]
    assert pages[0] != pages[1]
    cut = [re.sub(r'<section id="times">.*?</section>', "", p, flags=re.S) for p in pages]
    assert cut[0] == cut[1]
    assert all(len(c) < len(p) for c, p in zip(cut, pages))
    assert str(folder.parent) not in pages[0]


def test_an_interrupted_run_says_where_it_stopped(copy: Path) -> None:
    index = json.loads((copy / "submaps" / "index.json").read_text())
    index["submaps"] = index["submaps"][:3]
    index["count"] = 3
    (copy / "submaps" / "index.json").write_text(json.dumps(index))
    for p in copy.iterdir():
        if p.name not in ("config.toml", "submaps"):
            shutil.rmtree(p) if p.is_dir() else p.unlink()
    page = read(copy)
    until = index["submaps"][-1]["interval"][1]
    assert page.verdict[0][0] == "bad"
    assert f"after submap 2 (3 submaps, 0.00 s to {until:.2f} s of the log)" in page.verdict[0][1]
    assert "--resume" in page.verdict[1][1]
    for name in ("figures", "records", "metrics", "graph", "loops", "evidence", "events", "times"):
        assert "Missing: " in page.sections[name], name
    assert not page.sources
    shutil.rmtree(copy / "submaps")
    assert "before the first submap" in read(copy).verdict[0][1]


@pytest.mark.parametrize(
    ("name", "part"),
    [
        ("metrics.json", "metrics"),
        ("events.jsonl", "events"),
        ("events.jsonl", "loops"),
        ("ledger.csv", "evidence"),
        ("config.toml", "run"),
        ("map.npz", "figures"),
        ("figures/map.png", "figures"),
    ],
)
@pytest.mark.parametrize("how", ["gone", "damaged"])
def test_what_is_gone_or_damaged_is_named(copy: Path, whole: Page, name: str, part: str, how: str) -> None:
    file = copy / name
    if how == "gone":
        file.unlink()
    else:
        file.write_bytes(file.read_bytes()[:40] + b"\n{")
    found = make_report(copy)
    page = checked(found.html)
    assert "Missing: " in page.sections[part]
    assert page.sections[part] != whole.sections[part]
    if how == "damaged" or name != "figures/map.png":
        assert name in found.problems
        assert name in page.sections["missing"]
        assert str(copy) not in found.html
    also = {"metrics.json": {"graph", "times"}, "events.jsonl": {"loops", "events"}, "ledger.csv": {"records"}}
    others = set(PARTS) - {part} - also.get(name, set())
    assert all(page.sections[k] == whole.sections[k] for k in others)


@pytest.mark.parametrize("name", ["map.npz", "metrics.json", "submaps/000001.npz"])
def test_a_damaged_result_is_the_headline(copy: Path, name: str) -> None:
    """The page of a run whose map or submaps are lost does not say that the result can be used."""
    if name == "submaps/000001.npz":
        (copy / name).unlink()
    else:
        (copy / name).write_bytes(b"PK")
    assert read(copy).headline.startswith("Wrong: do not rely on this")
    assert "copy the whole folder again" in read(copy).headline
    done = CliRunner().invoke(app, ["report", str(copy), "--out", str(copy.parent / "page.html")])
    assert done.exit_code == 1
    assert "the result is damaged" in str(done.exception)


def test_values_of_a_wrong_kind_are_no_crash(copy: Path) -> None:
    with (copy / "events.jsonl").open("a") as stream:
        stream.write('{"event": "loop", "loop": 1, "verdict": "accepted", "why": "", "i": 0, "j": 1, "chi2": "x"}\n')
        stream.write('{"event": "match-not-used", "support": "much"}\n')
    report = json.loads((copy / "run.json").read_text())
    odd = {"seconds": "long", "graph": [1], "records_read": None, "flagged_submaps": {"any": "x"}, "versions": 3}
    (copy / "run.json").write_text(json.dumps(report | odd))
    (copy / "metrics.json").write_text('[{"key": 3, "value": "x"}, {}, {"key": "gap", "value": true}]')
    page = read(copy)
    assert "events.jsonl" in page.sections["missing"]
    assert "versions" in page.sections["run"]


def test_text_of_files_is_escaped(copy: Path) -> None:
    report = json.loads((copy / "run.json").read_text())
    report |= {"source": HOSTILE, "map_left_out": HOSTILE, "certificate": HOSTILE}
    report["records_dropped"] = {HOSTILE: 3}
    report["source_meta"] = {HOSTILE: {HOSTILE: [HOSTILE]}}
    (copy / "run.json").write_text(json.dumps(report))
    (copy / "config.toml").write_text(f"[run]\nsource = {json.dumps(HOSTILE)}\n{json.dumps(HOSTILE)} = 1\n")
    rows = json.loads((copy / "metrics.json").read_text())
    rows.append({"key": HOSTILE, "value": 1.0, "unit": HOSTILE, "direction": HOSTILE})
    (copy / "metrics.json").write_text(json.dumps(rows))
    event = {"event": HOSTILE, HOSTILE: HOSTILE, "bad": "\u0000"}
    match = {"event": "match-not-used", "submap": 1, "target": 0, "fitness": 0.5, "support": 0.1, "why": HOSTILE}
    with (copy / "events.jsonl").open("a") as stream:
        stream.write(f"{json.dumps(event)}\n{json.dumps(match)}\n")
    ledger = (copy / "ledger.csv").read_text()
    (copy / "ledger.csv").write_text(ledger + f'9,"{HOSTILE.replace(chr(34), "")}",s,0,1,odd,"{"<img src=x>"}"\n')
    (copy / "figures" / "<img onerror='x'>.png").write_bytes((copy / "figures" / "map.png").read_bytes())
    file = write_report(copy)
    page = Page(file.read_text(encoding="utf-8"))
    page.check_alone()
    for part in ("run", "records", "metrics", "evidence", "events"):
        assert "<script>alert(1)</script>" in page.sections[part] or part == "evidence", part
    assert "<img src=x>" in page.sections["evidence"]
    assert "<img onerror='x'>" in page.sections["figures"]
    assert "\ufffd" in page.sections["events"]


def test_the_command_line(copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = (copy / PAGE).read_bytes()
    (copy / PAGE).unlink()
    done = CliRunner().invoke(app, ["report", str(copy)])
    assert done.exit_code == 0, done.output
    assert str(copy / PAGE) in done.stdout
    assert (copy / PAGE).read_bytes() == before
    (copy / "current" / "ledger.csv").unlink()
    out = tmp_path / "page.html"
    printed = json.loads(CliRunner().invoke(app, ["report", str(copy), "--out", str(out), "--json"]).stdout)
    assert printed["page"] == str(out)
    assert printed["bytes"] == out.stat().st_size
    assert list(printed["missing"]) == ["ledger.csv"]
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda url: bool(opened.append(url)) or True)
    assert CliRunner().invoke(app, ["report", str(copy), "--open"]).exit_code == 0
    assert opened == [(copy / PAGE).resolve().as_uri()]


def test_what_is_no_run_is_refused(tmp_path: Path, copy: Path) -> None:
    with pytest.raises(RunFolderError, match="not a run folder"):
        make_report(tmp_path / "nothing")
    with pytest.raises(RunFolderError, match="not a run folder"):
        make_report(copy / "submaps")
    with pytest.raises(OutputError, match="there is no folder"):
        write_report(copy, tmp_path / "no" / "such" / "folder.html")


def test_two_sessions_in_one_map(log: SensorLog, tmp_path: Path) -> None:
    a, b = log.interval
    parts = [log.slice(a, 0.5 * (a + b)), log.slice(0.5 * (a + b), b)]
    runs = [gs.run(p, out=tmp_path / f"{k}", solver="batch", progress=False) for k, p in enumerate(parts)]
    merged = gs.merge(runs, out=tmp_path / "both")
    text = (tmp_path / "both" / PAGE).read_text(encoding="utf-8")
    page = Page(text)
    page.check_alone()
    rows = page.table("run", "session", "submaps").records()
    assert [r["session"] for r in rows] == [s.name for s in merged.sessions]
    assert [int(r["submaps"]) for r in rows] == [len(s.keys) for s in merged.sessions]
    assert page.verdict[0][0] == "good"
    (kind,) = page.table("graph", "class of factor").records()
    assert float(kind["χ²"]) == pytest.approx(merged.solution.objective, rel=1e-5)
    n = len(merged.solution.landmark_ids)
    free = 3 * (len(merged.solution.poses) - 1) + 2 * n
    assert float(kind["scalars"]) - float(kind["dof"]) == pytest.approx(free, rel=1e-4)
    assert len(page.sources) == 1
    assert "landmark-field-2/" in page.sections["evidence"]
    report = json.loads((tmp_path / "both" / "merge.json").read_text())
    report["sessions"][1] |= {"common_landmarks": 2, "rejected": 30}
    (tmp_path / "both" / "merge.json").write_text(json.dumps(report))
    again = read(tmp_path / "both")
    assert any(k == "bad" and "30 do not" in t for k, t in again.verdict)
    assert np.isfinite(merged.solution.objective)
