"""Studies: one table from any executor, after any kill; failures are kept; a folder refuses another study."""

from __future__ import annotations

import inspect
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import graphslam as gs
from graphslam.app.folders.output_files import OutputFiles
from graphslam.core.errors import ConfigError, FormatError, GraphSlamError, RunFolderError, UnknownNameError
from graphslam.core.plugins import plugins
from graphslam_studies.montecarlo.definition import find_study, fingerprint, source_digest
from graphslam_studies.montecarlo.folder import TABLE_COLUMNS, StudyFolder
from graphslam_studies.montecarlo.study import Study, markdown_table, open_study, study
from graphslam_studies.montecarlo.trials import Measurement, run_trials, trial_seed
from tests.pictures import full_pictures
from tests.reference import small_study
from tests.reference.trials import steady

ROOT = Path(__file__).resolve().parents[2]
SMALL = "tests.reference.small_study:STUDY"
FRAGILE = "tests.reference.small_study:FRAGILE"
KILLED = 16
"""Trials of a study that is killed: more than are done until the last kill."""


def command(*args: object) -> list[str]:
    return [sys.executable, "-m", "graphslam", "study", *map(str, args)]


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}


def table_bytes(folder: Path) -> bytes:
    return (folder / "table.csv").read_bytes()


def trial_files(folder: Path) -> list[Path]:
    return sorted(folder.glob("trials/*/*.npz"))


def gone(group: int) -> bool:
    """Does the process group end, the helper of multiprocessing too, which follows its parent a moment later?"""
    deadline = time.monotonic() + 10.0
    while time.monotonic() < deadline:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.02)
    return False


@pytest.fixture(scope="module")
def serial(tmp_path_factory) -> Study:
    """Four runs of two worlds, in this process."""
    with full_pictures():
        return study(SMALL, 4, out=tmp_path_factory.mktemp("serial"), seed=5, progress=False)


def test_table_is_what_the_trials_gave(serial: Study) -> None:
    assert tuple(serial.table.columns) == TABLE_COLUMNS
    assert serial.runs == {"near": 4, "fine": 4}
    assert serial.worlds == ("near", "fine")
    assert serial.failures.empty
    for world in serial.worlds:
        direct = run_trials(small_study.STUDY.trial(world, False), 4, seed=5, progress=False)
        kept = serial.table[serial.table["world"] == world]
        by = ["run", "algorithm", "quantity", "submap"]
        a = direct.sort_values(by, ignore_index=True)
        pd.testing.assert_frame_equal(a, kept[list(a.columns)].sort_values(by, ignore_index=True), check_dtype=False)
    assert set(serial.timings["quantity"]) == {"seconds_total", "seconds_cumulative"}
    assert not set(serial.table["quantity"]) & set(serial.timings["quantity"])


def test_csv_reads_back_to_the_last_bit(serial: Study) -> None:
    read = pd.read_csv(serial.folder.path / "table.csv", float_precision="round_trip")
    assert np.array_equal(read["value"].to_numpy(), serial.table["value"].to_numpy())
    assert read["quantity"].tolist() == serial.table["quantity"].tolist()
    keys = ["world", "run", "algorithm", "quantity", "submap"]
    assert serial.table.sort_values(keys, ignore_index=True).equals(serial.table)


@pytest.mark.parametrize("workers", [1, 2])
def test_processes_give_the_same_bytes(serial: Study, tmp_path: Path, workers: int) -> None:
    study(SMALL, 4, out=tmp_path, seed=5, workers=workers, progress=False)
    assert table_bytes(tmp_path) == table_bytes(serial.folder.path)


def test_a_dask_cluster_gives_the_same_bytes(serial: Study, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=logging.ERROR
    ) as cluster:
        study(SMALL, 4, out=tmp_path, seed=5, workers=cluster.scheduler_address, progress=False)
    assert table_bytes(tmp_path) == table_bytes(serial.folder.path)


