"""Base class of the sensors of a graph: one object per kind and graph, with waiting and used readings."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, Self

from graphslam.graph.factors.batch import FactorRecord
from graphslam.graph.submap_node import SubmapNode


class SensorFactors(ABC):
    """The sensors of one kind in one graph.

    A graph calls :meth:`add_factors` for every new submap, :meth:`remove` and :meth:`remove_unused` when something is
    removed, and :meth:`finish` when no more submaps follow. Every reading that a sensor does not use is counted in the
    events of the graph.

    Attributes
    ----------
    name : str
        Of the kind; default name of a stream, and section of its options.
    title : str
        Of the kind in messages: "the log has no ...".
    readings : type
        Record type of its streams.
    options : type or None
        Configuration class; None: no options, and a run uses every stream of the kind.
    dims : tuple of int
        Dimensions of graphs that can use it.
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
        """The instance of a graph; created at first use."""
        if cls.name not in graph.sensors:
            graph.sensors[cls.name] = cls(graph)
        found = graph.sensors[cls.name]
        assert isinstance(found, cls)
        return found

    @abstractmethod
    def add(self, readings: Any, *, stream: str | None = None, config: Any = None) -> list[int]:
        """Add readings, at any time and in any number; returns the ids of their factors."""

    def add_factors(self, submap: SubmapNode) -> None:  # noqa: B027
        """Add factors of readings that waited for this submap, which was just added to the graph."""

    def finish(self) -> None:  # noqa: B027
        """No more submaps follow: drop and count readings that still wait."""

    def remove(self, submap: SubmapNode) -> None:  # noqa: B027
        """Remove factors that are attached to a submap that is about to be removed."""

    def remove_unused(self, removed: FactorRecord) -> None:  # noqa: B027
        """Remove variables that have no factor left after one was removed."""

    def waiting_readings(self) -> int:
        """Number of readings that are not factors yet."""
        return 0
