"""Where embarrassingly parallel work is done: in this process, its threads, or as tasks of Ray on many machines.

Simulated rollouts of many ξ, candidate fits, cells of an experiment: each is a list of tasks for one function. An
:class:`Engine` maps the function over the tasks, and the results are the same whichever engine does it.
"""

from __future__ import annotations

import itertools
import os
import socket
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from queue import SimpleQueue
from textwrap import shorten
from threading import Thread
from typing import Any, Protocol, TypeVar
from urllib.parse import urlsplit

T = TypeVar("T")
R = TypeVar("R")
OnProgress = Callable[[int, int], None]
"""Called with how many tasks are done, and of how many."""
OnOutcome = Callable[[int, Any], None]
"""Called with the index of a task, and what it returned or the exception that it raised."""
_SECONDS_TO_CONNECT = 5.0


class FailedTasksError(RuntimeError):
    """Some tasks failed; all others were finished.

    Attributes:
        results: of all tasks in order, None where one failed.
        failures: index of a task -> what went wrong with it.
    """

    def __init__(self, tasks: Sequence[object], results: list[Any], failures: dict[int, Exception]):
        first, cause = next(iter(failures.items()))
        super().__init__(
            f"{len(failures)} of {len(tasks)} tasks failed, the first of them number {first}, "
            f"{shorten(repr(tasks[first]), 500)}: {type(cause).__name__}: {cause}"
        )
        self.results, self.failures = results, failures


class Engine(Protocol):
    """Maps a function over tasks.

    Attributes:
        num_threads: threads that one task may use, 0 for all cores. Results must not depend on it.
    """

    num_threads: int

    def map(
        self,
        function: Callable[..., R],
        tasks: Sequence[T],
        shared: tuple[object, ...] = (),
        on_outcome: OnOutcome | None = None,
    ) -> list[R]:
        """``[function(task, *shared) for task in tasks]``.

        Args:
            function: importable on every machine, and pure: no task may rely on what another one left behind.
            tasks: small ones; what they have in common belongs into ``shared``.
            shared: sent to a worker once, not once per task; it must not change afterwards. What it keeps to itself,
                such as open simulations, it may keep from task to task, also of later calls.
            on_outcome: called here as each task ends.

        Raises:
            FailedTasksError: after all other tasks, if some failed.
        """
        ...


def counted(progress: OnProgress, number: int, done: int = 0) -> OnOutcome:
    """Tells how many of a number of tasks are done, now and as each of those left to an engine ends."""
    progress(done, number)
    ended = itertools.count(done + 1)
    return lambda *_: progress(next(ended), number)


class LocalEngine:
    """Does one task after the other in this process; each may use all cores.

    Args:
        on_progress: called after each task.
    """

    num_threads = 0

    def __init__(self, on_progress: OnProgress | None = None):
        self._on_progress = on_progress

    def map(
        self,
        function: Callable[..., R],
        tasks: Sequence[T],
        shared: tuple[object, ...] = (),
        on_outcome: OnOutcome | None = None,
    ) -> list[R]:
        """See :meth:`Engine.map`."""
        return _collect(self._outcomes(function, tasks, shared), tasks, self._on_progress, on_outcome)

    def _outcomes(
        self, function: Callable[..., R], tasks: Sequence[T], shared: tuple[object, ...]
    ) -> Iterator[tuple[int, R | Exception]]:
        """Index of each task, and what it returned or raised, as they end."""
        for i, task in enumerate(tasks):
            yield i, _attempt(function, task, *shared)


class ThreadEngine(LocalEngine):
    """Does as many tasks at once as there are cores, each in a thread of this process.

    It pays where tasks simulate much and in small batches: what one does in Python, others simulate meanwhile. Each may
    use all cores, or those of the tasks that have ended would idle until the last one has.
    """

    def _outcomes(
        self, function: Callable[..., R], tasks: Sequence[T], shared: tuple[object, ...]
    ) -> Iterator[tuple[int, R | Exception]]:
        left, ended = deque(enumerate(tasks)), SimpleQueue[tuple[int, R | Exception]]()

        def work() -> None:
            while left:
                try:
                    i, task = left.popleft()
                except IndexError:  # another thread has taken the last one
                    return
                ended.put((i, _attempt(function, task, *shared)))

        for _ in range(min(os.cpu_count() or 1, len(tasks))):
            Thread(target=work, daemon=True).start()  # one that is no daemon would keep Ctrl-C waiting for its task
        try:
            for _ in tasks:
                yield ended.get()
        finally:
            left.clear()


