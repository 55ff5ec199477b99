"""Where segments and pieces of paths in simulated garages really ended: what the defaults of drift models rest on.

``python -m tests.reference.garage_exits`` drives the garages and writes ``garage_exits.npz`` anew (some 20 minutes on
one core); tests read it. SegSLAM with 1, 5, 20 and 40 particles whose walks are halved, as the studies have it; and one
filter over the whole way, of 20 particles with whole walks, whose path is cut into pieces.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from graphslam.core.poses import SE3, heading_of, level_poses

FILE = Path(__file__).with_name("garage_exits.npz")
RUNS = (*(("A", seed) for seed in range(100, 106)), ("B", 101), ("B", 103))
PARTICLES = (1, 5, 20, 40)
PIECES = (5.0, 10.0, 20.0, 40.0, 80.0)
"""Lengths [m] of the pieces of the one filter's path."""
NODES = 24
Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Ends:
    """Ends of segments or pieces, seen from their own starts; frames stand level at both ends.

    Parameters
    ----------
    particles : (m,) int
        Of the filter.
    paths : (m, NODES, 7)
        The body along each, upright.
    errors : (m, 4)
        Heading [rad], x, y, z [m] of the true end, right tangent at the estimated one.
    spreads : (m, 4, 4)
        Covariance of the particles about the estimate; zero for pieces.
    """

    particles: npt.NDArray[np.int64]
    paths: Array
    errors: Array
    spreads: Array

    @property
    def lengths(self) -> Array:
        """``(m,)`` [m]."""
        return np.asarray(np.linalg.norm(np.diff(self.paths[..., :3], axis=1), axis=2).sum(axis=1))


def read(*particles: int, pieces: bool = False) -> Ends:
    """Ends of the segments of filters of so many particles, or of the pieces of the one filter's path."""
    with np.load(FILE) as data:
        kept = np.isin(data["particles"], particles) & (data["pieces"] == pieces)
        x = data["paths"][kept].astype(np.float64)
        return Ends(
            data["particles"][kept].astype(np.int64),
            level_poses(x[..., :3], x[..., 3]),
            data["errors"][kept].astype(np.float64),
            data["spreads"][kept].astype(np.float64),
        )


def drive(layout: str, seed: int) -> Iterator[tuple[int, bool, Array, Array, Array]]:
    """Particles, whether a piece, path, error and spread of every end of one drive."""
    from graphslam.core.poses import remove_roll_pitch
    from graphslam_studies.segslam_garage import WORLDS
    from graphslam_studies.segslam_trial import GridTrial

    trial = GridTrial(replace(WORLDS[f"garage-{layout}"], figures=()), seed)
    for n in PARTICLES:
        yield from ((n, False, *end) for end in segment_ends(trial.outcome(f"segslam-{n}").result, trial.truth))
    one = trial.outcome("rbpf-20").result
    path, s = one.ancestry.path(one.best), one.path_length
    g = SE3
    for length in PIECES:
        for start in np.linspace(0.0, s[-1] - length, 6):
            a, b = np.searchsorted(s, [start, start + length])
            about, true = (g.between(remove_roll_pitch(p[a]), remove_roll_pitch(p[b])) for p in (path, trial.truth))
            at = np.linspace(a, b, NODES).round().astype(int)
            seen = g.between(np.broadcast_to(remove_roll_pitch(path[a]), path[at].shape), path[at])
            yield 20, True, seen, g.log(g.between(about, true))[2:], np.zeros((4, 4))


def segment_ends(result: object, truth: Array) -> Iterator[tuple[Array, Array, Array]]:
    """Path, error and spread of every settled segment."""
    from graphslam.core.poses import remove_roll_pitch
    from graphslam_frontends.segslam.covariance import exit_covariance
    from graphslam_frontends.segslam.submaps import common_ancestor_chain, exits_of_interval, segment_base

    m = result.segmap  # type: ignore[attr-defined]
    g = m.group
    for index in common_ancestor_chain(m, int(result.closed[result.best])):  # type: ignore[attr-defined]
        s = m[int(index)]
        about = g.between(segment_base(m, s.T_entry), segment_base(m, s.T_exit))
        true = g.between(*(remove_roll_pitch(truth[k]) for k in s.interval))
        ends, weights = exits_of_interval(m, s.interval)
        spread = exit_covariance(ends, about, np.eye(6), weights=weights).particles
        at = np.linspace(0, len(s.path) - 1, NODES).round().astype(int)
        yield s.path[at], g.log(g.between(about, true))[2:], spread[2:, 2:]


def main() -> None:
    rows = []
    for layout, seed in RUNS:
        rows += list(drive(layout, seed))
        print(layout, seed, len(rows), file=sys.stderr, flush=True)
    particles, pieces, paths, errors, spreads = (np.array(c) for c in zip(*rows))
    save(particles, pieces, paths, errors, spreads)


def save(particles: Array, pieces: Array, paths: Array, errors: Array, spreads: Array) -> None:
    """Write the file, as small as the figures allow."""
    flat = np.concatenate([paths[..., :3], heading_of(paths)[..., None]], axis=-1)
    np.savez_compressed(
        FILE,
        particles=particles.astype(np.int16),
        pieces=pieces.astype(bool),
        paths=flat.astype(np.float16),
        errors=errors.astype(np.float32),
        spreads=spreads.astype(np.float32),
    )


if __name__ == "__main__":
    main()
