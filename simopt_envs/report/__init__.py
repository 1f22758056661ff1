"""A run of SimOpt as one self-contained HTML page with its figures, and films of policies."""

try:
    import jinja2  # noqa: F401
    import matplotlib  # noqa: F401
except ImportError as error:
    raise ImportError(f'reports need {error.name}: pip install "simopt-envs[report]"') from error

from simopt_envs.report.page import Section, write_page
from simopt_envs.report.run import Details, Run
from simopt_envs.report.sections import write_report

__all__ = ["Details", "Run", "Section", "write_page", "write_report"]
