"""LiDAR odometry on simulated lidars: errors and their covariance, corridors, lost scans, bent scans."""

from dataclasses import replace

import numpy as np
import pytest

from graphslam.app.worlds import mesh_world
from graphslam.core import se3
from graphslam.core.errors import ConfigError
from graphslam.sim.raycast import RayCaster
from graphslam_frontends.lidar_odometry.cells import CellMap
from graphslam_frontends.lidar_odometry.config import LidarOdometryConfig
from graphslam_frontends.lidar_odometry.odometry import LidarOdometry
from graphslam_frontends.scan_window.relative_covariance import relative_covariance
from graphslam_studies.sim.lidar import LidarConfig, drawn_lidar, simulate_lidar


def _lidar(seed):
    """A drawn lidar with fewer points."""
    return replace(drawn_lidar(seed), points=4000)


def follow(clouds, *, ages=True, spoil=lambda k, cloud: cloud):
    odometry = LidarOdometry(LidarOdometryConfig())
    seen, poses, joints = [], [], []
    for k in range(len(clouds)):
        cloud = spoil(k, clouds.cloud(k))
        before = clouds.ages(k) if ages and len(cloud) == len(clouds.cloud(k)) else None
        seen.append(odometry.step(cloud, float(clouds.times[k]), before))
        if k % 10 == 0:
            odometry.errors.begin()
        poses.append(odometry.pose)
        joints.append(odometry.errors.joint)
    return np.array(poses), seen, np.array(joints)


def errors(poses, truth):
    return np.asarray(
        se3.se3_log(se3.se3_between(se3.se3_between(truth[:1], truth), se3.se3_between(poses[:1], poses)))
    )


@pytest.fixture(scope="module")
def drives():
    out = []
    for seed, world in ((1, "garage"), (2, "building"), (3, "mine"), (5, "building"), (8, "garage"), (9, "building")):
        log = simulate_lidar(mesh_world(world, seed=seed), seed, _lidar(seed), most=14.0)
        clouds = log["clouds"]
        out.append((clouds, log.truth.trajectory.interpolate(clouds.times), *follow(clouds)))
    return out


def test_paths_are_centimetres_off_and_their_covariances_say_so(drives):
    nees, ends = [], []
    for _, truth, poses, seen, joints in drives:
        ends.append(np.linalg.norm(errors(poses, truth)[-1, 3:]))
        assert all(s.state in ("first", "matched") for s in seen)
        for a in range(0, len(poses) - 10, 10):
            b = a + 9
            C = relative_covariance((poses[a], poses[b]), (poses[a], poses[b]), joints[b])
            e = se3.se3_log(se3.se3_between(se3.se3_between(poses[a], poses[b]), se3.se3_between(truth[a], truth[b])))
            nees.append(e @ np.linalg.solve(C, e) / 6)
    assert np.median(ends) < 0.05
    assert max(ends) < 0.2  # in a hand that shakes
    # a few, correlated and from different lidars: bounds that a covariance of half or a fourth of the size misses
    assert len(nees) > 20
    assert 0.15 < np.median(nees) < 1.2
    assert 0.3 < np.mean(nees) < 2.0


def test_the_same_scans_give_the_same_bytes(drives):
    clouds, _, poses, _, joints = drives[0]
    again, _, joints_again = follow(clouds)
    assert again.tobytes() == poses.tobytes()
    assert joints_again.tobytes() == joints.tobytes()


def test_scans_are_bent_by_motion_and_unbent_by_their_stamps():
    log = simulate_lidar(mesh_world("building", seed=2), 2, LidarConfig(rate=10.0, sweep=0.1, points=4000), most=12.0)
    clouds = log["clouds"]
    truth = log.truth.trajectory.interpolate(clouds.times)
    unbent, bent = follow(clouds)[0], follow(clouds, ages=False)[0]
    off = [np.abs(errors(p, truth)[40:, 3:]).max() for p in (unbent, bent)]
    assert off[0] < 0.03
    assert off[1] > 2.0 * off[0]


