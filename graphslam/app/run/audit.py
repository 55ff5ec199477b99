"""Check a run's data association against identities that it never saw: the simulator's, or published ones."""

from __future__ import annotations

import logging

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GraphSlamError
from graphslam.core.log import SensorLog
from graphslam.core.records import LandmarkObservations
from graphslam.evaluate.association import match_observations, pair_agreement
from graphslam.evaluate.metrics import Metrics
from graphslam.io.catalog import load_recording
from graphslam_frontends.base import FrontEnd

logger = logging.getLogger(__name__)
Ints = npt.NDArray[np.int64]

# log name -> (card that holds published identities, name of their reader)
PUBLISHED = {"victoria-park": ("victoria-park-detections", "slsjf-observations")}


def reference_labels(log: SensorLog, observations: LandmarkObservations) -> Ints | None:
    """Identity of every observation ``(q,)`` from the log itself or from published data; -1 = none; None = nowhere."""
    if observations.ids is not None and np.any(observations.ids >= 0):
        return observations.ids
    if log.name not in PUBLISHED:
        return None
    card, reader = PUBLISHED[log.name]
    try:
        published: LandmarkObservations = load_recording(card, reader=reader)
    except GraphSlamError as error:
        logger.info("association is not audited: %s", error)
        return None
    assert published.ids is not None
    rows = match_observations(
        np.repeat(observations.times, np.diff(observations.offsets)),
        observations.ranges,
        observations.bearings,
        np.repeat(published.times, np.diff(published.offsets)),
        published.ranges,
        published.bearings,
    )
    return np.where(rows >= 0, published.ids[rows], -1)


def reference_identities(log: SensorLog, front: FrontEnd) -> Ints | None:
    """Identity of every observation of a front end ``(q,)``, by a reference that it never saw; None = nowhere."""
    seen = front.observations(log)
    return None if seen is None else reference_labels(log, seen[1])


def audit_association(out: Metrics, reference: Ints, observation: Ints, landmark: Ints) -> None:
    """Pair precision and recall of the run's association.

    Parameters
    ----------
    reference : (q,)
        True identity of every observation of the stream; -1 = none.
    observation, landmark : (s,)
        Index of an observation in the stream, and the landmark of the map that it saw.
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
