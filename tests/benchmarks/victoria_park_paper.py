"""One log, unknown association, by the ways of the Combined SLAM paper and by ours: ``bench_victoria_park.py --paper``.

Accuracy: the path at the antenna against GPS after one rigid alignment; pairs of observations against published
identities; χ²/dof of the join (for one map: mean NIS per scalar of the filter). Time: CPU seconds of this process, all
kernels compiled before, local maps and joins apart. The path of a single map is what the filter believed at the time:
unlike a path of joined submaps it does not move any more when a loop closes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import process_time
from typing import Any
from unittest import mock

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
import pandas as pd
from tqdm import tqdm

from graphslam.app.run import config as cfg
from graphslam.app.run.audit import reference_identities
from graphslam.app.run.front_ends import make_front_end, recommended_options
from graphslam.backend.back_end import BackEnd
from graphslam.core.config import build_config, merge_options
from graphslam.core.geometry import Array, se2_compose
from graphslam.core.log import SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.association import pair_agreement
from graphslam.evaluate.dead_reckoning_baseline import dead_reckoned_path
from graphslam.evaluate.gps import gps_residuals
from graphslam.join.association import MapAssociationConfig
from graphslam.join.ekf import join_ekf
from graphslam.join.joined_map import JoinResult
from graphslam.join.optimise import optimise_from_join
from graphslam.join.order import join_sequential, join_tree
from graphslam.join.submap_blocks import scale_covariances
from graphslam.plots import style
from graphslam.plots.save import save_figure
from graphslam_frontends.landmarks import ekf_filter
from graphslam_studies.plots.study_time import plot_cumulative_time
from tests.reference.gps_maps import plot_gps_maps

Ints = npt.NDArray[np.int64]
CONFIRMED = 6  # detections over all submaps, as in the preset
EVERYWHERE = 1e6  # m: an EKF that works on all landmarks in every scan, as the textbook has it


@dataclass(frozen=True)
class Judge:
    """What every map is held against."""

    gps: Gps
    reference: Ints

    def __call__(self, path: Trajectory, landmark_of: Ints | None = None) -> dict[str, float]:
        """Figures of one map; ``landmark_of`` says for every observation of the log which landmark it saw."""
        s = gps_residuals(path, self.gps).statistics
        out = {"rmse": s.rmse, "median": s.median}
        if landmark_of is not None:
            pairs = pair_agreement(landmark_of, self.reference)
            hits = np.bincount(landmark_of[landmark_of >= 0])
            out |= {"landmarks": float(np.sum(hits >= CONFIRMED)), "precision": pairs.precision, "recall": pairs.recall}
            out |= {"mixed": float(pairs.mixed)}
        return out

    def labels(self, submaps: Sequence[Submap], ids: Sequence[npt.ArrayLike]) -> Ints:
        """Landmark of every observation of the log, -1 where none, from the detections of submaps."""
        out = np.full(len(self.reference), -1, dtype=np.int64)
        for s, i in zip(submaps, ids, strict=True):
            assert s.landmarks is not None
            assert s.landmarks.detections is not None
            q = s.landmarks.detections
            out[q[:, 0]] = np.asarray(i)[q[:, 1]]
        return out


@dataclass
class Results:
    """Rows ``run, algorithm, submap, quantity, value``, and the maps of the first run."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    maps: dict[str, tuple[Trajectory, Array]] = field(default_factory=dict)
    run: int = 0

    def add(self, algorithm: str, values: dict[str, float], along: tuple[Ints, Array] | None = None) -> None:
        """Figures of a whole run, and seconds spent up to the end of each submap."""
        for quantity, value in values.items():
            self._row(algorithm, -1, quantity, value)
        for k, seconds in zip(*along, strict=True) if along is not None else ():
            self._row(algorithm, int(k), "seconds_cumulative", float(seconds))

    def _row(self, algorithm: str, submap: int, quantity: str, value: float) -> None:
        row = {"run": self.run, "algorithm": algorithm, "submap": submap, "quantity": quantity, "value": value}
        self.rows.append(row)

    def keep(self, algorithm: str, path: Trajectory, landmarks: Array) -> None:
        """Remember a map of the first run."""
        if self.run == 0:
            self.maps[algorithm] = (path, landmarks)


class Clock:
    """CPU seconds since it was made, read at every call."""

    def __init__(self) -> None:
        self.start, self.readings = process_time(), []

    def __call__(self, *_: Any) -> None:
        self.readings.append(process_time() - self.start)

    def along(self, offset: float | Array = 0.0) -> tuple[Ints, Array]:
        """Numbers 0 … and readings, with what was spent before added."""
        return np.arange(len(self.readings)), np.array(self.readings) + offset


