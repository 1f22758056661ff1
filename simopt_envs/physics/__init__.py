"""Parameters of a simulation, and simulations of one or of many worlds."""

from simopt_envs.physics.parameters import Parameter, ParameterSpace, Write
from simopt_envs.physics.writer import ModelWriter

__all__ = ["ModelWriter", "Parameter", "ParameterSpace", "Write"]
