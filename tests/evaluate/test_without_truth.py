"""χ² per class and withheld GPS: equal to slow twins, silent for consistent data, alarmed by a factor of two."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from graphslam.core.errors import DataError
from graphslam.core.geometry import se2_compose, se2_exp, se2_transform
from graphslam.core.random import SeedTree
from graphslam.core.records import Gps
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.gps_innovation import GpsInnovations, _arm_covariance, gps_innovations
from graphslam.evaluate.residual_consistency import class_consistency, correlated_dof, two_sided_bounds
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.noise import NO_KERNEL, RobustKernel
from graphslam.graph.sensors.gps import GpsConfig
from graphslam.sim.landmark_field import landmark_field_preset, simulate_landmark_field
from graphslam.solve.registry import make_solver
from graphslam_frontends.landmarks.rbpf_ekf import RbpfEkf, RbpfEkfConfig
from tests.reference.antenna import antenna_in_base
from tests.reference.compose_covariance import se2_compose_covariance
from tests.reference.graph_chain import make_chain
from tests.reference.hat_matrix import class_figures, numeric_jacobian


def fixes_of(chain, rng, times, *, sigma=0.3, lever=(0.5, 0.2)) -> Gps:
    """Noisy fixes on the true path of a chain, in a frame of their own."""
    points = []
    for t in times:
        k = min(int(t // 10), len(chain.submaps) - 1)
        T = chain.submaps[k].trajectory.interpolate(np.array([t]))[0]
        points.append(se2_transform(se2_compose(chain.poses[k], T), np.array(lever)))
    z = se2_transform(np.array([100.0, -20.0, 0.7]), np.array(points)) + sigma * rng.standard_normal((len(times), 2))
    return Gps(times=times, positions=z, sigma=np.full(len(times), sigma), lever=np.array(lever))


def solved_graph(rng, *, robust=NO_KERNEL, bias_sigma=None, m=6) -> tuple[FactorGraph, Gps]:
    """A small solved graph with every second fix in it, and the others."""
    chain = make_chain(rng, m=m, landmarks=12)
    gps = fixes_of(chain, rng, np.arange(0.5, 10.0 * m, 1.5))
    graph = FactorGraph()
    config = GpsConfig(robust=robust, baseline=5.0, bias_sigma=bias_sigma, segment_gap=4.0)
    graph.add_sensor(gps.take(slice(0, None, 2)), config=config)
    for s in chain.submaps:
        graph.add_submap(s)
    graph.finish_sensors()
    make_solver("batch", graph).solve_to_optimum()
    return graph, gps.take(slice(1, None, 2))


@pytest.mark.parametrize("robust", [NO_KERNEL, RobustKernel("cauchy", 1.0), RobustKernel("huber", 0.8)])
def test_leverage_and_dof_equal_the_dense_hat_matrix(rng, robust):
    graph, _ = solved_graph(rng, robust=robust)
    graph.add_between(
        1, 4, [1.0, 2.0, 0.3], np.diag([0.1, 0.2, 0.01]), evidence="shared-scan", group="match", robust=robust
    )
    make_solver("batch", graph).solve_to_optimum()
    got, slow = class_consistency(graph), class_figures(graph)
    assert set(got) == set(slow) == {"submap", "gps", "match"}
    for name, c in got.items():
        assert (c.leverage, c.dof, c.chi2) == pytest.approx(slow[name], rel=1e-5), name
    assert sum(c.leverage for c in got.values()) == pytest.approx(graph.flat().layout.size, rel=1e-9)
    if robust is NO_KERNEL:
        assert all(c.dof == pytest.approx(c.rows - c.leverage) and c.least_weight == 1.0 for c in got.values())
    else:
        assert got["match"].least_weight < 0.1  # the match is false, and the kernel says so
        assert got["match"].mean_weight == got["match"].least_weight


def test_biases_are_a_class_of_their_own(rng):
    graph, _ = solved_graph(rng, bias_sigma=0.5)
    got, slow = class_consistency(graph), class_figures(graph)
    for name, c in got.items():
        assert (c.leverage, c.dof, c.chi2) == pytest.approx(slow[name], rel=1e-5), name
    assert "gps-bias" in got


def test_prediction_of_a_withheld_fix_equals_the_dense_one(rng):
    """Path and datum by numeric derivatives of the prediction over the whole covariance; no local covariances here."""
    graph, withheld = solved_graph(rng)
    for s in graph.submaps:
        s.trajectory.covariances[:] = 0.0
    got = gps_innovations(graph, withheld)
    by_node = {s.node: s for s in graph.submaps}

    def predict(values):
        out = []
        for t in withheld.times:
            s = by_node[min(int(t // 10), len(graph.submaps) - 1)]
            arm, _ = antenna_in_base(s.trajectory, np.array([t]), withheld.lever)
            out.append(se2_transform(se2_compose(values.datum, values.poses[s.node]), arm[0]) + graph.gps_origin)
        return np.array(out).ravel()

    J = numeric_jacobian(predict, graph.values)
    S = J @ graph.covariance().full() @ J.T + 0.3**2 * np.eye(len(J))
    assert np.allclose(got.covariance, S, rtol=1e-5, atol=1e-9)
    assert np.allclose(got.innovations.ravel(), withheld.positions.ravel() - predict(graph.values), atol=1e-9)
    e = got.innovations.ravel()
    assert np.sum(got.whitened**2) == pytest.approx(e @ np.linalg.solve(S, e), rel=1e-6)
    own = got.innovations[3] @ np.linalg.solve(S[6:8, 6:8], got.innovations[3])
    assert got.nis[3] == pytest.approx(own, rel=1e-6)
    assert got.unpredicted == 0


def test_a_withheld_fix_is_predicted_as_if_it_were_added_with_no_weight(rng):
    """A fix of σ = 1 km in the graph changes nothing, and its factor's residual is the innovation."""
    graph, withheld = solved_graph(rng)
    got = gps_innovations(graph, withheld, sigma=0.3)
    before = graph.values.copy()
    graph.add_sensor(withheld, config=GpsConfig(sigma=1000.0, baseline=5.0))
    graph.finish_sensors()
    make_solver("batch", graph).solve_to_optimum()
    assert np.allclose(graph.values.poses, before.poses, atol=1e-4)
    after = {r.time: r for r in graph.records.values() if type(r).__name__ == "GpsRecord"}
    for t, nu in zip(got.times, got.innovations):
        r = after[t]
        where = se2_transform(se2_compose(before.datum, before.poses[r.node]), r.arm)
        assert np.allclose(r.z - where, nu, atol=1e-9)