def front_end_options(log: SensorLog, name: str, **options: Any) -> dict[str, Any]:
    """The preset of a front end with some options changed."""
    return merge_options(recommended_options(log, name)["frontend"], options)


def one_map(log: SensorLog, **options: Any) -> tuple[Submap, Array]:
    """EKF-SLAM with a single map: the map, and CPU seconds spent up to every scan."""
    clock = Clock()
    front = replace(make_front_end("ekf-slam", front_end_options(log, "ekf-slam", **options)), on_scan=clock)
    (submap,) = front.submaps(log, seed=SeedTree(0))
    return submap, np.array(clock.readings)


def local_maps(log: SensorLog, seed: int, **options: Any) -> tuple[list[Submap], Array]:
    """RBPF-EKF local maps, and CPU seconds spent up to the end of each."""
    front = make_front_end("rbpf-ekf", front_end_options(log, "rbpf-ekf", **options))
    clock, submaps = Clock(), []
    for submap in front.submaps(log, seed=SeedTree(seed).child("frontend")):
        clock()
        submaps.append(submap)
    return submaps, np.array(clock.readings)


def full_path(submaps: Sequence[Submap], poses: Array) -> Trajectory:
    """Path at full rate from the bases ``poses``; the later submap has an instant that two share."""
    times, path, last = [], [], np.inf
    for s, base in zip(submaps[::-1], poses[len(submaps) - 1 :: -1], strict=True):
        assert s.trajectory is not None
        keep = s.trajectory.times < last
        times.append(s.trajectory.times[keep])
        path.append(se2_compose(base, s.trajectory.poses[keep]))
        last = float(s.trajectory.times[0])
    return Trajectory(np.concatenate(times[::-1]), np.concatenate(path[::-1]))


def paper(log: SensorLog, *, seeds: int, figures: Path | None) -> None:
    """Everything: warm up, run, print the tables, draw."""
    front = make_front_end("rbpf-ekf", front_end_options(log, "rbpf-ekf"))
    judge = judge_of(log, front)
    start = log.interval[0]
    few = log.slice(start, start + 60.0)
    _all_methods(few, judge_of(few, front), Results(), 0, progress=False)  # compiles
    results = Results()
    reckoned = dead_reckoned_path(log, log["laser"].times)
    assert reckoned is not None
    results.add("dead reckoning", judge(reckoned))
    results.keep("dead reckoning", reckoned, np.zeros((0, 2)))
    for results.run in range(seeds):
        _all_methods(log, judge, results, results.run, progress=True)
    table = pd.DataFrame(results.rows)
    print_table(table)
    levels(log, judge)
    if figures is not None:
        figures.mkdir(parents=True, exist_ok=True)
        draw(table, results, judge.gps, figures)


def judge_of(log: SensorLog, front: Any) -> Judge:
    """GPS and published identities of a log; none of the latter leaves the pair columns empty."""
    observations = front.observations(log)[1]
    reference = reference_identities(log, front)
    gps = log["gps"]
    assert isinstance(gps, Gps)
    return Judge(gps, np.full(len(observations.ranges), -1, dtype=np.int64) if reference is None else reference)


def _all_methods(log: SensorLog, judge: Judge, out: Results, seed: int, *, progress: bool) -> None:
    """One run of everything; single maps draw nothing at random and run once."""
    bar = tqdm(desc=f"seed {seed}", unit="method", disable=not progress, leave=False)
    settings: cfg.RunConfig = build_config(cfg.RunConfig, recommended_options(log, "rbpf-ekf"))
    scale = settings.backend.covariance_scale
    moments, spent = local_maps(log, seed, handover="moments")
    ends = np.array([s.interval[1] for s in moments])
    if seed == 0:
        for name, options in (
            ("EKF, one map, nearest", {"association": "nearest"}),
            ("EKF, one map, jcbb", {"association": "jcbb"}),
            ("EKF, one map, jcbb, all landmarks", {"association": "jcbb"}),
        ):
            margin = EVERYWHERE if "all landmarks" in name else ekf_filter.ACTIVE_MARGIN
            with mock.patch.object(ekf_filter, "ACTIVE_MARGIN", margin):
                submap, seconds = one_map(log, **options)
            assert submap.trajectory is not None
            assert submap.landmarks is not None
            scans = submap.trajectory.times[-len(seconds) :]
            at = np.searchsorted(scans, ends, side="right") - 1
            labels = judge.labels([submap], [np.arange(len(submap.landmarks))])
            values = judge(submap.trajectory, labels) | {"fit": submap.report["nis"] / submap.report["nis_dof"]}
            out.add(name, values | {"seconds_local": seconds[-1]}, (np.arange(len(at)), seconds[at]))
            out.keep(name, submap.trajectory, submap.landmarks.positions)
            bar.update()
    for factor in (1.0, scale):
        scaled = scale_covariances(moments, factor)
        for rule in ("nearest", "joint"):
            for order, join in joiners(factor > 1.0 and rule == "nearest"):
                name = f"paper × {factor:g}, {order}, {rule}"
                _join(out, judge, name, scaled, spent, join, rule, polished=order in ("sequence", "tree"))
                bar.update()
    _default(log, judge, out, settings, moments, spent, "paper: iSAM2, merged")
    smoothed, spent = local_maps(log, seed)
    _join(out, judge, "default × 1, sequence, nearest", smoothed, spent, join_sequential, "nearest", polished=False)
    scaled = scale_covariances(smoothed, scale)
    for order, join in joiners(False):
        _join(out, judge, f"default × {scale:g}, {order}, joint", scaled, spent, join, "joint", polished=True)
        bar.update()
    _default(log, judge, out, settings, smoothed, spent, "default: iSAM2, merged")
    bar.close()


