"""Scorers: processes that claim what waits, score it and write what they found.

Each may be killed at any point: what it had claimed is claimed again by another one, and a scorer
that was only thought dead finds its result refused.
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
from leaderboard.scoring.score import score_submission
from leaderboard.store import LEASE_SECONDS, Claim, Store
from sme_registry.errors import MissingDependencyError, OptionError, SMEError
from sme_registry.terminal.interrupts import block_interrupts, defer_interrupts, unblock_interrupts

Progress = Callable[[int, int], None]

_LOOK_SECONDS = 0.2  # between two looks at the board
_STOP_SECONDS = 10.0
_BARREN_DEATHS = 5  # of processes, for each worker, without anything finished between them
_log = logging.getLogger(__name__)


def worker_name() -> str:
    """A name for a scorer that no other one has."""
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
      worker: a name that no other scorer has; None for a new one.
      until_empty: return where nothing can be claimed; else wait for more.
      progress: called while a submission is scored, with the states done and the states in all.
      stop: asked between two submissions whether to return.
      lease_seconds: how long a claim outlives its scorer.

    Returns:
      How many results were written.

    Raises:
      BoardError: the board cannot be written to, an artefact of it is gone, or a reference row
        cannot be scored.
      TamperedError: a file of the board is not what its log says.
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
                time.sleep(_LOOK_SECONDS)
    return written


def _score(store: Store, claim: Claim, progress: Progress | None) -> bool:
    """Score what was claimed; whether the result was still wanted."""
    try:
        with _heartbeats(store, claim):
            submission = store.submission(claim.id).submission
            result = score_submission(store.document, submission, store.objects.read, progress)
    except (TamperedError, MissingDependencyError, KeyboardInterrupt):
        store.queue.release(claim)  # nothing that the submission did
        raise
    except BoardError:
        # Perhaps the machine is at fault, perhaps what the policy did to it: it counts as lost.
        store.queue.abandon(claim.worker)
        raise
    except Exception as error:
        _log.exception("%s: attempt %d was lost", claim.id, claim.attempt)
        store.queue.abandon(claim.worker)
        entry = store.entry(claim.id)
        if entry is not None and entry.reference:  # which is never given up
            raise BoardError(
                f"reference row {entry.method!r}: cannot be scored here: "
                f"{type(error).__name__}: {error}. It waits: mend what fails, and score again."
            ) from error
        return False
    return store.queue.finish(claim, result)


@contextlib.contextmanager
def _heartbeats(store: Store, claim: Claim) -> Iterator[None]:
    """Renew a claim from a thread, four times while it would hold."""
    over = threading.Event()

    def beat() -> None:
        while not over.wait(claim.seconds / 4):
            with contextlib.suppress(BoardError):  # a full disk now may have room the next time
                if not store.queue.heartbeat(claim):
                    return

    thread = threading.Thread(target=beat, name=f"heartbeat of {claim.worker}", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@dataclass(frozen=True)
class _Scorer:
    """A process, and the end of a pipe through which it says why it gave up."""

    process: BaseProcess
    complaint: Connection


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
    """Score in several processes at once; one that dies is replaced, and its work done again.

    Ctrl-C stops them all, and gives back what they had claimed.

    Args:
      path: the board's folder.
      workers: how many processes at most.
      until_empty: return where nothing waits any more, wherever it is scored; else go on.
      progress: called with the submissions done meanwhile, and these with those that wait.
      stop: asked a few times in a second whether to return.
      started: called with the number of each new process.
      lease_seconds: how long a claim outlives its scorer, where nobody sees it die.

    Returns:
      How many submissions were done meanwhile.

    Raises:
      OptionError: no workers.
      BoardError: the board cannot be written to, or the processes die one after another and
        finish nothing.
      TamperedError: a file of the board is not what its log says.
    """
    if workers < 1:
        raise OptionError(f"workers={workers}: must be at least 1. Leave it out for one.")
    alive: dict[str, _Scorer] = {}
    with Store.open(path) as store:
        before, done = store.queue.done(), 0
        barren, judged = 0, _judged(store)
        try:
            while (left := store.queue.waiting()) or not until_empty:
                if stop and stop():
                    break
                while len(alive) < workers and (
                    not until_empty or (len(alive) < left and store.queue.claimable())
                ):
                    name = worker_name()
                    with defer_interrupts(), block_interrupts():  # or it would be nobody's
                        alive[name] = _start(path, name, until_empty, lease_seconds)
                    if started is not None:
                        started(alive[name].process.pid or 0)
                connection.wait([each.process.sentinel for each in alive.values()], _LOOK_SECONDS)
                died, complaint = _bury(store, alive)
                if isinstance(complaint, (TamperedError, MissingDependencyError)):
                    raise complaint  # the next scorer would find the same
                was, judged = judged, _judged(store)
                barren = 0 if judged > was else barren + died
                if barren >= _BARREN_DEATHS * workers:
                    raise complaint or BoardError(
                        f"{path}: {barren} scorers died and finished nothing. "
                        "See the system's log for what killed them, such as a lack of memory."
                    )
                done = store.queue.done() - before
                if progress is not None:
                    progress(done, done + store.queue.waiting())
        finally:
            _interrupt([scorer.process for scorer in alive.values()])
            _bury(store, alive)
    return done


def _judged(store: Store) -> int:
    """How many are done, those left out that scorers were lost over."""
    return store.queue.done() - store.queue.failed()


def _start(path: str | Path, name: str, until_empty: bool, lease_seconds: float) -> _Scorer:
    # Not forked: this process may hold threads, connections and locks.
    context = multiprocessing.get_context("spawn")
    complaint, child_end = context.Pipe(duplex=False)
    process = context.Process(
        target=_scorer_process,
        args=(str(path), name, until_empty, lease_seconds, child_end),
        name=name,
    )
    process.start()
    child_end.close()
    return _Scorer(process, complaint)


def _scorer_process(
    path: str, worker: str, until_empty: bool, lease_seconds: float, complaint: Connection
) -> None:
    # A terminal sends Ctrl-C to parent and children alike, and the parent passes it on: once is
    # enough, and the second must not disturb the tidying up.
    def interrupted(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, interrupted)
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
        complaint.send(error)


def _bury(store: Store, alive: dict[str, _Scorer]) -> tuple[int, SMEError | None]:
    """Give back at once what ended processes held.

    Returns:
      How many had died or complained, and the last complaint.
    """
    died, complaint = 0, None
    for name, scorer in list(alive.items()):
        if scorer.process.is_alive():
            continue
        scorer.process.join()
        said = None
        with contextlib.suppress(EOFError), scorer.complaint:
            if scorer.complaint.poll():
                said = scorer.complaint.recv()
        if said is not None or scorer.process.exitcode != 0:
            died += 1
            complaint = said or complaint
        # Also of one that ended well: Ctrl-C may have come between its claim and its knowing so.
        store.queue.abandon(name)
        scorer.process.close()
        del alive[name]
    return died, complaint


def _interrupt(processes: list[BaseProcess]) -> None:
    for process in processes:
        if process.pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGINT)
    for process in processes:
        process.join(_STOP_SECONDS)
        if process.is_alive():
            process.kill()
            process.join()
