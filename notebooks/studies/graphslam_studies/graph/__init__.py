"""Graphs of satellite navigation: pseudoranges, odometer, inertial start. Importing it registers their factors."""

from graphslam.graph.factors.batch import register_factor
from graphslam_studies.graph.odometer import OdometerBatch, OdometerPriorBatch
from graphslam_studies.graph.pseudorange import ClockBatch, PseudorangeBatch, SatelliteBiasBatch

for _batch in (PseudorangeBatch, ClockBatch, SatelliteBiasBatch, OdometerBatch, OdometerPriorBatch):
    register_factor(_batch)