def test_bias_of_a_segment_is_shared_and_a_new_segment_gets_a_new_one(rng):
    graph, withheld = solved_graph(rng, bias_sigma=0.5)
    with pytest.raises(DataError, match="biases"):
        gps_innovations(graph, withheld)
    near = gps_innovations(graph, withheld, bias_sigma=0.5, segment_gap=4.0)
    far = gps_innovations(graph, withheld, bias_sigma=0.5, segment_gap=0.1)  # each fix is a segment by itself
    assert np.all(np.linalg.eigvalsh(far.covariance) > 0)
    # all of one known bias: less uncertain than a fresh prior of 0.5 m for each
    assert np.all(np.trace(far.blocks, axis1=1, axis2=2) > np.trace(near.blocks, axis1=1, axis2=2) + 0.1)
    own = near.covariance[0:2, 2:4]
    other = far.covariance[0:2, 2:4]
    assert np.linalg.norm(own) > 0
    assert not np.allclose(own, other)
    late = Gps(
        times=withheld.times[:2], positions=withheld.positions[:2], sigma=withheld.sigma[:2], lever=withheld.lever
    )
    together = gps_innovations(graph, late, bias_sigma=0.5, segment_gap=4.0)
    assert np.allclose(together.covariance, near.covariance[:4, :4], atol=1e-12)