def test_another_seed_gives_other_bytes(serial: Study, tmp_path: Path) -> None:
    study(SMALL, 4, out=tmp_path, seed=6, progress=False)
    assert table_bytes(tmp_path) != table_bytes(serial.folder.path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Study:
    """One world, without an interruption."""
    return study(SMALL, KILLED, out=tmp_path_factory.mktemp("whole"), worlds=["near"], seed=5, progress=False)


@pytest.mark.parametrize(("workers", "kills"), [(None, 2), (2, 2)])
def test_kills_and_a_resume_give_the_bytes_of_an_uninterrupted_study(
    whole: Study, tmp_path: Path, workers: int | None, kills: int
) -> None:
    """SIGKILL with trials under way, at moments that no code chose."""
    options = [
        "--trials",
        KILLED,
        "--worlds",
        "near",
        "--seed",
        5,
        *([] if workers is None else ["--workers", workers]),
    ]
    out, counts = tmp_path / "killed", []
    rng = np.random.default_rng(3)
    for _ in range(kills):
        before, deadline = len(trial_files(out)), time.monotonic() + 120
        process = subprocess.Popen(
            command(SMALL, *options, "--out", out, "--json"),
            env=environment(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        while process.poll() is None and len(trial_files(out)) <= before and time.monotonic() < deadline:
            time.sleep(0.002)
        time.sleep(float(rng.uniform(0.0, 0.2)))
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        assert process.returncode == -signal.SIGKILL, "the study had ended before the kill"
        counts.append(len(trial_files(out)))
    assert 0 < counts[0] < counts[-1] < KILLED
    assert counts == sorted(set(counts))  # every call got on
    done = subprocess.run(
        command(SMALL, *options, "--out", out, "--json"), env=environment(), capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["runs"] == {"near": KILLED}
    assert table_bytes(out) == table_bytes(whole.folder.path)
    assert not list(out.rglob("*.part"))


def test_ctrl_c_writes_what_is_done_and_leaves_no_worker(tmp_path: Path) -> None:
    out = tmp_path / "stopped"
    process = subprocess.Popen(
        command(SMALL, "--trials", 400, "--workers", 2, "--out", out),
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # a job in the background of a shell has Ctrl-C ignored, and hands that on
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 120
    while process.poll() is None and len(trial_files(out)) < 3 and time.monotonic() < deadline:
        time.sleep(0.01)
    group = process.pid  # it leads a session of its own
    os.killpg(group, signal.SIGINT)  # as a terminal does: to the workers too
    _, errors = process.communicate(timeout=60)
    assert process.returncode in (1, 130), errors  # the command-line library's habit, or ours
    assert "stopped; writing what is done" in errors
    assert "Traceback" not in errors
    assert "leaked" not in errors
    assert gone(group)
    done = pd.read_csv(out / "table.csv")
    assert 3 <= len(done.groupby(["world", "run"])) == len(trial_files(out)) < 800
    assert "| near |" in (out / "report.md").read_text()


def test_finished_trials_are_not_run_again_and_more_can_be_asked_for(serial: Study, tmp_path: Path) -> None:
    first = study(SMALL, 2, out=tmp_path, seed=5, worlds=["near"], progress=False)
    assert first.runs == {"near": 2}
    stamps = {p: p.stat().st_mtime_ns for p in trial_files(tmp_path)}
    study(SMALL, 4, out=tmp_path, seed=5, progress=False)
    assert len(stamps) == 2
    assert all(p.stat().st_mtime_ns == t for p, t in stamps.items())
    assert table_bytes(tmp_path) == table_bytes(serial.folder.path)
    # asking for less takes nothing away
    assert study(SMALL, 1, out=tmp_path, seed=5, progress=False).runs == {"near": 4, "fine": 4}


def test_a_damaged_trial_is_run_again(serial: Study, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    shutil.copytree(serial.folder.path, tmp_path, dirs_exist_ok=True)
    victims = trial_files(tmp_path)[:3]
    victims[0].write_bytes(victims[0].read_bytes()[:200])
    victims[1].write_bytes(b"")
    victims[2].write_bytes(trial_files(tmp_path)[5].read_bytes())  # whole, but of another trial
    with caplog.at_level(logging.WARNING):
        again = study(SMALL, 4, out=tmp_path, seed=5, progress=False)
    assert sum("passed over" in r.message for r in caplog.records) == 3
    assert again.runs == {"near": 4, "fine": 4}
    assert table_bytes(tmp_path) == table_bytes(serial.folder.path)


def test_a_failed_trial_and_a_dead_worker_are_reported_and_the_rest_goes_on(tmp_path: Path) -> None:
    done = subprocess.run(
        command(FRAGILE, "--trials", 6, "--workers", 2, "--out", tmp_path, "--json"),
        env=environment(),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 1
    value = json.loads(done.stdout)
    assert value["runs"] == {"one": 4}
    errors = {f["run"]: f["error"] for f in value["failures"]}
    assert errors == {1: "ValueError: no | convergence", 2: "its worker process died (signal 9)"}
    assert [f["seed"] for f in value["failures"]] == [trial_seed(0, 1), trial_seed(0, 2)]
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("graphslam: 2 trials failed, first one/1")
    report = (tmp_path / "report.md").read_text()
    assert "Failed trials: 2" in report
    assert r"ValueError: no \| convergence" in report
    assert set(pd.read_csv(tmp_path / "table.csv")["run"]) == {0, 3, 4, 5}


def test_failed_trials_are_tried_again_by_the_next_call(tmp_path: Path) -> None:
    first = study(FRAGILE, 3, quick=True, out=tmp_path, progress=False)
    assert first.failures["run"].tolist() == [1]
    folder = StudyFolder(tmp_path)
    (failed,) = [t for t in folder.trials() if t.error]
    assert "fragile_trial" in (failed.details or "")
    before = folder.trial_path("one", 1).stat().st_mtime_ns
    good = folder.trial_path("one", 0).stat().st_mtime_ns
    again = study(FRAGILE, 3, quick=True, out=tmp_path, progress=False)
    assert again.failures["run"].tolist() == [1]
    assert folder.trial_path("one", 1).stat().st_mtime_ns > before
    assert folder.trial_path("one", 0).stat().st_mtime_ns == good


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"seed": 6}, "seed was 5 and is 6"),
        ({"quick": True}, "quick was False and is True"),
        ({"name": "tests.reference.small_study:LONGER"}, "name was"),
    ],
)
def test_a_folder_refuses_another_study(serial: Study, change: dict, says: str) -> None:
    options = {"name": SMALL, "seed": 5, **change}
    before = table_bytes(serial.folder.path)
    with pytest.raises(RunFolderError, match=says):
        study(options.pop("name"), 4, out=serial.folder.path, progress=False, **options)
    assert table_bytes(serial.folder.path) == before


def test_a_changed_configuration_or_library_is_refused(serial: Study, tmp_path: Path) -> None:
    identity = serial.identity
    for _ in range(2):
        with StudyFolder.start(tmp_path, identity):
            pass
    other = fingerprint(small_study.LONGER.trial("near", False))
    changed = {**identity, "worlds": {**identity["worlds"], "near": other}}
    with pytest.raises(RunFolderError, match=r"worlds\.near was"), StudyFolder.start(tmp_path, changed):
        pass
    changed = {**identity, "versions": {**identity["versions"], "numpy": "0.1"}}
    says = r"versions\.numpy was '[\d.]+' and is '0.1'"
    with pytest.raises(RunFolderError, match=says), StudyFolder.start(tmp_path, changed):
        pass


def test_a_folder_of_something_else_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(RunFolderError, match="not empty and not a study"):
        study(SMALL, 1, out=tmp_path, progress=False)
    (tmp_path / "study.json").write_text("{")
    with pytest.raises(FormatError, match="truncated"):
        study(SMALL, 1, out=tmp_path, progress=False)
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def test_code_that_changed_between_trials_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graphslam_studies.montecarlo.study.source_digest", lambda: "another day")
    study(FRAGILE, 1, quick=True, out=tmp_path, progress=False)
    monkeypatch.undo()
    assert "code was changed" not in (tmp_path / "report.md").read_text()
    study(FRAGILE, 4, quick=True, out=tmp_path, progress=False)
    assert "run by 2 versions" in (tmp_path / "report.md").read_text()
    assert source_digest() == source_digest() != "another day"


def test_wrong_use_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="did you mean combined-slam"):
        study("combined-slm", out=tmp_path)
    with pytest.raises(ConfigError, match="cannot be loaded"):
        study("no.such.module:STUDY", out=tmp_path)
    with pytest.raises(ConfigError, match="is no study"):
        study("graphslam_studies.montecarlo.study:Study", out=tmp_path)
    with pytest.raises(UnknownNameError, match="unknown world 'nar'; did you mean near"):
        study(SMALL, out=tmp_path, worlds=["nar"])
    with pytest.raises(ConfigError, match="0 trials"):
        study(SMALL, 0, out=tmp_path)
    with pytest.raises(ConfigError, match="0 workers"):
        study(SMALL, 1, out=tmp_path / "w", workers=0)
    assert not list(tmp_path.glob("*.csv"))


def test_fingerprints_follow_the_configuration_and_nothing_else() -> None:
    trial = small_study.STUDY.trial("near", False)
    assert fingerprint(trial) == fingerprint(small_study.STUDY.trial("near", False))
    others = [small_study.LONGER.trial("near", False), small_study.STUDY.trial("fine", False), steady]
    assert len({fingerprint(f) for f in [trial, *others]}) == 4
    a, b = partial(steady, x=np.arange(3.0)), partial(steady, x=np.arange(3.0) + 1e-12)
    assert fingerprint(a) != fingerprint(b)
    assert fingerprint(partial(steady, s={"a", "b", "c"})) == fingerprint(partial(steady, s={"c", "b", "a"}))
    with pytest.raises(ConfigError, match="no fingerprint"):
        fingerprint(partial(steady, x=object()))


def test_trial_files_hold_no_pickles_and_keep_odd_numbers(tmp_path: Path) -> None:
    with StudyFolder.start(tmp_path, {"name": "x"}) as folder:
        pass
    odd = [np.nan, np.inf, -np.inf, 5e-324, -0.0, 1e308, 0.1 + 0.2]
    folder.write_trial("w", 3, 2**62 + 1, [Measurement("α", "q", v, k) for k, v in enumerate(odd)])
    with np.load(folder.trial_path("w", 3), allow_pickle=False) as arrays:
        assert all(arrays[name].dtype != object for name in arrays.files)
    found = folder.collect()
    np.testing.assert_array_equal(found.table["value"], odd)
    (t,) = folder.trials()
    assert (t.world, t.run, t.seed, t.error) == ("w", 3, 2**62 + 1, None)
    OutputFiles(tmp_path).write_table("t.csv", found.table)
    read = pd.read_csv(tmp_path / "t.csv", float_precision="round_trip")
    np.testing.assert_array_equal(read["value"], odd)
    assert read["algorithm"].tolist() == ["α"] * len(odd)


def test_a_study_is_read_back_shows_itself_and_draws(serial: Study, tmp_path: Path) -> None:
    opened = open_study(serial.folder.path, serial.definition)
    pd.testing.assert_frame_equal(opened.table, serial.table)
    assert repr(opened) == "Study('small': runs near: 4, fine: 4; 0 failed)"
    page = opened._repr_html_()
    assert "World near" in page
    assert '<td>near</td><td class="n">4</td>' in page
    with pytest.raises(UnknownNameError, match="finished world 'far'"):
        opened.plot_consistency(world="far")
    assert opened.plot_consistency(world="fine").get_ylabel()
    assert len(opened.plot_errors("batch")) == 3
    assert opened.plot_time().get_ylabel()
    assert len(opened.plot_rms()) == 3
    report = (serial.folder.path / "report.md").read_text()
    assert "## World fine" in report
    assert "![ci-near](figures/ci-near.png)" in report
    assert (serial.folder.path / "figures" / "ci-near.png").stat().st_size > 5_000


def test_the_verb_is_exported() -> None:
    """With the same arguments; it calls what is installed beside it."""
    for offered, called in ((gs.study, study), (gs.open_study, open_study), (gs.find_study, find_study)):
        there, here = (inspect.signature(f).parameters.values() for f in (offered, called))
        assert [(p.name, p.default, p.kind) for p in there] == [(p.name, p.default, p.kind) for p in here]
    assert gs.find_study("charts") is find_study("charts")
    assert {"study", "open_study", "find_study"} <= set(dir(gs))


def test_registered_studies_are_found_by_name() -> None:
    for name in plugins("graphslam.studies"):
        found = find_study(name)
        assert found.name == name
        for quick in (True, False):
            assert found.worlds(quick)
            assert found.default_trials(quick) >= 1
            prints = {fingerprint(found.trial(w, quick)) for w in found.worlds(quick)}
            assert len(prints) == len(found.worlds(quick))


def test_markdown_by_hand() -> None:
    frame = pd.DataFrame({"a|b": ["x|y\nz", None], "v": [1.23456, np.nan], "n": [3, 4]})
    assert markdown_table(frame.rename(columns={"a|b": "a"})).splitlines() == [
        "| a | v | n |",
        "| --- | --- | --- |",
        r"| x\|y z | 1.235 | 3 |",
        "| - | - | 4 |",
    ]


def test_errors_are_of_the_family() -> None:
    assert issubclass(RunFolderError, GraphSlamError)