def test_nothing_holds_a_scan_along_an_endless_corridor():
    for ends in (False, True):
        poses, seen, joints = follow(_corridor(ends), ages=False)
        late = joints[-1][6:, 6:] if len(poses) % 10 != 1 else joints[-2][6:, 6:]
        along = np.sqrt(late[3, 3])
        if ends:
            assert all(s.unobservable == 0 for s in seen[3:])
            assert along < 0.02
            assert poses[-1, 0] == pytest.approx(0.1 * (len(poses) - 1), abs=0.1)
        else:
            assert all(s.unobservable == 1 for s in seen[5:])
            assert along > 0.3
            assert np.sqrt(late[4, 4]) < 0.02  # but across it
            assert np.abs(poses[:, 1]).max() < 0.05


def test_a_lidar_that_stands_when_the_log_begins_stays_where_it_is():
    """Along a smooth wall nothing holds a scan, and one that is bent by a false motion fits as well."""
    log = simulate_lidar(mesh_world("garage", seed=5), 5, _lidar(5), most=1.7)
    poses, seen, _ = follow(log["clouds"])
    off = errors(poses, log.truth.trajectory.interpolate(log["clouds"].times))
    assert any(s.unobservable for s in seen[1:3])
    assert np.linalg.norm(off[:, 3:], axis=1).max() < 0.05


class _Clouds:
    def __init__(self, scans):
        self.scans, self.times = scans, 0.1 * np.arange(len(scans))

    def __len__(self):
        return len(self.scans)

    def cloud(self, k):
        return self.scans[k]

    def ages(self, k):
        return None


def test_a_speed_that_nothing_tells_is_not_known_to_be_none():
    """Rest is the prediction when a log begins; along an endless corridor the covariance is wide."""
    for speed in (0.5, 2.0, 8.0):
        poses, _, joints = follow(_corridor(False, 0.1 * speed), ages=False)
        off = 0.1 * speed * 9 - poses[9, 0]
        sigma = np.sqrt(joints[9, 9, 9])
        assert abs(off) < 3.0 * sigma
        assert sigma > 5.0  # of 0.9 s at a speed of which nothing is known
    # the single steps, which a refinement gets, say no more
    odometry, steps = LidarOdometry(LidarOdometryConfig()), []
    clouds = _corridor(False, 0.8)
    for k in range(10):
        odometry.step(clouds.cloud(k), float(clouds.times[k]))
        steps.append(odometry.spread[3, 3])
    assert np.sqrt(sum(steps)) > 5.0


@pytest.mark.parametrize("speed", [1.0, 6.0, 15.0])
def test_a_log_may_begin_in_motion_on_open_ground(speed):
    """Rings on the ground lie where they lay, whatever the speed: rows of points are no word for rest."""
    caster = _street(np.random.default_rng(3))
    az, el = np.meshgrid(np.arange(900) * 2 * np.pi / 900, np.deg2rad(np.linspace(-15.0, 15.0, 16)))
    d = np.column_stack([(np.cos(el) * np.cos(az)).ravel(), (np.cos(el) * np.sin(az)).ravel(), np.sin(el).ravel()])
    rng, scans = np.random.default_rng(4), []
    for k in range(15):
        r = caster.ranges(np.hstack([np.broadcast_to([0.1 * speed * k, 0.0, 1.8], d.shape), d]))
        met = (r > 0.5) & (r < 80.0)
        scans.append(d[met] * (r[met] + rng.normal(0, 0.02, met.sum()))[:, None])
    poses, seen, _ = follow(_Clouds(scans), ages=False)
    assert all(s.unobservable == 0 for s in seen[3:])
    assert np.abs(poses[:, :3] - np.outer(0.1 * speed * np.arange(15), [1, 0, 0])).max() < 0.03


def _street(rng):
    """Ground, and boxes of 0.3 to 4 m on either side of a road."""
    v, f = [[-300, -300, 0], [300, -300, 0], [300, 300, 0], [-300, 300, 0]], [(0, 1, 2), (0, 2, 3)]
    for x in np.arange(-40.0, 80.0, 8.0):
        for side in (-1, 1):
            at, half, top = (
                [x + rng.uniform(-3, 3), side * rng.uniform(5, 12)],
                rng.uniform(0.3, 2.0, 2),
                rng.uniform(1, 4),
            )
            angle, k = rng.uniform(0, np.pi), len(v)
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            for z in (0, top):
                v += [[*(at + turn @ (half * c)), z] for c in ([-1, -1], [1, -1], [1, 1], [-1, 1])]
            sides = ((0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7), (4, 5, 6, 7))
            f += [(k + q[0], k + q[i], k + q[i + 1]) for q in sides for i in (1, 2)]
    return RayCaster(np.array(v, dtype=np.float64), np.array(f))


