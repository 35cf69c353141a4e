"""`OnRay`: a task of a Ray cluster for each job."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import socket
import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from sme_registry.errors import OptionError
from sme_registry.io import require_packages
from sme_registry.studies.engine.cell import run_cell
from sme_registry.studies.engine.executors import (
    POLL_SECONDS,
    ConcurrentExecutor,
    Outcome,
    ReportProgress,
    RunCell,
    failed,
    run_job,
)
from sme_registry.studies.engine.jobs import Job, available_cores

_RETRIES = 3  # of a cell whose worker or node is lost
_SECONDS_TO_ANSWER = 10.0
_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_task_oom_retries": str(_RETRIES),  # without it a cell too large is retried for ever
    "RAY_DEDUP_LOGS_SKIP_REGEX": ".",  # its notices of a lost node, dozens of lines each
}
_ADDRESSES = "Give 'local', or the host:port of a running cluster of this Ray version."


class OnRay(ConcurrentExecutor):
    """A task on one core of a Ray cluster for each job; one whose node is lost runs again."""

    def __init__(
        self,
        address: str = "local",
        jobs: int | None = None,
        run: RunCell = run_cell,
        keep_models: bool = False,
    ) -> None:
        super().__init__(jobs, run, keep_models)
        self._address, self._ray = address, _import_ray()
        self._connected_here = False  # then `map` disconnects
        if address != "local":  # now, so that a wrong one is refused before anything is written
            self._connect()

    @property
    def workers(self) -> int:
        """Jobs that can run at once: `jobs`, else the cluster's cores as of now."""
        if self._jobs is not None:
            return self._jobs
        if not self._ray.is_initialized():
            return available_cores()
        return max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    @contextlib.contextmanager
    def _session(self) -> Iterator[None]:
        self._connect()
        try:
            self._steps = _start_step_counts(self._ray)
            self._task = self._ray.remote(num_cpus=1, max_retries=_RETRIES)(_task)
            yield
        finally:
            for reference in self._running:
                self._ray.cancel(reference, force=True)
            self._running.clear()
            if self._connected_here:
                self._ray.shutdown()
                self._connected_here = False

    def _start(self, job: Job) -> None:
        if job.lanes is not None:
            job = replace(job, lanes=replace(job.lanes, state=None))
        task = self._task.remote(self._steps, self._run, job, self._keep_models)
        self._running[task] = job

    def _ended(self, progress: ReportProgress) -> Iterator[Outcome]:
        ready, _ = self._ray.wait(list(self._running), timeout=POLL_SECONDS)
        for reference in ready:
            yield from self._outcomes(reference, self._running.pop(reference))
        by_key = {job.cells[0].digest: job for job in self._running.values()}
        for key, reported in self._ray.get(self._steps.take.remote()).items():
            if key in by_key:
                progress(by_key[key], *reported)

    def _connect(self) -> None:
        """Connect, unless this process is connected already."""
        if self._ray.is_initialized():
            return
        options: dict[str, Any] = {"address": self._address}
        if self._address == "local":
            options |= {"num_cpus": self.workers, "include_dashboard": False}
        else:
            _refuse_unreachable(self._address)
        try:
            self._ray.init(**options, log_to_driver=False, logging_level=logging.ERROR)
        except Exception as error:  # of many kinds, by what is wrong with the address
            raise OptionError(
                f"ray={self._address!r}: cannot be used: {str(error).splitlines()[0]} {_ADDRESSES}"
            ) from None
        self._connected_here = True

    def _outcomes(self, reference: Any, job: Job) -> list[Outcome]:
        try:
            return [Outcome(*ended) for ended in self._ray.get(reference)]
        except self._ray.exceptions.RayError as error:
            text = str(error).strip()
            message = (
                f"{type(error).__name__}: lost {_RETRIES + 1} times: {text.splitlines()[0]} "
                "Run it again with --retry."
            )
            return [failed(cell, message, text) for cell in job.cells]


def _task(steps: Any, run: RunCell, job: Job, keep_models: bool) -> list[tuple[Any, ...]]:
    """Run one job on a Ray worker."""
    report = functools.partial(steps.put.remote, job.cells[0].digest)
    return [tuple(outcome) for outcome in run_job(run, job, keep_models, report)]


class _StepCounts:
    """A Ray actor to which workers report the steps they have done."""

    def __init__(self) -> None:
        self._steps: dict[str, tuple[Any, ...]] = {}

    def put(self, key: str, *reported: Any) -> None:
        self._steps[key] = reported

    def take(self) -> dict[str, tuple[Any, ...]]:
        steps, self._steps = self._steps, {}
        return steps


def _start_step_counts(ray: Any) -> Any:
    """The actor, on the driver's own node: if that is lost, so is the driver."""
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    here = ray.get_runtime_context().get_node_id()
    strategy = NodeAffinitySchedulingStrategy(node_id=here, soft=False)
    return ray.remote(num_cpus=0, scheduling_strategy=strategy)(_StepCounts).remote()


def _refuse_unreachable(address: str) -> None:
    """Raise if nothing answers at an address: Ray itself would try for many minutes."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), _SECONDS_TO_ANSWER).close()
    except (OSError, ValueError, OverflowError) as error:
        raise OptionError(f"ray={address!r}: cannot be reached: {error}. {_ADDRESSES}") from None


def _import_ray() -> Any:
    for name, value in _SETTINGS.items():
        os.environ.setdefault(name, value)
    instead = "leave out --ray to use processes on this machine"
    require_packages("a study on a cluster", {"ray": "Ray"}, "ray", otherwise=instead)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import ray
    return ray
