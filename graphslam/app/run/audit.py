"""Check a run's data association against reference identities that it did not use: simulated or published ones."""

from __future__ import annotations

import logging

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GraphSlamError
from graphslam.core.log import SensorLog
from graphslam.core.plugins import plugins
from graphslam.evaluate.association import pair_agreement
from graphslam.evaluate.metrics import Metrics
from graphslam_frontends.base import FrontEnd

logger = logging.getLogger(__name__)
Ints = npt.NDArray[np.int64]


def reference_identities(log: SensorLog, front: FrontEnd) -> Ints | None:
    """Reference identity of every observation ``(q,)`` of a front end, not used by it; -1: none; None: no reference.

    From the log itself, or published for the log of that name (plug-ins ``graphslam.identities``).
    """
    seen = front.observations(log)
    if seen is None:
        return None
    observations = seen[1]
    if observations.ids is not None and np.any(observations.ids >= 0):
        return observations.ids
    published = plugins("graphslam.identities").get(log.name)
    try:
        return None if published is None else published.load()(observations)
    except GraphSlamError as error:
        logger.info("association is not audited: %s", error)
        return None


def audit_association(out: Metrics, reference: Ints, observation: Ints, landmark: Ints) -> None:
    """Pair precision and recall of the run's association.

    Parameters
    ----------
    reference : (q,)
        True identity of every observation of the stream; -1 = none.
    observation, landmark : (s,)
        Index of an observation in the stream, and the map landmark that it is associated with.
    """
    if len(observation) == 0:
        return
    labels = np.full(len(reference), -1, dtype=np.int64)
    labels[observation] = landmark
    agreement = pair_agreement(labels, reference)
    out.add("association_observations", agreement.observations)
    out.add("association_pair_precision", agreement.precision, "", "higher")
    out.add("association_pair_recall", agreement.recall, "", "higher")
    out.add("association_mixed_landmarks", agreement.mixed, "", "lower")
    out.add("association_split_landmarks", agreement.split, "", "lower")