def _corridor(ends, step=0.1):
    """Scans every 0.1 m in a corridor of 2.4 m × 2.6 m, whose ends are out of sight or at -5 and 12 m."""
    x0, x1 = (-5.0, 12.0) if ends else (-500.0, 500.0)
    y0, y1, z0, z1 = -1.2, 1.2, -1.2, 1.4
    v = np.array([[x, y, z] for x in (x0, x1) for y in (y0, y1) for z in (z0, z1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    caster = RayCaster(v, np.array([[q[i] for i in t] for q in quads for t in ((0, 1, 2), (0, 2, 3))]))
    rng = np.random.default_rng(7)
    scans = []
    for k in range(26):
        d = rng.normal(size=(3000, 3))
        d /= np.linalg.norm(d, axis=1)[:, None]
        r = caster.ranges(np.hstack([np.broadcast_to([step * k, 0.0, 0.0], d.shape), d]))
        met = r < 25.0
        scans.append(d[met] * (r[met] + rng.normal(0, 0.02, met.sum()))[:, None])
    return _Clouds(scans)


def test_lost_scans_are_found_and_stay_out_of_the_map(drives):
    clouds, truth, clean, _, _ = drives[1]
    other = drives[2][0]
    n = len(clouds)

    def foreign(k, cloud):
        return other.cloud(k) if k in (30, 31) else cloud

    def empty(k, cloud):
        return cloud[:0] if 30 <= k < 34 else cloud

    good = errors(clean, truth)
    for spoil, bad in ((foreign, (30, 31)), (empty, range(30, 34))):
        poses, seen, joints = follow(clouds, spoil=spoil)
        assert all(seen[k].state in ("lost", "empty") for k in bad)
        later = errors(poses[40:], truth[40:])
        assert np.abs(later[:, 3:]).max() < 2.0 * np.abs(errors(clean[40:], truth[40:])[:, 3:]).max() + 0.02
        assert n > 60
        assert np.all(np.isfinite(joints))
    assert np.abs(good[:, 3:]).max() < 0.05


def test_scans_of_one_instant_and_a_gap(drives):
    clouds, truth, _, _, _ = drives[1]
    odometry = LidarOdometry(LidarOdometryConfig())
    poses, at = [], []
    for k in range(len(clouds)):
        if 20 <= k < 24:
            continue
        time = float(clouds.times[30] if 30 <= k < 33 else clouds.times[k])
        odometry.step(clouds.cloud(k), time, clouds.ages(k))
        poses.append(odometry.pose)
        at.append(k)
    assert np.abs(errors(np.array(poses), truth[at])[:, 3:]).max() < 0.1


def test_impossible_figures_are_refused():
    for wrong in (
        {"max_range": -1.0},
        {"levels": (0.5, 1.0)},
        {"most_points": 3},
        {"min_range": 90.0},
    ):
        with pytest.raises(ConfigError):
            LidarOdometryConfig(**wrong)


def test_coarse_cells_that_lead_a_match_astray_do_not_decide(drives, monkeypatch):
    """As on a street, where cells of 2 m look alike a metre on: the finest cells compare it with the prediction."""
    clouds, truth, _, _, _ = drives[1]
    descend = CellMap.descend

    def shifted(self, points, R, t, *rest):
        fit = descend(self, points, R, t, *rest)
        if self.config.size > 0.5:
            t += [1.2, 0.0, 0.0]
        return fit

    odometry, poses = LidarOdometry(LidarOdometryConfig()), []
    for k in range(40):
        if k == 20:
            monkeypatch.setattr(CellMap, "descend", shifted)
        odometry.step(clouds.cloud(k), float(clouds.times[k]), clouds.ages(k))
        poses.append(odometry.pose)
    assert np.abs(errors(np.array(poses), truth[:40])[:, 3:]).max() < 0.1
