"""Kinds of factors, one file each, and their registration: a new kind is a file, which may register its own batch.

The order of the entries is the order of the blocks in a graph's arrays.
"""

from importlib import import_module
from pkgutil import iter_modules

from graphslam.graph.factors.attitude import AttitudeBatch
from graphslam.graph.factors.batch import register_factor
from graphslam.graph.factors.between import BetweenBatch
from graphslam.graph.factors.compass import CompassBatch, DeclinationBatch, DeviationPriorBatch
from graphslam.graph.factors.gps import BiasPriorBatch, GpsBatch
from graphslam.graph.factors.imu.batch import ForceBatch, GyroBatch, ImuBatch, ImuBiasBatch
from graphslam.graph.factors.landmark_submap import PathBatch, SubmapBatch
from graphslam.graph.factors.observation import ObservationBatch
from graphslam.graph.factors.range import BeaconRangeBatch, RangeBatch
from graphslam.graph.factors.sensor_biases import SensorBiasBatch
from graphslam.graph.factors.space_submap import SpaceSubmapBatch

for _batch in (
    *(SubmapBatch, SpaceSubmapBatch, PathBatch, SensorBiasBatch, BetweenBatch, GpsBatch, BiasPriorBatch, AttitudeBatch),
    *(ImuBatch, GyroBatch, ImuBiasBatch, ForceBatch),
    *(CompassBatch, DeclinationBatch, DeviationPriorBatch),
    *(RangeBatch, BeaconRangeBatch, ObservationBatch),
):
    register_factor(_batch)

for _module in iter_modules(__path__):  # the other files
    import_module(f"{__name__}.{_module.name}")
