"""Gymnasium environments with randomizable physics, and the SimOpt loop that adapts them to a real system."""

from simopt_envs.registration import register_with_gymnasium

__version__ = "0.1.0"

register_with_gymnasium()
