"""TU Chemnitz lecture hall (TUC SLAM): body velocities, loop candidates without a transform, true positions.

A candidate says that two moments look alike, and how much (0 to 1); it gives no relative pose, and many are wrong.
:meth:`TucLog.to_network` makes a pose network of it: odometry between nodes, and candidates as "same place, same
direction of view" factors with a stated σ.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graphslam.association.consistent_set import OdometryChain
from graphslam.core.errors import ConfigError, DataError, FormatError, MissingDataError
from graphslam.core.geometry import Array, se2_adjoint, se2_between, se2_exp, se2_inverse
from graphslam.core.log import DropCounter
from graphslam.core.network import PoseNetwork
from graphslam.core.reading import finite_mask, read_text
from graphslam.io.text_records import find_text_file
from graphslam_studies.evaluate.information import information_matrices

INPUT, TRUTH = "_Input.txt", "_GT.txt"
"""Ends of the names of the two files of a place, such as Lecture_Hall or Corridor."""
PLACE_SIGMA = 1.0
"""Stated σ of "the same place" [m]: images are compared about every two metres of the way."""
HEADING_SIGMA = 0.3
"""Stated σ of "the same direction of view" [rad]."""
# Numbers after the tag.
MOST_NODES = 100_000
"""Of a network: more come of a wrong stamp."""
_INPUT = {"odom2": 7, "loop": 3}
_TRUTH = {"point2": 7, "angle": 3}


@dataclass(frozen=True, slots=True)
class TucLog:
    """The recording.

    Parameters
    ----------
    times : (n,)
        Of the odometry [s], increasing.
    velocities : (n, 3)
        Forward, left [m/s], turn rate [rad/s] of the body, from each stamp to the next.
    variances : (n, 3)
        Of the velocities.
    loops : (l, 2)
        Stamps of the two moments of every candidate, the earlier first [s].
    similarity : (l,)
        In [0, 1].
    truth_times : (k,)
    truth : (k, 2)
        Position [m].
    dropped : dict of str to int
    """

    times: Array
    velocities: Array
    variances: Array
    loops: Array
    similarity: Array
    truth_times: Array
    truth: Array
    dropped: dict[str, int]
    source: str

    def truth_at(self, times: Array) -> Array:
        """True positions ``(m, 2)`` between the recorded ones."""
        return np.stack([np.interp(times, self.truth_times, self.truth[:, k]) for k in range(2)], axis=-1)

    def to_network(
        self,
        *,
        min_similarity: float = 0.0,
        place_sigma: float = PLACE_SIGMA,
        heading_sigma: float | None = HEADING_SIGMA,
        spacing: float = 1.0,
    ) -> tuple[PoseNetwork, Array]:
        """A pose network with a node at every stamp of a candidate, and at least every ``spacing`` seconds.

        Parameters
        ----------
        min_similarity : float
            Candidates below it are left out.
        place_sigma, heading_sigma : float
            σ of a candidate's "same place" [m] and "same direction" [rad]; a heading σ of None says nothing about the
            direction.
        spacing : float
            [s]

        Returns
        -------
        network : PoseNetwork
            Values are dead reckoning. Odometry first, then the candidates in the order of the file.
        times : (m,)
            Of the nodes.
        """
        if not (place_sigma > 0 and spacing > 0 and (heading_sigma is None or heading_sigma > 0)):
            raise ConfigError(f"σ and spacing must be positive, got {place_sigma}, {heading_sigma}, {spacing}")
        chosen = self.loops[self.similarity >= min_similarity]
        if self.times[-1] - self.times[0] > MOST_NODES * spacing:
            raise DataError(
                f"the odometry spans {self.times[-1] - self.times[0]:.3g} s: a stamp is wrong, or of another clock",
                where=self.source,
                wanted=f"at most {MOST_NODES:,} nodes, one every {spacing:g} s",
            )
        grid = np.arange(self.times[0], self.times[-1], spacing)
        stamps = np.unique(np.concatenate([chosen.ravel(), grid]))
        poses, increments, covariances = self._odometry(stamps)
        n = len(stamps)
        chain = np.stack([np.arange(n - 1), np.arange(1, n)], axis=1)
        ends = np.searchsorted(stamps, chosen)
        turn = 0.0 if heading_sigma is None else heading_sigma**-2
        loop = np.tile(np.diag([place_sigma**-2, place_sigma**-2, turn]), (len(ends), 1, 1))
        network = PoseNetwork(
            dim=2,
            ids=np.arange(n),
            poses=poses,
            has_initial=np.ones(n, dtype=np.bool_),
            edges=np.concatenate([chain, ends]).astype(np.intp),
            measurements=np.concatenate([increments, np.zeros((len(ends), 3))]),
            information=np.concatenate([information_matrices(covariances, self.source), loop]),
            source=self.source,
        )
        return network, stamps

    def _odometry(self, stamps: Array) -> tuple[Array, Array, Array]:
        """Dead-reckoned poses at the stamps, increments between them and covariances of their right tangents.

        Velocities are held until the next record; the noise of a record is one draw, so its share of a piece of its
        interval grows with the length of the piece.
        """
        t = np.unique(np.concatenate([self.times, stamps]))
        record = np.clip(np.searchsorted(self.times, t[:-1], side="right") - 1, 0, len(self.times) - 1)
        dt = np.diff(t)
        length = np.append(np.diff(self.times), np.median(np.diff(self.times)))[record]
        Q = np.zeros((len(dt), 3, 3))
        Q[:, [0, 1, 2], [0, 1, 2]] = self.variances[record] * (dt * length)[:, None]
        fine = OdometryChain.of(se2_exp(self.velocities[record] * dt[:, None]), Q)
        at = np.searchsorted(t, stamps)
        poses, spread = fine.poses[at], fine.spread[at]
        home = se2_adjoint(se2_inverse(poses[1:]))
        return (
            poses,
            se2_between(poses[:-1], poses[1:]),
            home @ (spread[1:] - spread[:-1]) @ np.swapaxes(home, 1, 2),
        )


def read_tuc(folder: str | os.PathLike[str], *, drops: DropCounter | None = None) -> TucLog:
    """Read the lecture hall.

    Parameters
    ----------
    folder : path
        Holds ``NAME_Input.txt`` and ``NAME_GT.txt`` of one place (Lecture_Hall), plain or compressed.
    drops : DropCounter, optional
        Counts into this one, besides ``TucLog.dropped``.
    """
    root = Path(folder)
    if not root.is_dir():
        raise MissingDataError("no such folder", where=str(root), wanted="a folder of the data set")
    counter = DropCounter()
    names = sorted({p.name.partition(INPUT)[0] for p in root.iterdir() if INPUT in p.name})
    if len(names) != 1:
        raise MissingDataError(
            "folder does not hold one recording", where=str(root), got=f"recordings: {', '.join(names) or 'none'}",
            wanted=f"one pair of files NAME{INPUT} and NAME{TRUTH}, plain or compressed",
        )  # fmt: skip
    path = find_text_file(root, names[0] + INPUT)
    tables = _tables(path, _INPUT)
    odometry, loops = tables["odom2"], tables["loop"]
    keep = finite_mask(odometry).all(axis=1) & (odometry[:, 4:] > 0.0).all(axis=1)
    counter.drop("odometry", "not finite, or a variance that is not positive", int((~keep).sum()))
    odometry = odometry[keep]
    forward = odometry[:, 0] > np.maximum.accumulate(np.concatenate([[-np.inf], odometry[:, 0]]))[:-1]
    counter.drop("odometry", "stamp not after the one before", int((~forward).sum()))
    odometry = odometry[forward]
    if len(odometry) < 2:
        raise DataError(
            "fewer than two usable odometry records", where=str(path), got=len(odometry), wanted="2 or more"
        )
    ends = np.sort(loops[:, :2], axis=1)
    span = odometry[0, 0], odometry[-1, 0]
    good = np.ones(len(loops), dtype=np.bool_)
    for reason, wrong in (
        ("not finite", ~np.isfinite(loops).all(axis=1)),
        ("similarity outside [0, 1]", ~((loops[:, 2] >= 0.0) & (loops[:, 2] <= 1.0))),
        ("stamp outside the odometry", ~((ends[:, 0] >= span[0]) & (ends[:, 1] <= span[1]))),
        ("from a moment to itself", ends[:, 0] == ends[:, 1]),
    ):
        counter.drop("loops", reason, int((good & wrong).sum()))
        good &= ~wrong
    truth = _tables(find_text_file(root, names[0] + TRUTH), _TRUTH)["point2"]
    order = np.flatnonzero(np.isfinite(truth[:, :3]).all(axis=1))
    counter.drop("truth", "not finite", len(truth) - len(order))
    truth = truth[order[np.argsort(truth[order, 0], kind="stable")]]
    if not len(truth):
        raise DataError("holds no true position", where=str(root / (names[0] + TRUTH)), wanted="point2 records")
    if drops is not None:
        drops.counts.update(counter.counts)
    return TucLog(
        times=odometry[:, 0],
        velocities=odometry[:, 1:4],
        variances=odometry[:, 4:],
        loops=ends[good],
        similarity=loops[good, 2],
        truth_times=truth[:, 0],
        truth=truth[:, 1:3],
        dropped=dict(counter.counts),
        source=root.name,
    )


def _tables(path: Path, columns: dict[str, int]) -> dict[str, Array]:
    """Records by tag. Values may be NaN: they are dropped and counted later."""
    rows: dict[str, list[list[float]]] = {tag: [] for tag in columns}
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.split()
        if not words:
            continue
        where = f"{path}, line {number}"
        if words[0] not in columns:
            raise FormatError(f"unknown record {words[0][:40]!r}", where=where, wanted="one of " + ", ".join(columns))
        if len(words) != 1 + columns[words[0]]:
            raise FormatError(
                f"{words[0]} record is truncated or too long",
                where=where,
                got=f"{len(words) - 1} values",
                wanted=columns[words[0]],
            )
        try:
            rows[words[0]].append([float(w) for w in words[1:]])
        except ValueError as error:
            raise FormatError(f"{words[0]} record holds no number ({error})", where=where) from None
    return {tag: np.array(r, dtype=np.float64).reshape(-1, columns[tag]) for tag, r in rows.items()}
