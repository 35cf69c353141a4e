"""Scorers: processes that claim waiting submissions, score them and write the results.

A scorer may be killed at any point: another one claims its submission again, and if it was only
slow, its late result is rejected. A fault of the machine postpones the submission; others go on.
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
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from multiprocessing import connection
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import FrameType

from leaderboard.documents.result import Result
from leaderboard.errors import BoardError
from leaderboard.gate.isolation import Isolation
from leaderboard.scoring.score import Progress, score_submission
from leaderboard.store import Store
from leaderboard.store.queue import Claim
from sme_registry.errors import MissingDependencyError, SMEError
from sme_registry.io import integer_in
from sme_registry.io.system import block_interrupts, defer_interrupts, unblock_interrupts
from sme_registry.io.terminal import log_to_terminal

_POLL_SECONDS = 0.2
_STOP_SECONDS = 10.0
_FUTILE_DEATHS = 5  # of processes, for each worker, that claimed nothing
_FIRST_PAUSE, _LONGEST_PAUSE = 1.0, 300.0  # seconds, after which a served board's scoring restarts
# How long a scorer keeps a result that cannot be written: a command reports it, a server waits.
_UNWRITTEN_SECONDS, _UNWRITTEN_SECONDS_SERVED = 30.0, 3600.0
_log = logging.getLogger(__name__)


Job = Callable[[Store, str], None]
"""Does a job of the queue, by its id; may do it twice."""


@dataclass(frozen=True)
class Work:
    """What a scorer does: submissions, and jobs if it knows how; it can be pickled."""

    submissions: bool = True
    job: Job | None = None
    isolation: Isolation | None = None  # of policies; by default what the machine has
    board: type[Store] = Store  # one with further tracks needs their class


def worker_name() -> str:
    """A unique name for a scorer."""
    return f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(4)}"


def run_scorer(
    path: str | Path,
    *,
    worker: str | None = None,
    until_empty: bool = True,
    stop: Callable[[], bool] | None = None,
    retry: bool = True,
    work: Work = Work(),  # frozen
) -> int:
    """Score in this process, one submission after another; returns the number of results.

    A submission that cannot be scored because of a fault waits, with the fault in its `EntryRow`.
    If the board cannot be written to, a result is kept for a while before that is an error.
    """
    worker = worker_name() if worker is None else worker
    patience = _UNWRITTEN_SECONDS if until_empty else _UNWRITTEN_SECONDS_SERVED
    stop = stop or (lambda: False)
    written = 0
    with work.board.open(path) as store:
        if retry:
            store.queue.retry()
        while not stop():
            claim = store.queue.claim(
                worker, submissions=work.submissions, jobs=work.job is not None
            )
            if claim is None:
                if until_empty:
                    break
                time.sleep(_POLL_SECONDS)
                continue
            with _heartbeats(store, claim):
                if claim.is_job and work.job is not None:
                    _do(store, claim, work.job)
                else:
                    result = _score(store, claim, work.isolation)
                    written += result is not None and _finish(store, claim, result, patience, stop)
    return written


def _do(store: Store, claim: Claim, job: Job) -> None:
    """Do a job; after a fault it is postponed."""
    try:
        job(store, claim.id)
        store.queue.end_job(claim)
    except KeyboardInterrupt:
        store.queue.release(claim)
        raise
    except Exception as error:  # whose text may name what is hidden
        _log.warning("%s: attempt %d: %s", claim.id, claim.attempt, type(error).__name__)
        store.queue.release(claim, type(error).__name__)


def _score(store: Store, claim: Claim, isolation: Isolation | None) -> Result | None:
    """Score a claimed submission; None after a fault, which postpones it."""
    try:
        submission = store.submission(claim.id).content
        read = store.objects.read
        return score_submission(store.document, submission, read, isolation=isolation)
    except (MissingDependencyError, KeyboardInterrupt):
        store.queue.release(claim)
        raise
    except Exception as error:
        _log.warning("%s: attempt %d: %r", claim.id, claim.attempt, error, exc_info=True)
        text = str(error) if isinstance(error, SMEError) else f"{type(error).__name__}: {error}"
        store.queue.release(claim, text.replace(f"{store.folder.path}{os.sep}", ""))
        return None


def _finish(
    store: Store, claim: Claim, result: Result, patience: float, stop: Callable[[], bool]
) -> bool:
    """Write a result, and keep trying for so many seconds; False if the claim was lost."""
    deadline = time.monotonic() + patience
    while True:
        try:
            return store.queue.finish(claim, result)
        except (BoardError, KeyboardInterrupt) as error:
            is_last = time.monotonic() >= deadline or stop()
            if isinstance(error, KeyboardInterrupt) or is_last:
                with contextlib.suppress(BoardError):
                    store.queue.release(claim)
                raise
            _log.warning("%s: its result waits: %s", claim.id, error)
        time.sleep(_POLL_SECONDS)


@contextlib.contextmanager
def beside(name: str, work: Callable[[threading.Event], None]) -> Iterator[None]:
    """Let a thread work while the block runs; the event tells it to end."""
    stop = threading.Event()
    thread = threading.Thread(target=work, args=(stop,), name=name, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def _heartbeats(store: Store, claim: Claim) -> AbstractContextManager[None]:
    """Renew a claim from a thread, four times in its lifetime."""

    def beat(stop: threading.Event) -> None:
        while not stop.wait(claim.seconds / 4):
            with contextlib.suppress(SMEError):  # a full disk may have room the next time
                if not store.queue.heartbeat(claim):
                    return

    return beside(f"heartbeat of {claim.worker}", beat)


def background_scorers(
    path: str | Path, workers: int, work: Work = Work()
) -> AbstractContextManager[None]:
    """Run scorer processes while the block runs, watched by a thread.

    With 0 workers, one does jobs, if it knows how. Nothing but the end of the block ends the
    scoring: after an error it starts again, after growing pauses of up to five minutes.
    """
    if not workers and work.job is None:
        return contextlib.nullcontext()
    work = replace(work, submissions=workers > 0)

    def score(stop: threading.Event) -> None:
        pause = _FIRST_PAUSE
        while not stop.is_set():
            begun = time.monotonic()
            try:
                processes = max(workers, 1)
                run_scorers(path, processes, until_empty=False, stop=stop.is_set, work=work)
            except Exception as error:
                if time.monotonic() - begun > _LONGEST_PAUSE:
                    pause = _FIRST_PAUSE
                _log.exception("scoring starts again in %.0f s: %s", pause, error)
                stop.wait(pause)
                pause = min(2.0 * pause, _LONGEST_PAUSE)

    return beside("scorers", score)


def run_scorers(
    path: str | Path,
    workers: int,
    *,
    until_empty: bool = True,
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
    started: Callable[[int], None] | None = None,
    work: Work = Work(),  # frozen
) -> int:
    """Score in several processes at once; one that dies is replaced and its submission rescored.

    Returns the number of submissions done. With `until_empty`, it ends when nothing can be scored
    any more, even by another process. Ctrl-C stops all processes and releases their claims.
    """
    integer_in("workers", workers, 1, advice="Leave it out for one.")
    with work.board.open(path) as store:
        scorers = _Scorers(path, store, workers, (until_empty, work))
        before = store.queue.count("done")
        store.queue.retry()

        def report() -> int:
            done = store.queue.count("done") - before
            if progress is not None:
                progress(done, done + store.queue.count("waiting"))
            return done

        try:
            while not until_empty or scorers.are_needed():
                if stop and stop():
                    break
                for pid in scorers.fill():
                    if started is not None:
                        started(pid)
                scorers.watch()
                report()
        finally:
            scorers.stop()
        return report()  # one may have been done since the last


@dataclass(frozen=True)
class _Scorer:
    """A process, and the end of a pipe through which it sends the error that ended it."""

    process: BaseProcess
    errors: Connection


class _Scorers:
    """The scorer processes of one board, by name."""

    def __init__(
        self,
        path: str | Path,
        store: Store,
        workers: int,
        options: tuple[bool, Work],
    ) -> None:
        self._path, self._store, self._workers = path, store, workers
        self._options, self._until_empty = options, options[0]
        self._running: dict[str, _Scorer] = {}
        self._futile_deaths, self._done = 0, store.queue.count("done")
        self._stopping = False

    def are_needed(self) -> bool:
        """Whether a submission can be claimed, or is claimed, by a process of any command."""
        queue = self._store.queue
        return bool(queue.count("claimable") or queue.count("claimed"))

    def fill(self) -> Iterator[int]:
        """Start processes up to the number of workers or of submissions; yields their ids."""
        queue = self._store.queue
        while len(self._running) < self._workers and (
            not self._until_empty
            or (len(self._running) < queue.count("waiting") and queue.count("claimable"))
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
            args=(str(self._path), name, child_end, *self._options),
            name=name,
        )
        process.start()
        child_end.close()
        return _Scorer(process, errors)

    def watch(self) -> None:
        """Wait a moment, and remove the processes that have ended; an error if all fail."""
        sentinels = [scorer.process.sentinel for scorer in self._running.values()]
        connection.wait(sentinels, _POLL_SECONDS)
        deaths, error = self._remove_ended()
        if error is not None:
            raise error
        previously, self._done = self._done, self._store.queue.count("done")
        self._futile_deaths = 0 if self._done > previously else self._futile_deaths + deaths
        if deaths and self._futile_deaths >= _FUTILE_DEATHS * self._workers:
            raise BoardError(
                f"{self._path}: {self._futile_deaths} scorers died and claimed nothing. "
                "Check the system's log for the cause, such as a lack of memory."
            )

    def stop(self) -> None:
        """Interrupt all processes, and release their claims."""
        self._stopping = True
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

    def _remove_ended(self) -> tuple[int, SMEError | None]:
        """End the claims of ended processes; how many died for nothing, and the last error."""
        deaths, last_error = 0, None
        for name, scorer in list(self._running.items()):
            if scorer.process.is_alive():
                continue
            scorer.process.join()
            error = None
            with contextlib.suppress(EOFError), scorer.errors:
                if scorer.errors.poll():
                    error = scorer.errors.recv()
            code = scorer.process.exitcode
            fault = f"its scorer ended with status {code}" if code and not self._stopping else ""
            # Also if it exited normally: Ctrl-C may arrive just after it has claimed a submission.
            had_claim = self._store.queue.abandon(name, fault)
            if error is not None or (code != 0 and not had_claim):
                deaths += 1
                last_error = error or last_error
            scorer.process.close()
            del self._running[name]
        return deaths, last_error


def _scorer_process(
    path: str,
    worker: str,
    errors: Connection,
    until_empty: bool,
    work: Work,
) -> None:
    # A terminal sends Ctrl-C to parent and children, and the parent passes it on: the second one
    # must not disturb the clean-up.
    def interrupt_once(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, interrupt_once)
    log_to_terminal()
    parent = multiprocessing.parent_process()
    try:
        unblock_interrupts()
        run_scorer(
            path,
            worker=worker,
            until_empty=until_empty,
            stop=lambda: parent is not None and not parent.is_alive(),
            retry=False,
            work=work,
        )
    except KeyboardInterrupt:
        pass
    except SMEError as error:
        errors.send(error)
