"""What every kind of sensor of a graph does: one object for a kind and a graph, with all that waits or was used."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, Self

from graphslam.graph.factors.batch import FactorRecord
from graphslam.graph.submap_node import SubmapNode


class SensorFactors(ABC):
    """The sensors of one kind in one graph.

    A graph calls :meth:`add_factors` for every new submap, :meth:`remove` and :meth:`remove_unused` where something is
    removed, and :meth:`finish` when no more submaps will come. What a sensor cannot use it counts (events of the
    graph); it never leaves out a reading in silence.

    Attributes
    ----------
    name : str
        Of the kind; the default name of a stream, and the section of its options.
    title : str
        Of the kind in messages: "the log has no ...".
    readings : type
        Record type of its streams.
    options : type or None
        Configuration; None: it has none, and a run uses every stream of the kind.
    dims : tuple of int
        Of graphs that can use it.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    readings: ClassVar[type]
    options: ClassVar[type | None] = None
    dims: ClassVar[tuple[int, ...]] = (2, 3)
    kinds: ClassVar[list[type[SensorFactors]]] = []

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "name" in cls.__dict__:
            SensorFactors.kinds.append(cls)

    def __init__(self, graph: Any) -> None:
        self.graph = graph

    @classmethod
    def of(cls, graph: Any) -> Self:
        """That of a graph; a new one where it has none yet."""
        if cls.name not in graph.sensors:
            graph.sensors[cls.name] = cls(graph)
        found = graph.sensors[cls.name]
        assert isinstance(found, cls)
        return found

    @abstractmethod
    def add(self, readings: Any, *, stream: str | None = None, config: Any = None) -> list[int]:
        """Take readings, at any time and in any portion; returns the ids of their factors."""

    def add_factors(self, submap: SubmapNode) -> None:  # noqa: B027
        """Factors of readings that waited for a submap, which is in the graph now."""

    def finish(self) -> None:  # noqa: B027
        """No more submaps will come: readings that still wait are dropped, and counted."""

    def remove(self, submap: SubmapNode) -> None:  # noqa: B027
        """Take out what hangs on a submap that is about to be removed."""

    def remove_unused(self, removed: FactorRecord) -> None:  # noqa: B027
        """Take out variables that nothing holds any more after a factor was removed."""

    def waiting_readings(self) -> int:
        """Readings that are no factor yet."""
        return 0
