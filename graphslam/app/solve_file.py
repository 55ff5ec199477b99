"""``graphslam solve FILE``: read a pose network, solve it, report the quality, write the solution."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any

from graphslam.core.atomic import check_file_target
from graphslam.core.network import PoseNetwork
from graphslam.io.g2o import write_g2o
from graphslam.io.isam_graph import Noise
from graphslam.io.network_file import read_network
from graphslam.solve.network.solve import NetworkSolution, solve_network

RESIDUAL = "gtsam: Log(z^-1 x_i^-1 x_j)"


def solve_file(
    path: str | os.PathLike[str],
    solver: str = "lm",
    repair: bool = False,
    out: str | os.PathLike[str] | None = None,
    *,
    noise: Noise = "auto",
    create_missing: bool = False,
    starts: str | Sequence[str] | None = None,
    certificate: bool = False,
    **options: Any,
) -> dict[str, Any]:
    """Solve a g2o, TORO or iSAM file.

    Parameters
    ----------
    path : path-like
        Plain or compressed; the format is detected from the content.
    solver : {"lm", "isam2", "gnc", "pcg"}
    repair : bool
        Project indefinite information matrices to positive definite ones (counted in ``"repaired"``) instead of
        refusing the file.
    out : path-like, optional
        Write the solution as g2o; ``.xz``, ``.gz`` and ``.bz2`` compress.
    noise : str
        Meaning of TORO/iSAM noise columns.
    create_missing : bool
        Create vertices that only edges refer to, instead of refusing the file.
    starts : "all", name or sequence of names, optional
        Initial values; without this option several are tried only in doubtful cases
        (:func:`graphslam.solve.network.solve.solve_network`).
    certificate : bool
        Test whether the solution is certified as the global optimum (text in ``"certificate"``, values in
        ``"certificate_numbers"``).
    **options
        Of :func:`graphslam.solve.network.solve.solve_network`.

    Returns
    -------
    dict
        JSON-serialisable. ``objective`` is ``Σ rᵀ Ω r`` without ½ and with GTSAM's residual; ``objective_g2o`` is that
        of the same solution with g2o's residual.

    Raises
    ------
    UnknownNameError
        There is no such solver.
    MissingDataError, FormatError
        No such file, or a damaged one.
    CovarianceError
        Information matrices of the file are not positive definite; the message names them.

    Examples
    --------
    >>> solved = gs.solve_file("runs/field/graph.g2o", "lm")
    >>> solved["converged"]
    True
    """
    if out is not None:
        check_file_target(out)
    network = read_network(path, noise=noise, repair=repair, create_missing=create_missing)
    solution = solve_network(network, solver, starts=starts, certificate=certificate, **options)
    report = solution_json(solution)
    if out is not None:
        write_g2o(out, solution.to_network())
        report["out"] = str(out)
    return report


def solution_json(solution: NetworkSolution) -> dict[str, Any]:
    """A solution as plain JSON values; infinities become None."""
    network: PoseNetwork = solution.network
    return {
        "file": network.source,
        "solver": solution.solver,
        "dim": network.dim,
        "poses": len(network),
        "edges": len(network.edges),
        "position_priors": int(network.position_priors.sum()),
        "landmarks": len(network.landmark_ids),
        "observations": len(network.observations),
        "states": network.states,
        "residuals": network.residuals,
        "noise": network.noise,
        "repaired": network.repaired,
        "residual": RESIDUAL,
        "objective_initial": _finite(solution.objective_initial),
        "objective": _finite(solution.objective),
        "objective_g2o_initial": _finite(solution.objective_g2o_initial),
        "objective_g2o": _finite(solution.objective_g2o),
        "iterations": solution.iterations,
        "seconds": solution.seconds,
        "converged": solution.converged,
        "gap": _finite(solution.gap),
        "decrement": _finite(solution.decrement),
        "start": solution.start,
        "starts": [
            {
                "name": s.name,
                "objective_initial": _finite(s.objective_initial),
                "objective": _finite(s.objective),
                "iterations": s.iterations,
                "status": s.status,
            }
            for s in solution.starts
        ],
        **solution.details,
        **_certificate(solution),
    }


def _certificate(solution: NetworkSolution) -> dict[str, Any]:
    found = solution.certificate
    if found is None:
        return {}
    return {
        "certificate": str(found),
        "certificate_numbers": {
            "verdict": found.verdict,
            "reason": found.reason,
            "smallest_eigenvalue": _finite(found.smallest_eigenvalue),
            "relaxed_objective": _finite(found.relaxed_objective),
            "objective_from_relaxation": _finite(found.objective_from_relaxation),
        },
    }


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