class RayEngine:
    """Does the tasks as tasks of Ray (https://docs.ray.io), each on one core of any machine of its cluster.

    A task whose worker dies is started anew, up to ``max_retries`` times. Every machine needs this package, and for
    results that are the same bit by bit the same versions of it and of what it uses, and the same kind of processor.

    Args:
        address: of a cluster, as ``ray.init`` takes it; None for the one that this machine is part of, else for this
            machine alone. Without effect where ``ray.init`` was called before.
        on_progress: called after each task.
        max_retries: how often a task is started anew after its worker died.

    Raises:
        ImportError: without Ray.
        ConnectionError: after 5 s at most, if nothing answers at the address.
        ValueError: for an address that is none.
    """

    num_threads = 1

    def __init__(self, address: str | None = None, on_progress: OnProgress | None = None, max_retries: int = 3):
        try:
            import ray
        except ImportError:
            raise ImportError('the engine "ray" needs Ray: pip install "simopt-envs[ray]"') from None
        if not ray.is_initialized():
            _require_answer(address)
            ray.init(address=address, include_dashboard=False, log_to_driver=False)
        self._run: Any = ray.remote(num_cpus=1, max_retries=max_retries)(_run_in_worker)
        self._on_progress = on_progress
        self._sent: dict[int, tuple[object, Any]] = {}  # what the last call shared, by identity

    def map(
        self,
        function: Callable[..., R],
        tasks: Sequence[T],
        shared: tuple[object, ...] = (),
        on_outcome: OnOutcome | None = None,
    ) -> list[R]:
        """See :meth:`Engine.map`."""
        import ray

        self._sent = {id(x): self._sent.get(id(x)) or (x, ray.put(x)) for x in shared}
        references = [self._sent[id(x)][1] for x in shared]
        pending = {self._run.remote(function, task, references): i for i, task in enumerate(tasks)}
        try:
            return _collect(_finished(pending), tasks, self._on_progress, on_outcome)
        except BaseException:  # of all, Ctrl-C
            for reference in pending:
                ray.cancel(reference, force=True)
            raise


def _require_answer(address: str | None) -> None:
    """Raise where ``ray.init`` would wait for long: nothing listens at the address of the cluster."""
    address = address or os.environ.get("RAY_ADDRESS")
    if address in (None, "auto", "local"):
        return
    parts = urlsplit(address if "://" in address else f"//{address}")
    if not parts.hostname or not parts.port:
        raise ValueError(f"the address of a Ray cluster is HOST:PORT, auto or local, got {address!r}")
    try:
        socket.create_connection((parts.hostname, parts.port), _SECONDS_TO_CONNECT).close()
    except OSError as error:
        raise ConnectionError(f"no Ray cluster answers at {address}: {error}") from None


_received: dict[Any, object] = {}
"""In a worker: what its last task shared."""


def _run_in_worker(function: Callable[..., R], task: Any, references: list[Any]) -> R:
    import ray

    for gone in _received.keys() - set(references):
        del _received[gone]
    for new in set(references) - _received.keys():
        _received[new] = ray.get(new)
    return function(task, *(_received[reference] for reference in references))


def _finished(pending: dict[Any, int]) -> Iterator[tuple[int, Any]]:
    """Index and outcome of each task as they finish; ``pending`` keeps those that have not."""
    import ray

    while pending:
        for reference in ray.wait(list(pending))[0]:
            yield pending.pop(reference), _attempt(_get, reference)


def _get(reference: Any) -> Any:
    import ray

    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:  # holds the traceback as text
        raise error.cause from error


def _attempt(function: Callable[..., R], *arguments: Any) -> R | Exception:
    try:
        return function(*arguments)
    except Exception as error:
        return error


def _collect(
    outcomes: Iterator[tuple[int, Any]],
    tasks: Sequence[object],
    on_progress: OnProgress | None,
    on_outcome: OnOutcome | None,
) -> list[Any]:
    results: list[Any] = [None] * len(tasks)
    failures: dict[int, Exception] = {}
    for done, (i, outcome) in enumerate(outcomes, 1):
        if isinstance(outcome, Exception):
            failures[i] = outcome
        else:
            results[i] = outcome
        if on_outcome is not None:
            on_outcome(i, outcome)
        if on_progress is not None:
            on_progress(done, len(tasks))
    if failures:
        failures = dict(sorted(failures.items()))
        raise FailedTasksError(tasks, results, failures) from next(iter(failures.values()))
    return results
