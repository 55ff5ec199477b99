"""A run of a front end with grids ends with a fused map, and its folder gives the same map again."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graphslam.app.hypotheses import minimum_entropy_loops, minimum_entropy_topology
from graphslam.app.run import config as cfg
from graphslam.app.run.maps import sensor_reach
from graphslam.app.run.outputs import read_run_folder
from graphslam.app.run.pipeline import run
from graphslam.app.run.remake_map import map_of_folder
from graphslam.app.run.run import Run
from graphslam.app.worlds import simulate
from graphslam.backend.config import BackEndConfig
from graphslam.backend.hypotheses import choices_of_matches, solve_choice
from graphslam.core.config import build_config, read_toml
from graphslam.core.control import control_lines
from graphslam.core.errors import ConfigError, DataError, MissingDataError
from graphslam.core.poses import SE3, remove_roll_pitch
from graphslam.core.submap import Match
from graphslam.evidence.formats import load_npz
from graphslam.graph.factors.control import ControlRecord
from graphslam.io.log_store import save_log
from graphslam.io.tum import read_tum
from graphslam.maps.fuse import fuse_pieces
from graphslam.maps.run_map import RunMap, floor_bands, make_run_map, nodes_by_submap
from graphslam.sim.crawler import simulate_crawler
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.ring_hall import ring_hall
from tests.app.cli.test_cli import graphslam, refused
from tests.reference.small_maps import same_map
from tests.reference.surveyed import surveyed


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """SegSLAM of three particles in the small court, twice round a corner, by its preset."""
    log = simulate_crawler(ring_hall(seed=9), 9, CrawlerConfig(drift=0.08, max_range=8.0))
    options = {"frontend": {"filter": {"particles": 3}}, "refine": {"use": False}}  # it is the map of the graph
    out = tmp_path_factory.mktemp("run") / "run"
    return run(log, frontend="segslam", seed=2, out=out, config=options, progress=False)


def test_folder_holds_the_map_its_plans_and_pictures(finished: Run) -> None:
    assert finished.folder is not None
    assert finished.fused is not None
    names = {p.name for p in finished.folder.iterdir()}
    assert {"map.ply", "map.bt", "map-level0.pgm", "map-level0.yaml", "fused_map.json"} <= names
    figures = {p.name for p in (finished.folder / "figures").iterdir()}
    assert {"map.png", "fused_level0.png", "fused_above.png", "fused_cut.png"} <= figures
    facts = json.loads((finished.folder / "fused_map.json").read_text())
    assert facts["pieces"] == len(finished.fused.fused) > 2 * len(finished.submaps)
    assert facts["entropy"] == finished.metric("map_entropy") == finished.fused.fused.grid.entropy()
    assert finished.metric("map_known_volume") > 100
    assert finished.metric("seconds_map") > 0
    assert finished.metric("seconds_total") > finished.metric("seconds_map") + finished.metric("seconds_frontend")
    ((low, high),) = facts["bands"].values()
    assert (low, high) == pytest.approx((0.3, 1.8), abs=0.3)


def test_pieces_stand_at_the_nodes_of_the_graph(finished: Run) -> None:
    """From the graph itself, not through the tables of the map."""
    assert finished.fused is not None
    assert finished.graph is not None
    divided, wanted = finished.fused.divided, finished.fused.fused.wanted
    poses = finished.graph.values.poses
    seen = 0
    for s in finished.graph.submaps:
        for k, node in enumerate(s.nodes[:-1]):
            if (s.key, k) in divided.pieces:
                np.testing.assert_allclose(wanted[s.key, k], remove_roll_pitch(poses[node]), atol=1e-9)
                np.testing.assert_allclose(divided.local[s.key, k], remove_roll_pitch(s.T_base_node[k]), atol=1e-9)
                seen += 1
    assert seen == len(divided.pieces)


def test_without_a_loop_the_map_is_that_of_the_open_chain(finished: Run) -> None:
    """No matches and exits as they are: nothing moves, so the map is that of the chain."""
    bare = [replace(s, matches=()) for s in finished.submaps]
    assert finished.folder is not None
    values = read_toml(finished.folder / "config.toml")
    config = build_config(BackEndConfig, {**values["backend"], "level_sigma": 0.0})
    from graphslam.maps.global_map import make_global_map

    m = make_global_map(solve_choice(bare, frozenset(), config).finish(), bare, {}, 1)
    made = make_run_map(bare, m, reach=8.0)
    chain = fuse_pieces(made.divided.pieces, made.divided.poses, model=made.fused.grid.model)
    assert made.fused.entropy() == pytest.approx(chain.entropy(), rel=0.01)
    assert made.fused.known_volume() == pytest.approx(chain.known_volume(), rel=0.01)
    scratch = fuse_pieces(made.divided.pieces, made.fused.poses, model=made.fused.grid.model)
    assert same_map(made.fused.grid, scratch.grid)
    shifted = make_run_map(bare, replace(m, node_poses=_shifted(m.node_poses)), reach=8.0)
    assert shifted.fused.entropy() != pytest.approx(made.fused.entropy(), rel=1e-6)


def _shifted(poses: np.ndarray) -> np.ndarray:
    """The second half of the nodes a metre aside."""
    out = poses.copy()
    out[len(out) // 2 :, 1] += 1.0
    return out


def test_the_folder_gives_the_same_map_again(finished: Run, tmp_path: Path) -> None:
    assert finished.folder is not None
    assert finished.fused is not None
    folder = tmp_path / "run"
    shutil.copytree(finished.folder, folder)
    before = {p.name: p.read_bytes() for p in folder.glob("map*") if p.suffix in (".ply", ".bt", ".pgm")}
    for p in folder.glob("map[.-]*"):
        if p.name != "map.npz":
            p.unlink()
    again, made = map_of_folder(folder)
    assert same_map(made.fused.grid, finished.fused.fused.grid)
    assert again.fused is made
    done = graphslam("map", folder, "--grid", "--minimum-entropy", "--json")
    assert done.returncode == 0, done.stderr
    value = json.loads(done.stdout)
    assert value["entropy"] == finished.fused.fused.entropy()
    assert {n: (folder / n).read_bytes() for n in before} == before
    assert same_map(load_npz(folder / "map.grid.npz"), finished.fused.fused.grid)
    assert all(Path(p).is_file() for p in (*value["files"], *value["figures"]))
    rows = value["candidates"]
    assert [r["verdict"] for r in rows] == ["chosen"] + ["runner-up"] * (len(rows) - 1)
    consistent = [r["entropy"] for r in rows if not r["contradicted"]]
    assert consistent == sorted(consistent)
    assert [r["contradicted"] for r in rows] == sorted(r["contradicted"] for r in rows)
    kept = json.loads((folder / "clearest.json").read_text())
    assert kept["why"] == value["chosen_because"] == rows[0]["why"]
    assert [{k: v for k, v in r.items() if k != "files"} for r in kept["candidates"]] == rows
    for r in kept["candidates"]:
        path, graph = (folder / f for f in r["files"])
        assert len(read_tum(path, dim=3)) == len(again.map.trajectory)
        assert graph.read_text().count("VERTEX_SE3") == len(again.map.node_poses)
    assert (folder / kept["candidates"][0]["files"][0]).read_bytes() == (folder / "clearest.tum").read_bytes()
    (own,) = [r for r in value["candidates"] if r["choice"] == "as the run"]
    assert own["entropy"] == pytest.approx(value["entropy"], rel=1e-3)
    higher = graphslam("map", folder, "--low", "1.0", "--high", "0.5")
    assert higher.returncode == 1
    assert "low < high" in higher.stderr


def test_control_rows_hold_every_alternative_and_check_rows_test_the_chosen_one(finished: Run, tmp_path: Path) -> None:
    assert finished.folder is not None
    assert finished.truth_path is not None
    folder = tmp_path / "run"
    shutil.copytree(finished.folder, folder)
    path, rng = finished.truth_path, np.random.default_rng(1)
    a, b = (float(f(path.times)) for f in (np.min, np.max))
    lines = []
    for name, n in (("control", 4), ("check", 9)):
        times = np.linspace(a + 2.0, b - 2.0, n).tolist()
        rows = surveyed(zip(times, path.interpolate(np.array(times))[:, :3]), rng, 0.02)
        lines.append(f'{name} = {{ source = "rows", rows = {json.dumps(control_lines(rows)["rows"])} }}')
    config = folder / "config.toml"
    config.write_text(config.read_text().replace("[run]\n", "\n".join(["[run]", *lines, ""]), 1))
    done = graphslam("map", folder, "--minimum-entropy", "--json")
    assert done.returncode == 0, done.stderr
    texts = {f["code"]: f["text"] for f in json.loads(done.stdout)["findings"]}
    assert "4 rows used; their frame (survey)" in texts["control-points"]
    assert "m at 9 rows" in texts["check-points"]
    assert json.loads((folder / "clearest.json").read_text())["findings"] == json.loads(done.stdout)["findings"]
    found = minimum_entropy_loops(*map_of_folder(folder), progress=False)
    for j in found.choice.order:
        held = [r for r in j.alternative.graph.records.values() if isinstance(r, ControlRecord)]
        assert len(held) == 4
    ranked = minimum_entropy_topology(read_run_folder(folder), 2, log=finished.log, progress=False)
    assert {f.code for f in ranked.findings} >= {"control-points"}
    with pytest.raises(MissingDataError, match="only its folder holds"):
        minimum_entropy_loops(
            replace(finished, folder=None, report={**finished.report, "control_points": {}}), found_map(finished)
        )


def found_map(run: Run) -> RunMap:
    assert run.fused is not None
    return run.fused


def test_every_choice_of_matches_is_solved_before_it_is_ranked(finished: Run) -> None:
    assert finished.folder is not None
    again, made = map_of_folder(finished.folder)
    a, b = again.submaps[0], again.submaps[-1]
    wrong = Match(target=a.key, T_target_here=SE3.identity, covariance=1e-4 * np.eye(6), fitness=0.9, support=0.2)
    submaps = [*again.submaps[:-1], replace(b, matches=(*b.matches, wrong))]
    choices = choices_of_matches(submaps, 0.5)
    assert choices["as the run"] == choices_of_matches(again.submaps, 0.5)["as the run"]
    assert len(set(choices.values())) == len(choices)
    found = minimum_entropy_loops(replace(again, submaps=submaps), made, progress=False)
    table = found.choice.rows()
    assert len(table) == len(choices)
    rows = {r["choice"]: r for r in table}
    last = (b.key, len(b.matches))
    bent = [name for name, chosen in choices.items() if last in chosen]
    assert bent
    assert table[0]["choice"] not in bent
    assert all(rows[name]["objective"] > rows["as the run"]["objective"] + 20 for name in bent)
    assert all(rows[name]["contradicted"] and "contradicted" in rows[name]["why"] for name in bent)
    # under its kernel a wrong match hardly counts; what is judged is the match without it
    assert all(rows[name]["chi2"] > 2 * rows[name]["objective"] for name in bent)


def test_topologies_of_the_particles_become_graphs(finished: Run, tmp_path: Path) -> None:
    """The log is read once more: the chain that the run handed over, and the same without its entries."""
    assert finished.folder is not None
    assert finished.log is not None
    folder, log = tmp_path / "run", tmp_path / "log"
    shutil.copytree(finished.folder, folder)
    save_log(finished.log, log)
    done = graphslam("map", folder, "--hypotheses", "3", "--log", log, "--json")
    assert done.returncode == 0, done.stderr
    value = json.loads(done.stdout)
    rows = value["candidates"]
    assert 1 < len(rows) <= 3
    assert [r["verdict"] for r in rows] == ["chosen"] + ["runner-up"] * (len(rows) - 1)
    assert rows[0]["why"] == value["chosen_because"]
    (own,) = [r for r in rows if r["choice"] == "hypothesis 0"]
    assert (own["withdrawn"], own["submaps"]) == (None, len(finished.submaps))
    assert 0 < own["support"] <= 1
    entered = {(m.target, s.key) for s in finished.submaps for m in s.matches}
    withdrawn = {tuple(r["withdrawn"]) for r in rows if r["withdrawn"] is not None}
    assert withdrawn
    assert withdrawn <= entered
    kept = json.loads((folder / "clearest.json").read_text())["candidates"]
    for r in kept:
        path, graph = (folder / f for f in r["files"])
        assert read_tum(path, dim=3).times[-1] == finished.map.trajectory.times[-1]
        assert "EDGE_SE3" in graph.read_text()
    assert len({(folder / r["files"][0]).read_bytes() for r in kept}) == len(kept)
    assert "hypothesis 0" in (folder / "report.html").read_text()

    refused("map", folder, "--hypotheses", "2", "--minimum-entropy", "--log", log, saying="exclude each other")
    save_log(finished.log.slice(0.0, 20.0), tmp_path / "other")
    refused("map", folder, "--hypotheses", "2", "--log", tmp_path / "other", saying="not the log of the run")
    foreign = replace(finished, folder=tmp_path / "foreign")
    shutil.copytree(folder, tmp_path / "foreign")
    config = tmp_path / "foreign" / "config.toml"
    config.write_text(config.read_text().replace('frontend = "segslam"', 'frontend = "rbpf-grid"'))
    with pytest.raises(ConfigError, match="'rbpf-grid' tells one topology"):
        minimum_entropy_topology(foreign, 2, log=finished.log)


def test_runs_without_grids_are_as_before_and_say_so(tmp_path: Path) -> None:
    log = simulate("landmark-field", preset="quick", seed=2)
    r = run(log, out=tmp_path / "run", config={"frontend": {"particles": 20}}, progress=False)
    assert r.fused is None
    assert not any(k.startswith("map_") for k in r.metrics["key"])
    assert not list((tmp_path / "run").glob("map.ply"))
    refused("map", tmp_path / "run", saying="no evidence grids")
    refused("map", tmp_path, saying="not a finished run")


def test_what_does_not_belong_together_is_refused(finished: Run) -> None:
    with pytest.raises(DataError, match="not those of the submaps"):
        nodes_by_submap(finished.submaps[:-1], finished.map)
    with pytest.raises(MissingDataError, match=f"got {len(finished.submaps)} submaps without"):
        make_run_map([replace(s, grid=None) for s in finished.submaps], finished.map)
    with pytest.raises(ConfigError, match="low < high"):
        build_config(cfg.RunConfig, {"map": {"low": 2.0}})


def test_floor_plans_of_storeys_and_reach() -> None:
    x = np.linspace(0, 60, 241)
    z = np.interp(x, [0, 20, 35, 60], [0.0, 0.0, 3.5, 3.5])
    bands = floor_bands(np.column_stack([x, 0 * x, z]), cfg.MapConfig())
    assert list(bands) == ["level0", "level1"]
    np.testing.assert_allclose(list(bands.values()), [(0.3, 1.8), (3.8, 5.3)], atol=0.05)
    ramp = np.column_stack([x, 0 * x, 0.2 * x])
    assert list(floor_bands(ramp, cfg.MapConfig())) == ["level0"]
    assert sensor_reach({"frontend": {"steps": {"max_range": 25.0}}}) == 25.0
    assert sensor_reach({"frontend": {"steps": {"max_range": "none"}}}) is None
