"""Trainers and experiments that compose `simopt_envs` and `wrappers`; nothing imports them."""
