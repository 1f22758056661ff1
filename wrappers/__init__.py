"""Gymnasium wrappers: physics drawn per episode, physics of foreign MuJoCo environments, sensors."""

from wrappers.distribution import DistributionVectorWrapper, DistributionWrapper
from wrappers.model_parameters import model_parameters
from wrappers.randomizable import RandomizablePhysics
from wrappers.sensors import SensorDelay, SensorDropout, SensorNoise

__all__ = [
    "DistributionVectorWrapper",
    "DistributionWrapper",
    "RandomizablePhysics",
    "SensorDelay",
    "SensorDropout",
    "SensorNoise",
    "model_parameters",
]
