"""The exceptions of the package.

A message says what went wrong, where (file, record), which value was found and which was expected. Libraries raise;
only the command line catches :class:`GraphSlamError`, prints its one line and exits 1.
"""

from __future__ import annotations

import difflib


class GraphSlamError(Exception):
    """Base class of all errors of this package."""


class DataError(GraphSlamError):
    """A recorded file or stream has unusable content.

    Parameters
    ----------
    what : str
        What is wrong.
    where : str, optional
        File, and record or line inside it.
    got, wanted : object, optional
        The offending value and what would have been accepted.
    """

    def __init__(self, what: str, *, where: str | None = None, got: object = None, wanted: object = None) -> None:
        self.what, self.where, self.got, self.wanted = what, where, got, wanted
        parts = [f"{where}: {what}" if where else what]
        if got is not None:
            parts.append(f"got {got}")
        if wanted is not None:
            parts.append(f"wanted {wanted}")
        super().__init__("; ".join(parts))


class FormatError(DataError):
    """A file is of an unknown format or version, truncated, or corrupt."""


class MissingDataError(DataError):
    """A requested file, stream or data set is missing."""


class MissingExtraError(MissingDataError):
    """An optional package is not installed; the message names the extra that contains it."""


class CovarianceError(DataError):
    """A covariance or information matrix is not finite, not symmetric or not positive definite."""


class UnknownNameError(GraphSlamError):
    """A data set, front end, solver, map-joining method or world of that name is not registered."""

    def __init__(self, kind: str, name: str, known: object = ()) -> None:
        names = sorted(str(k) for k in known) if known else []  # type: ignore[attr-defined]
        close = difflib.get_close_matches(name, names, n=3)
        hint = f"did you mean {' or '.join(close)}? " if close else ""
        super().__init__(f"unknown {kind} {name!r}; {hint}known: {', '.join(names) or 'none'}")
        self.kind, self.name = kind, name


class ConfigError(GraphSlamError):
    """A configuration file or option has an unknown key or an impossible value."""


class GeometryError(DataError):
    """A pose or a shape is impossible (non-finite, zero quaternion, wrong dimension)."""


class EvidenceReusedError(GraphSlamError):
    """A measurement would be used twice (see :mod:`graphslam.graph.ledger`)."""


class IndeterminateError(GraphSlamError):
    """A system does not constrain some variables.

    Parameters
    ----------
    variables : sequence of str
        Names of the unconstrained variables.
    """

    def __init__(self, message: str, variables: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.variables = variables


class SolverError(GraphSlamError):
    """A solver failed, or cannot provide a result in its state."""


class RunFolderError(GraphSlamError):
    """A run folder cannot be written, read or resumed."""


class OutputError(GraphSlamError):
    """An output cannot be written where it was asked for."""


class GridError(DataError):
    """An impossible request to an evidence grid (voxel size, shape, a place outside its cube)."""


class GridLockedError(GraphSlamError):
    """A locked map (localisation only) would be changed."""