def joiners(cubic: bool) -> Iterator[tuple[str, Callable[..., JoinResult]]]:
    """Names and joiners; the textbook's O(n³) filter only where asked for."""
    yield from (("EKF", join_ekf), ("sequence", join_sequential), ("tree", join_tree))
    if cubic:
        yield "EKF O(n³)", lambda submaps, **options: join_ekf(submaps, form="naive", **options)


def _join(
    out: Results,
    judge: Judge,
    name: str,
    submaps: list[Submap],
    spent: Array,
    join: Callable[..., JoinResult],
    rule: Any,
    *,
    polished: bool,
) -> None:
    association = MapAssociationConfig(rule=rule)
    clock = Clock()
    if join is join_tree:  # all at once: what the tree of the first k costs, built afresh
        joined = join(submaps, association=association)
        count = np.unique(np.linspace(1, len(submaps), min(22, len(submaps))).astype(int))
        totals = [sum(join_tree(submaps[:k], association=association).times.values()) for k in count[:-1]]
        along = count - 1, np.array([*totals, sum(joined.times.values())])
    else:
        joined = join(submaps, association=association, on_join=clock)
        along = clock.along()
    dof = sum(3 + 2 * len(i) for i in joined.submap_ids) - joined.states
    labels = judge.labels(submaps, joined.submap_ids)
    values = {f"seconds_{part}": seconds for part, seconds in joined.times.items()}
    values |= {"seconds_join": sum(joined.times.values()), "seconds_local": spent[-1]}
    path = full_path(submaps, joined.poses)
    out.add(name, values | judge(path, labels) | {"fit": joined.objective / dof}, along)
    out.add(f"{name}, with local maps", {}, (along[0], along[1] + spent[along[0]]))
    out.keep(name, path, joined.landmarks)
    if polished:
        best = optimise_from_join(submaps, joined)
        assert best.objective_polished is not None
        seconds = {"seconds_join": sum(best.times.values()), "seconds_local": spent[-1]}
        fit = best.objective_polished / dof if best.converged else np.nan
        path = full_path(submaps, best.poses)
        out.add(f"{name}, polished", seconds | judge(path, labels) | {"fit": fit})
        out.keep(f"{name}, polished", path, best.landmarks)


def _default(
    log: SensorLog, judge: Judge, out: Results, settings: cfg.RunConfig, submaps: list[Submap], spent: Array, name: str
) -> None:
    """What ``graphslam run`` does: covariances scaled, association in the graph, iSAM2, merging, to the optimum."""
    clock = Clock()
    back = BackEnd(settings.backend, "isam2")
    for submap in submaps:
        back.add(submap)
        clock()
    solution = back.finish()
    clock()
    clock.readings[-2:] = clock.readings[-1:]  # the last submap pays for the finish
    path = solution.trajectory(covariances=False)
    labels = np.full(len(judge.reference), -1, dtype=np.int64)
    rows, landmarks = back.observation_labels(submaps)
    labels[rows] = landmarks
    values = {"seconds_local": spent[-1], "seconds_join": clock.readings[-1]}
    out.add(name, values | judge(path, labels) | {"fit": solution.score["submap"].chi2_per_dof}, clock.along())
    out.add(f"{name}, with local maps", {}, clock.along(spent))
    hits = back.landmark_hits(submaps)
    keep = [hits[int(i)] >= CONFIRMED for i in solution.landmark_ids]
    out.keep(name, path, solution.landmarks[keep])


