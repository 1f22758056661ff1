"""The paper's questions as experiments that anyone can run again.

    python -m baselines.experiments [QUESTION ...] [--quick] [--engine ray]

A question declares cells: one condition with one seed each, independent of each other. A cell's result is a JSON file;
what is finished is not run again, and what several cells need (a trained policy, a run of SimOpt) is made once. From
the results follow a table and a figure, with intervals.

| file | holds |
|---|---|
| ``randomization`` ... ``ablations`` | a question each: its cells, its table and figure |
| ``settings`` | what a cell may do: train under a p(ξ), cure by SimOpt, train on a single instance |
| ``fits`` | finding hidden physics without training, from fixed rollouts of a fixed policy |
| ``workspace`` | trainings and runs of SimOpt, kept on disk |
| ``environments``, ``targets`` | simulations, first p(ξ), hidden systems |
| ``cell``, ``runner`` | cells, their results on disk, running them |
| ``statistics``, ``drawing``, ``document`` | intervals, figures, and the page of a question |
"""

try:
    import matplotlib  # noqa: F401
    import rich  # noqa: F401
    import torch  # noqa: F401
    import tyro  # noqa: F401
except ImportError as error:
    raise ImportError(f'the experiments need {error.name}: pip install "simopt-envs[torch,report,cma]"') from error