def test_new_biases_are_correlated_within_a_segment_only(rng):
    graph, withheld = solved_graph(rng)  # without biases in the graph, with a prior for what is withheld
    plain = gps_innovations(graph, withheld)
    one = gps_innovations(graph, withheld, bias_sigma=0.5, segment_gap=100.0)
    n = len(withheld.times)
    assert np.allclose(one.covariance - plain.covariance, np.kron(np.ones((n, n)), 0.25 * np.eye(2)), atol=1e-9)
    each = gps_innovations(graph, withheld, bias_sigma=0.5, segment_gap=0.1)
    assert np.allclose(each.covariance - plain.covariance, 0.25 * np.eye(2 * n), atol=1e-9)


def test_antenna_along_a_dead_reckoned_path_has_the_covariance_of_a_sample(rng):
    n, trials = 12, 20_000
    u, Q = np.array([1.0, 0.0, 0.15]), np.diag([0.02, 0.01, 0.02]) ** 2
    T = np.zeros((trials, n + 1, 3))
    P = np.zeros((n + 1, 3, 3))
    mean = np.zeros((n + 1, 3))
    for k in range(n):
        noise = se2_exp(rng.standard_normal((trials, 3)) * np.sqrt(np.diag(Q)))
        step = se2_compose(np.broadcast_to(u, (trials, 3)), noise)
        T[:, k + 1] = se2_compose(T[:, k], step)
        mean[k + 1] = se2_compose(mean[k], u)
        P[k + 1] = se2_compose_covariance(mean[k], P[k], u, Q)
    path, lever = Trajectory(np.arange(n + 1.0), mean, P), np.array([0.8, -0.3])
    at = np.array([2, 5, 6, 11])
    times = at.astype(float)
    got = _arm_covariance(path.interpolate(times), path.interpolate_covariance(times), lever)
    arms = se2_transform(T[:, at].reshape(-1, 3), np.broadcast_to(lever, (trials * 4, 2))).reshape(trials, 8)
    sample = np.cov(arms.T)
    scale = np.sqrt(np.diag(sample))
    assert np.abs((got - sample) / np.outer(scale, scale)).max() < 0.05
    assert np.abs(got[0:2, 6:8]).max() > 0.2 * np.abs(got[0:2, 0:2]).max()  # the ends are correlated


def test_correlated_squares_have_the_two_moments_that_the_bounds_use(rng):
    A = rng.standard_normal((12, 5))
    S = A @ A.T + 0.3 * np.eye(12)
    dof = correlated_dof(S, 3)
    e = (np.linalg.cholesky(S) @ rng.standard_normal((12, 40_000))).T.reshape(-1, 4, 3)
    own = np.array([S[k : k + 3, k : k + 3] for k in range(0, 12, 3)])
    q = np.einsum("tki,kij,tkj->t", e, np.linalg.inv(own), e)
    assert q.mean() == pytest.approx(12, rel=0.02)
    assert q.var() == pytest.approx(2 * 12**2 / dof, rel=0.05)
    assert correlated_dof(np.diag(np.arange(1.0, 13.0)), 3) == pytest.approx(12)
    low, high, verdict = two_sided_bounds(1.0, dof, 0.95)
    assert (verdict, low < 1 < high) == ("consistent", True)


def small_run(seed: int, scale: float, robust: RobustKernel) -> tuple[FactorGraph, Gps]:
    """A simulated loop through the front end and the graph; the estimators are told the noise of scale 1."""
    c = landmark_field_preset("quick", gps_rate=1.0, gps_sigma=0.5, laps=1.6, noise_scale=scale, gps_lever=(1.0, 0.3))
    log = simulate_landmark_field(c, seed)
    front = RbpfEkf(RbpfEkfConfig(association="known", particles=10, max_range=20.0))
    gps, graph = log["gps"], FactorGraph()
    used = np.arange(len(gps.times)) % 2 == 0
    graph.add_sensor(gps.take(used), config=GpsConfig(robust=robust))
    for s in front.submaps(log, seed=SeedTree(seed)):
        graph.add_submap(s)
    graph.finish_sensors()
    make_solver("batch", graph).solve_to_optimum()
    return graph, gps.take(~used)


