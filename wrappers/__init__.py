"""Gymnasium wrappers: physics drawn per episode, physics of foreign MuJoCo environments, sensors, a recorder."""

from wrappers.adaptable import AdaptableEnv
from wrappers.distribution import DistributionVectorWrapper, DistributionWrapper
from wrappers.model_parameters import model_parameters
from wrappers.randomizable import RandomizablePhysics
from wrappers.record import RecordEpisodes
from wrappers.sensors import SensorDelay, SensorDropout, SensorNoise
from wrappers.start import StartFromObservation

__all__ = [
    "AdaptableEnv",
    "DistributionVectorWrapper",
    "DistributionWrapper",
    "RandomizablePhysics",
    "RecordEpisodes",
    "SensorDelay",
    "SensorDropout",
    "SensorNoise",
    "StartFromObservation",
    "model_parameters",
]
