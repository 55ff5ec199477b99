"""Seed tree: all random numbers of a run derive from one integer.

The same seed gives the same bytes for any number of threads or workers, and a run that is resumed at submap k uses the
same numbers as an uninterrupted one, because each submap has its own branch.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class SeedTree:
    """A node of the seed tree.

    Parameters
    ----------
    seed : int
        Root entropy.
    path : tuple of int
        Branch from the root.

    Examples
    --------
    >>> a = SeedTree(0).child("frontend", 3).generator().standard_normal()
    >>> b = SeedTree(0).child("frontend").child(3).generator().standard_normal()
    >>> bool(a == b)
    True
    """

    seed: int
    path: tuple[int, ...] = ()

    def child(self, *names: str | int) -> SeedTree:
        """Branch named by strings or numbers. Strings are hashed by CRC-32, so the order of use does not matter."""
        keys = tuple(n if isinstance(n, int) else zlib.crc32(n.encode()) for n in names)
        return SeedTree(self.seed, self.path + keys)

    def generator(self) -> np.random.Generator:
        """Counter-based generator (Philox) of this node."""
        return np.random.Generator(np.random.Philox(np.random.SeedSequence(self.seed, spawn_key=self.path)))
