"""The gap workflow: where a model and recordings disagree, which effect is missing, and the model with it."""

from simopt_envs.gap.find import find_gap
from simopt_envs.gap.plain import Plain, plain_parameters
from simopt_envs.gap.result import Gap

__all__ = ["Gap", "Plain", "find_gap", "plain_parameters"]
