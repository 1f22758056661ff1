"""The subcommands of ``simopt-envs``, each a dataclass of its arguments with ``run``."""
