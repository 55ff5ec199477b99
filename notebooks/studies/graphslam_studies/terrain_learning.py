"""Learning of the terrain tables on drives through training streets, which are not used in tests."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array
from graphslam.core.progress import Bar
from graphslam.maps.terrain.line_kernels import ABOVE, OVERHANG, STEP, SUPPORT
from graphslam.maps.terrain.lines import Rows, lines_of_scans
from graphslam.maps.terrain.pyramid import Pyramid
from graphslam.maps.terrain.tables import BINS, SCALE, WEIGHTS, TerrainWeights, fixed_tables
from graphslam.maps.terrain.vehicle import CELLS
from graphslam_studies.maps.learning import count_values, fit_calibration, fit_weights, ratios_of
from graphslam_studies.sim.street import OBSTACLE, RAMP_LENGTH, TARGETS, Street, draw_street, drive_street
from graphslam_studies.terrain_trial import (
    BOX,
    SINGLE,
    TerrainTrialConfig,
    channel_labels,
    coarser,
    labelled,
    snapshots,
    statements,
)

FIRST_SEED = 10_000
"""First seed of the training drives; test drives have the seeds of their study."""
ASKED = (7.0, 4.5, 2.0)
"""Distances to the target at which cells are sampled [m]."""
JUDGED = 11.0
"""Maximum range of training cells from the sensor [m]."""
CANDIDATES = (0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
RAMP_ROUND = 0.4
"""Margin before the foot and behind the top of a ramp that counts as ramp [m]: the second-largest cell width."""
MOST_FALSE = 0.03
"""The threshold is the lowest candidate with at most this share of free cells within 7 m classified as hazard …"""
MOST_FALSE_FLAT = 0.001
"""… and at most this share on flat ground, farther than 0.5 m from cells that are not free: half the test limit."""


@dataclass(frozen=True)
class Drive:
    """Statements of lines up to each sampling place, and labels of the cells of each band."""

    target: str
    parts: list[Rows]
    places: Array
    labels: list[Array]
    slopes: list[npt.NDArray[np.bool_]]
    """Mask of the cell columns of each band on or next to a drivable ramp ``(nx,)``."""


class LabelledCells(NamedTuple):
    """Cells of a band and their ground truth."""

    ratios: Array
    """Sums of ratios of steps and of support ``(2, k)``."""
    counts: Array
    """Numbers of statements about steps, about support, and about overhangs ``(3, k)``."""
    hazard: npt.NDArray[np.bool_]
    slope: npt.NDArray[np.bool_]
    """Free cells on a drivable slope ``(k,)``."""
    probability: Array
    """Hazard probability in the map ``(k,)``."""


def learn_tables(
    *,
    seeds: Sequence[int] = tuple(range(FIRST_SEED, FIRST_SEED + 10)),
    targets: Sequence[str] = tuple(TARGETS),
    config: TerrainTrialConfig | None = None,
    progress: bool = True,
) -> TerrainWeights:
    """Learn the tables of a sensor and a vehicle.

    Parameters
    ----------
    seeds : sequence of int
        Seeds of the training streets; each is driven once per target.
    config : TerrainTrialConfig, optional
        Robot and vehicle.
    progress : bool
        Show a progress bar on stderr.
    """
    c = config or TerrainTrialConfig()
    if not seeds or not targets:
        raise ConfigError("tables are learnt on at least one drive: name seeds and targets")
    blank = TerrainWeights(fixed_tables(4, 0.0, 0.0), np.zeros((4, WEIGHTS)), np.zeros(WEIGHTS), 0.5, {})
    shape = Pyramid(BOX, blank, c.vehicle, c.sensor)
    wide = Pyramid(BOX, blank, c.vehicle, c.sensor, SINGLE)
    histograms = np.zeros((2, 3, shape.bands, BINS), np.int64)
    kept: list[Drive] = []
    kept_wide: list[Drive] = []
    for seed, target in Bar([(s, t) for s in seeds for t in targets], name="drives", shown=progress):
        street = draw_street(target, seed, teaching=True)
        drive = drive_street(street, seed, c.robot)
        lines = lines_of_scans(drive.scans, drive.believed, c.robot.height)
        rows, wide_rows = (r[r[:, 4] < ABOVE] for r in (statements(lines, shape), statements(lines, wide)))
        truth = labelled(street, c).labels
        labels = [coarser(truth, round(w / shape.cells[0])) for w in shape.cells]
        histograms += count_values(rows, row_labels(rows, labels, _on_ramp(street, shape), shape), shape.bands)
        ends = snapshots(drive, ASKED)
        places = np.array([street.target_at - d for d in ASKED])
        kept.append(Drive(target, _until(rows, ends), places, labels, _on_ramp(street, shape)))
        flat = [coarser(truth, round(SINGLE[0] / CELLS[0]))]
        kept_wide.append(Drive(target, _until(wide_rows, ends), places, flat, _on_ramp(street, wide)))
    ratios = ratios_of(histograms)
    learnt = TerrainWeights(ratios, np.zeros((4, WEIGHTS)), np.zeros(WEIGHTS), 0.5, {})
    cells, wide_cells = labelled_cells(kept, learnt, c), labelled_cells(kept_wide, learnt, c, SINGLE)
    weights = np.array([fit_weights(of.ratios, of.counts, of.hazard, of.slope) for of in cells])
    of = wide_cells[0]
    single = fit_weights(of.ratios, of.counts, of.hazard, of.slope)
    learnt = TerrainWeights(ratios, weights, single, 0.5, {})
    cells, wide_cells = labelled_cells(kept, learnt, c), labelled_cells(kept_wide, learnt, c, SINGLE)
    for row, of in zip([*weights, single], [*cells, wide_cells[0]]):
        row[-2:] = fit_calibration(of.probability, of.hazard)
    learnt = TerrainWeights(ratios, weights, single, 0.5, {})
    rates = false_alarms(kept, learnt, c)
    good = [t for t in CANDIDATES if rates[t][0] <= MOST_FALSE and rates[t][1] <= MOST_FALSE_FLAT]
    threshold = good[0] if good else CANDIDATES[-1]
    provenance: dict[str, Any] = {
        "made_by": "graphslam terrain-tables",
        "streets": "teaching streets of graphslam_studies.sim.street",
        "seeds": [int(s) for s in seeds],
        "targets": list(targets),
        "laser": c.laser,
        "robot": asdict(c.robot),
        "vehicle": asdict(c.vehicle),
        "statements": {
            name: {kind: int(histograms[k, h].sum()) for h, kind in enumerate(("even", "slope", "hazard"))}
            for k, name in ((STEP, "step"), (SUPPORT, "support"))
        },
        "false_alarms_while_learning": {str(t): [round(a, 5) for a in rates[t]] for t in CANDIDATES},
    }
    return TerrainWeights(ratios, weights, single, threshold, provenance)


def write_learnt_tables(
    path: str | Path, *, drives: int = 10, first_seed: int = FIRST_SEED, progress: bool = True
) -> TerrainWeights:
    """Learn the tables of the simulated robot and write them."""
    if drives < 1:
        raise ConfigError(f"{drives} drives for each target; wanted at least 1")
    tables = learn_tables(seeds=range(first_seed, first_seed + drives), progress=progress)
    tables.write(path)
    return tables


def _on_ramp(street: Street, shape: Pyramid) -> list[npt.NDArray[np.bool_]]:
    out = []
    for b in range(shape.bands):
        along = (shape.first[b, 0] + np.arange(shape.shapes[b, 1]) + 0.5) * shape.cells[b] - street.target_at
        out.append((street.kind == "ramp") & (along > -RAMP_ROUND) & (along < RAMP_LENGTH + RAMP_ROUND))
    return out


def row_labels(
    rows: Rows, labels: list[Array], slopes: list[npt.NDArray[np.bool_]], shape: Pyramid
) -> npt.NDArray[np.int8]:
    """Kinds ``(2, k)`` of the cells of statements, for steps and for support: 0 free, 1 free on or next to a ramp,
    2 a hazard, −1 ignored or outside."""
    out = np.full((2, len(rows)), -1, np.int8)
    for b, truth in enumerate(labels):
        mine = np.flatnonzero(rows[:, 1] == b)
        ix, iy = rows[mine, 2] - shape.first[b, 0], rows[mine, 3] - shape.first[b, 1]
        inside = (ix >= 0) & (iy >= 0) & (ix < truth.shape[1]) & (iy < truth.shape[0])
        slope = slopes[b][ix[inside]]
        for channel, of in enumerate(channel_labels(truth)):
            own = of[iy[inside], ix[inside]]
            out[channel, mine[inside]] = np.where(own > 0, 2, np.where((own == 0) & slope, 1, own))
    return out


def _until(rows: Rows, ends: list[int]) -> list[Rows]:
    """Split statements at the line numbers ``ends``; those after the last are omitted."""
    at = np.searchsorted(rows[:, 0], ends)
    return [rows[a:b] for a, b in zip([0, *at[:-1].tolist()], at.tolist())]


def _pyramids(
    kept: list[Drive], tables: TerrainWeights, c: TerrainTrialConfig, cells: tuple[float, ...] = CELLS
) -> Iterator[tuple[Pyramid, Drive, float]]:
    for drive in kept:
        pyramid = Pyramid(BOX, tables, c.vehicle, c.sensor, cells)
        for part, place in zip(drive.parts, drive.places):
            pyramid.add(part)
            yield pyramid, drive, float(place)


def labelled_cells(
    kept: list[Drive], tables: TerrainWeights, c: TerrainTrialConfig, cells: tuple[float, ...] = CELLS
) -> list[LabelledCells]:
    """For every band: cells that use this band, ahead of the sensor and within 11 m, at all sampling distances.

    Of cells with a wire, only those where a beam hit it.
    """
    parts: list[list[tuple[Array, ...]]] = [[] for _ in range(tables.bands)]
    for pyramid, drive, place in _pyramids(kept, tables, c, cells):
        found = pyramid.classify()
        for b, truth in enumerate(drive.labels):
            counts, ratios = pyramid.band_of(pyramid.counts, b), pyramid.band_of(pyramid.ratios, b) / SCALE
            k = round(float(pyramid.cells[b] / pyramid.cells[0]))
            x, y = (
                (pyramid.first[b, axis] + np.arange(pyramid.shapes[b, 1 - axis]) + 0.5) * pyramid.cells[b]
                for axis in (0, 1)
            )
            near = (x[None] > place) & (np.hypot(x[None] - place, y[:, None]) < JUDGED)
            judged = (truth >= 0) & (found.band[::k, ::k] == b) & near
            if drive.target.startswith("wire"):  # a wire between two beams is not measured
                judged &= (truth != OBSTACLE) | (counts[OVERHANG] > 0)
            slope = (truth == 0) & drive.slopes[b]
            p = found.probability[::k, ::k]
            of = (ratios[:, judged], counts[: OVERHANG + 1, judged], truth[judged] > 0, slope[judged], p[judged])
            parts[b].append(of)
    return [LabelledCells(*(np.concatenate(part, axis=-1) for part in zip(*of))) for of in parts if of]


def false_alarms(kept: list[Drive], tables: TerrainWeights, c: TerrainTrialConfig) -> dict[float, tuple[float, float]]:
    """Shares of free cells within 7 m classified as hazard, by threshold: of all, and of those on streets without a
    target that are farther than 0.5 m from cells that are not free."""
    counts = {t: np.zeros(4) for t in CANDIDATES}
    for pyramid, drive, place in _pyramids(kept, tables, c):
        found = pyramid.classify()
        x, y = found.centres()
        near = np.hypot(x[None] - place, y[:, None]) < 7.0
        free = (drive.labels[0] == 0) & found.known & near
        flat = free & (distance_transform_edt(drive.labels[0] == 0) * found.cell > 0.5) & (drive.target == "nothing")
        for t in CANDIDATES:
            wrong = np.nan_to_num(found.probability) > t
            counts[t] += [(free & wrong).sum(), free.sum(), (flat & wrong).sum(), flat.sum()]
    return {t: (float(n[0] / max(n[1], 1)), float(n[2] / max(n[3], 1))) for t, n in counts.items()}