def print_table(table: pd.DataFrame) -> None:
    """Median over the seeds; of the GPS RMSE also the extremes."""
    whole = table[table["submap"] < 0]
    order = list(dict.fromkeys(whole["algorithm"]))
    groups = whole.groupby(["algorithm", "quantity"])["value"]
    middle, low, high = (groups.agg(how).unstack() for how in ("median", "min", "max"))
    print(f"{'':40} | {'GPS RMSE [m] (extremes)':23} | median | {'trees':>5} | precision | recall | fit    ", end="")
    print("| CPU s: local | join  (association, update, recovery)")
    for name in order:
        m = middle.loc[name]
        parts = ", ".join(f"{m[f'seconds_{p}']:.3f}" for p in ("association", "update", "recovery"))
        spread = f"{m['rmse']:6.2f} ({low.loc[name, 'rmse']:.2f} … {high.loc[name, 'rmse']:.2f})"
        print(
            f"{name:40} | {spread:23} | {m['median']:6.2f} | {m['landmarks']:5.0f} | {m['precision']:9.4f} | "
            f"{m['recall']:6.4f} | {m['fit']:7.3g}| {m['seconds_local']:12.2f} | {m['seconds_join']:5.3f} ({parts})"
        )


def levels(log: SensorLog, judge: Judge) -> None:
    """Where a tree of the paper's maps goes wrong: landmarks that mix trees after every level, by rule."""
    scale = float(recommended_options(log, "rbpf-ekf")["backend"]["covariance_scale"])
    submaps = scale_covariances(local_maps(log, 0, handover="moments")[0], scale)
    print(f"\npaper × {scale:g}, tree, by level: submaps in a map | maps | landmarks that mix trees, nearest | joint")
    size = 2
    while size < 2 * len(submaps):
        blocks = [submaps[k : k + size] for k in range(0, len(submaps), size)]
        mixed = {}
        for rule in ("nearest", "joint"):
            joined = [join_tree(b, association=MapAssociationConfig(rule=rule)) for b in blocks]  # type: ignore[arg-type]
            found = [
                pair_agreement(judge.labels(b, j.submap_ids), judge.reference).mixed for b, j in zip(blocks, joined)
            ]
            mixed[rule] = sum(found)
        print(f"{min(size, len(submaps)):4d} | {len(blocks):3d} | {mixed['nearest']:4d} | {mixed['joint']:4d}")
        size *= 2


def draw(table: pd.DataFrame, results: Results, gps: Gps, folder: Path) -> None:
    """Time against submaps, and maps on the GPS fixes."""
    scale = next(n for n in results.maps if n.endswith("O(n³), nearest")).split()[2].rstrip(",")
    maps = f"paper × {scale}"
    _, (left, right) = plt.subplots(1, 2, figsize=(12.5, 4.6), dpi=style.DPI, layout="constrained")
    joins = {
        f"{maps}, EKF O(n³), nearest": "EKF, dense O(n³)",
        f"{maps}, EKF, nearest": "EKF, O(n²)",
        f"{maps}, sequence, nearest": "EIF in sequence",
        f"{maps}, tree, nearest": "EIF tree of the first k",
    }
    whole = {
        "EKF, one map, jcbb, all landmarks": "EKF, one map",
        "EKF, one map, jcbb": "EKF, one map, near landmarks first",
        f"{maps}, EKF O(n³), nearest, with local maps": "local maps, EKF O(n³)",
        f"{maps}, sequence, nearest, with local maps": "local maps, EIF in sequence",
        f"{maps}, tree, joint, with local maps": "local maps, EIF tree",
        "default: iSAM2, merged, with local maps": "default: local maps, iSAM2",
    }
    for ax, names, title in ((left, joins, "joining alone"), (right, whole, "from the raw log")):
        part = table[table["algorithm"].isin(names)].replace({"algorithm": names})
        plot_cumulative_time(ax, part, algorithms=list(names.values()), log=True, title=f"{title}, CPU time")
        style.legend(ax, outside=False, loc="lower right", fontsize="x-small")
    save_figure(left, folder / "victoria_park_time.png")
    shown = {
        "dead reckoning": "dead reckoning",
        "EKF, one map, nearest": "EKF, one map, nearest",
        "EKF, one map, jcbb": "EKF, one map, joint",
        "paper × 1, sequence, nearest": "paper's maps, in sequence, nearest",
        "paper × 1, tree, nearest": "paper's maps, tree, nearest",
        f"{maps}, sequence, nearest": f"covariances × {scale}, in sequence, nearest",
        f"{maps}, tree, nearest": f"covariances × {scale}, tree, nearest",
        f"{maps}, tree, joint, polished": f"covariances × {scale}, tree, joint, polished",
        "default: iSAM2, merged": "default",
    }
    paths = {label: results.maps[name][0] for name, label in shown.items()}
    marks = {label: results.maps[name][1] for name, label in shown.items() if len(results.maps[name][1])}
    axes = plot_gps_maps(paths, gps, landmarks=marks)
    save_figure(axes[0], folder / "victoria_park_maps.png")