@pytest.mark.parametrize("robust", [NO_KERNEL, RobustKernel("cauchy", 1.0)])
@pytest.mark.parametrize("scale", [1.0, 2.0, 0.5])
def test_alarm_is_silent_for_consistent_noise_and_fires_for_half_and_double(scale, robust):
    verdicts, ratios = [], []
    for seed in range(10):
        graph, withheld = small_run(seed, scale, robust)
        tests = pd.DataFrame(gps_innovations(graph, withheld).tests())
        classes = [c.as_row() for c in class_consistency(graph).values()]
        verdicts += [*tests["verdict"], *(c["verdict"] for c in classes)]
        ratios.append([*tests["value"], *(c["chi2_per_dof"] for c in classes)])
        assert np.all(np.abs(tests["autocorrelation"]) < 4 * tests["white"] / 1.96)
    wrong = {2.0: "overconfident", 0.5: "conservative"}
    if scale == 1.0:
        # 40 verdicts at 95 %, of ten independent runs: more than 7 alarms have a probability below 1e-3
        assert verdicts.count("consistent") >= 33
        assert np.allclose(np.mean(ratios, axis=0), 1.0, atol=0.12), np.mean(ratios, axis=0)
    else:
        assert verdicts.count(wrong[scale]) >= 39, verdicts
        assert np.allclose(np.mean(ratios, axis=0), scale**2, rtol=0.2)


def test_correlation_between_fixes_is_seen_where_their_size_is_right():
    """Errors that last (a bias a segment) pass the size test of single fixes and fail the joint one and whiteness."""
    generator, n = np.random.default_rng(5), 200
    S = np.eye(2 * n)
    correlated = np.repeat(generator.standard_normal((n // 20, 2)), 20, axis=0)
    g = GpsInnovations(times=np.arange(n, dtype=float), innovations=correlated, covariance=S, unpredicted=0)
    rows = pd.DataFrame(g.tests()).set_index("test")
    assert rows.loc["each", "autocorrelation"] > 10 * rows.loc["each", "white"] / 1.96
    # told of the correlation, the joint test is satisfied with the very same errors plus white ones
    model = np.kron(np.kron(np.eye(n // 20), np.ones((20, 20))), np.eye(2)) + 0.01 * np.eye(2 * n)
    joint = GpsInnovations(
        times=g.times,
        innovations=correlated + 0.1 * generator.standard_normal((n, 2)),
        covariance=model,
        unpredicted=0,
    )
    rows = pd.DataFrame(joint.tests()).set_index("test")
    assert rows.loc["joint", "verdict"] == "consistent"
    assert abs(rows.loc["joint", "autocorrelation"]) < 3 * rows.loc["joint", "white"] / 1.96
    assert rows.loc["each", "dof"] < 30 < rows.loc["joint", "dof"]


def test_what_cannot_be_predicted_is_refused_or_counted(rng):
    graph, withheld = solved_graph(rng)
    late = Gps(
        times=np.append(withheld.times, 1e4),
        positions=np.vstack([withheld.positions, [[0.0, 0.0]]]),
        sigma=np.append(withheld.sigma, 1.0),
        lever=withheld.lever,
    )
    got = gps_innovations(graph, late)
    assert (got.unpredicted, len(got.times)) == (1, len(withheld.times))
    with pytest.raises(DataError, match="no withheld fix"):
        gps_innovations(graph, late.take(slice(-1, None)))
    bare = FactorGraph()
    for s in make_chain(rng, m=3, landmarks=8).submaps:
        bare.add_submap(s)
    with pytest.raises(DataError, match="datum"):
        gps_innovations(bare, withheld)
    alone = class_consistency(bare)
    assert alone["submap"].dof == pytest.approx(alone["submap"].rows - bare.flat().layout.size)
    chain = FactorGraph()
    chain.add_submap(make_chain(rng, m=1, landmarks=4).submaps[0])
    row = class_consistency(chain)["submap"].as_row()
    assert row["verdict"] == "no redundancy"
    assert np.isnan(row["chi2_per_dof"])


def test_bounds_are_those_of_chi_square():
    low, high, _ = two_sided_bounds(1.0, 10.0, 0.95)
    assert (10 * low, 10 * high) == pytest.approx(tuple(stats.chi2.ppf([0.025, 0.975], 10)))
