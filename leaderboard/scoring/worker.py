"""Scorers: processes that claim waiting submissions, score them and write the results.

A scorer may be killed at any point: another one claims its submission again, and if it was only
slow, its late result is rejected.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import secrets
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing import connection
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import FrameType

from leaderboard.errors import BoardError, TamperedError
from leaderboard.scoring.score import Progress, score_submission
from leaderboard.store import LEASE_SECONDS, Claim, Store
from sme_registry.errors import MissingDependencyError, SMEError
from sme_registry.io import integer_in
from sme_registry.terminal.interrupts import (
    block_interrupts,
    defer_interrupts,
    unblock_interrupts,
)

_POLL_SECONDS = 0.2
_STOP_SECONDS = 10.0
_FUTILE_DEATHS = 5  # of processes, for each worker, with no submission finished in between
_log = logging.getLogger(__name__)


def worker_name() -> str:
    """A unique name for a scorer."""
    return f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(4)}"


def run_scorer(
    path: str | Path,
    *,
    worker: str | None = None,
    until_empty: bool = True,
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
    lease_seconds: float = LEASE_SECONDS,
) -> int:
    """Score in this process, one submission after another.

    Args:
      path: the board's folder.
      worker: the scorer's unique name; None for a new one.
      until_empty: return when nothing can be claimed; otherwise wait for more.
      progress: called while a submission is scored, with the states done and the states in all.
      stop: called between two submissions; True ends the scorer.
      lease_seconds: how long a claim outlives its scorer.

    Returns:
      The number of results written.

    Raises:
      BoardError: the board is not writable, an artefact is missing, or a reference row cannot be
        scored.
      TamperedError: a file of the board differs from the logged one.
    """
    worker = worker_name() if worker is None else worker
    written = 0
    with Store.open(path) as store:
        while not (stop and stop()):
            claim = store.queue.claim(worker, seconds=lease_seconds)
            if claim is not None:
                written += _score(store, claim, progress)
            elif until_empty:
                break
            else:
                time.sleep(_POLL_SECONDS)
    return written


def _score(store: Store, claim: Claim, progress: Progress | None) -> bool:
    """Score a claimed submission; return whether the claim was still current."""
    try:
        with _heartbeats(store, claim):
            submission = store.submission(claim.id).submission
            result = score_submission(store.document, submission, store.objects.read, progress)
    except (TamperedError, MissingDependencyError, KeyboardInterrupt):
        store.queue.release(claim)  # not the submission's fault
        raise
    except BoardError:
        # The machine's fault, or the effect of the policy on it: the claim counts as lost.
        store.queue.abandon(claim.worker)
        raise
    except Exception as error:
        _log.exception("%s: attempt %d failed", claim.id, claim.attempt)
        store.queue.abandon(claim.worker)
        entry = store.entry(claim.id)
        if entry is not None and entry.reference:  # never rejected
            raise BoardError(
                f"reference row {entry.method!r}: cannot be scored on this machine: "
                f"{type(error).__name__}: {error}. It keeps waiting: fix the fault and score again."
            ) from error
        return False
    return store.queue.finish(claim, result)


@contextlib.contextmanager
def _heartbeats(store: Store, claim: Claim) -> Iterator[None]:
    """Renew a claim from a thread, four times in its lifetime."""
    done = threading.Event()

    def beat() -> None:
        while not done.wait(claim.seconds / 4):
            with contextlib.suppress(BoardError):  # a full disk may have room the next time
                if not store.queue.heartbeat(claim):
                    return

    thread = threading.Thread(target=beat, name=f"heartbeat of {claim.worker}", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


@contextlib.contextmanager
def background_scorers(path: str | Path, workers: int) -> Iterator[None]:
    """Run scorer processes while the block runs, watched by a thread; 0 workers run none.

    An error that ends the scoring is logged.
    """
    if not workers:
        yield
        return
    stop = threading.Event()

    def score() -> None:
        try:
            run_scorers(path, workers, until_empty=False, stop=stop.is_set)
        except SMEError as error:
            _log.error("scoring has stopped: %s", error)

    thread = threading.Thread(target=score, name="scorers", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def run_scorers(
    path: str | Path,
    workers: int,
    *,
    until_empty: bool = True,
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
    started: Callable[[int], None] | None = None,
    lease_seconds: float = LEASE_SECONDS,
) -> int:
    """Score in several processes at once; one that dies is replaced and its submission rescored.

    Ctrl-C stops all of them and releases their claims.

    Args:
      path: the board's folder.
      workers: the largest number of processes.
      until_empty: return when nothing waits, even for another process; otherwise wait for more.
      progress: called with the submissions done since the start, and these plus those that wait.
      stop: called a few times a second; True ends the scoring.
      started: called with the process id of each new process.
      lease_seconds: how long a claim outlives its scorer if its death goes unnoticed.

    Returns:
      The number of submissions done since the start.

    Raises:
      OptionError: `workers` is below 1.
      BoardError: the board is not writable, or the processes die one after another and finish
        nothing.
      TamperedError: a file of the board differs from the logged one.
    """
    integer_in("workers", workers, 1, advice="Leave it out for one.")
    with Store.open(path) as store:
        scorers = _Scorers(path, store, workers, until_empty, lease_seconds)
        before, done = store.queue.done(), 0
        try:
            while (waiting := store.queue.waiting()) or not until_empty:
                if stop and stop():
                    break
                for pid in scorers.fill(waiting):
                    if started is not None:
                        started(pid)
                scorers.watch()
                done = store.queue.done() - before
                if progress is not None:
                    progress(done, done + store.queue.waiting())
        finally:
            scorers.stop()
    return done


@dataclass(frozen=True)
class _Scorer:
    """A process, and the end of a pipe through which it sends the error that ended it."""

    process: BaseProcess
    errors: Connection


class _Scorers:
    """The scorer processes of one board, by name."""

    def __init__(
        self, path: str | Path, store: Store, workers: int, until_empty: bool, lease_seconds: float
    ) -> None:
        self._path, self._store, self._workers = path, store, workers
        self._until_empty, self._lease_seconds = until_empty, lease_seconds
        self._running: dict[str, _Scorer] = {}
        self._futile_deaths, self._finished = 0, self._count_finished()

    def fill(self, waiting: int) -> Iterator[int]:
        """Start processes up to the number of workers, or of submissions that can be claimed.

        Yields:
          The process id of each.
        """
        while len(self._running) < self._workers and (
            not self._until_empty
            or (len(self._running) < waiting and self._store.queue.claimable())
        ):
            name = worker_name()
            with defer_interrupts(), block_interrupts():  # until the process is in `_running`
                scorer = self._running[name] = self._start(name)
            yield scorer.process.pid or 0

    def _start(self, name: str) -> _Scorer:
        # Not forked: this process may hold threads, connections and locks.
        context = multiprocessing.get_context("spawn")
        errors, child_end = context.Pipe(duplex=False)
        process = context.Process(
            target=_scorer_process,
            args=(str(self._path), name, self._until_empty, self._lease_seconds, child_end),
            name=name,
        )
        process.start()
        child_end.close()
        return _Scorer(process, errors)

    def watch(self) -> None:
        """Wait a moment, and remove the processes that have ended.

        Raises:
          BoardError, TamperedError: every further process would fail as these have.
        """
        sentinels = [scorer.process.sentinel for scorer in self._running.values()]
        connection.wait(sentinels, _POLL_SECONDS)
        deaths, error = self._remove_ended()
        if isinstance(error, (TamperedError, MissingDependencyError)):
            raise error
        previously, self._finished = self._finished, self._count_finished()
        self._futile_deaths = 0 if self._finished > previously else self._futile_deaths + deaths
        if self._futile_deaths >= _FUTILE_DEATHS * self._workers:
            raise error or BoardError(
                f"{self._path}: {self._futile_deaths} scorers died and finished nothing. "
                "Check the system's log for the cause, such as a lack of memory."
            )

    def stop(self) -> None:
        """Interrupt all processes, and release their claims."""
        processes = [scorer.process for scorer in self._running.values()]
        for process in processes:
            if process.pid is not None:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process.pid, signal.SIGINT)
        for process in processes:
            process.join(_STOP_SECONDS)
            if process.is_alive():
                process.kill()
                process.join()
        self._remove_ended()

    def _count_finished(self) -> int:
        """Submissions done, without those rejected because scorers died."""
        return self._store.queue.done() - self._store.queue.failed()

    def _remove_ended(self) -> tuple[int, SMEError | None]:
        """Release the claims of ended processes at once.

        Returns:
          The number that died or sent an error, and the last error.
        """
        deaths, last_error = 0, None
        for name, scorer in list(self._running.items()):
            if scorer.process.is_alive():
                continue
            scorer.process.join()
            error = None
            with contextlib.suppress(EOFError), scorer.errors:
                if scorer.errors.poll():
                    error = scorer.errors.recv()
            if error is not None or scorer.process.exitcode != 0:
                deaths += 1
                last_error = error or last_error
            # Also if it exited normally: Ctrl-C may arrive just after it has claimed a submission.
            self._store.queue.abandon(name)
            scorer.process.close()
            del self._running[name]
        return deaths, last_error


def _scorer_process(
    path: str, worker: str, until_empty: bool, lease_seconds: float, errors: Connection
) -> None:
    # A terminal sends Ctrl-C to parent and children, and the parent passes it on: the second one
    # must not disturb the clean-up.
    def interrupt_once(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, interrupt_once)
    parent = multiprocessing.parent_process()
    try:
        unblock_interrupts()
        run_scorer(
            path,
            worker=worker,
            until_empty=until_empty,
            stop=lambda: parent is not None and not parent.is_alive(),
            lease_seconds=lease_seconds,
        )
    except KeyboardInterrupt:
        pass
    except SMEError as error:
        errors.send(error)
