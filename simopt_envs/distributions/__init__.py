"""Probability distributions of ξ."""

from simopt_envs.distributions.distribution import Distribution, Sampler
from simopt_envs.distributions.draws import EpisodeDraws
from simopt_envs.distributions.gaussian import Gaussian
from simopt_envs.distributions.mixture import Mixture, distribution_from_dict
from simopt_envs.distributions.uniform import Uniform

__all__ = ["Distribution", "EpisodeDraws", "Gaussian", "Mixture", "Sampler", "Uniform", "distribution_from_dict"]
