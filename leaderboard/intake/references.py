"""The reference rows: π* (regret 0) and the constant action ½ (regret 1), on every board."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from leaderboard.documents.checks import REFERENCE_FAMILY, THE_BOARD
from leaderboard.documents.signed import Receiver, Signed, SigningKey
from leaderboard.documents.submission import Artefact, Knowledge, Method, Run, Submission, Submitter
from leaderboard.gate.isolation import isolation_for_own
from leaderboard.gate.reference import constant_onnx, optimal_onnx
from leaderboard.intake.admission import admit
from leaderboard.store import Store
from sme_registry.io import sha256_of
from sme_registry.spec import SMESpec


class Reference(NamedTuple):
    """A reference policy; `onnx` makes its artefact for a spec."""

    name: str
    knowledge: Knowledge
    onnx: Callable[[SMESpec], bytes]
    statement: str


REFERENCES: tuple[Reference, ...] = (
    Reference(
        "optimal",
        "oracle",
        optimal_onnx,
        "The optimal policy, computed from the public specs. Its regret is 0.",
    ),
    Reference(
        "constant",
        "family",
        constant_onnx,
        "The action ½ in every state, the best policy that ignores its input. Its regret is 1.",
    ),
)


def submit_references(store: Store) -> list[str]:
    """Submit π* and the constant ½ through the pipeline that every policy takes.

    The board's own key signs them at the time when the board was opened. A row that exists is
    kept, so a board has one of each, however often this is called.

    Returns:
      The ids of `optimal` and `constant`.

    Raises:
      BoardError: the board's key is missing.
    """
    opened = store.log(0, 1)[0].time
    key = store.folder.signing_key()
    existing = {row.method: row.id for row in store.entries() if row.reference}
    ids = []
    for reference in REFERENCES:
        if reference.name in existing:  # another version of `onnx` would write other bytes
            ids.append(existing[reference.name])
            continue
        signed, artefacts = _submission(store, key, opened, reference)
        admit(
            store,
            signed,
            artefacts.__getitem__,
            isolation_for_own(),
        )
        ids.append(signed.id)
    return ids


def _submission(
    store: Store, key: SigningKey, opened: str, reference: Reference
) -> tuple[Signed[Submission], dict[str, bytes]]:
    """A reference row with one run on each instance, and its artefacts by digest."""
    artefacts: dict[str, bytes] = {}
    runs = []
    instances = store.document.instances
    for digest, (_, spec) in instances.items():
        data = reference.onnx(spec)
        sha256 = sha256_of(data)
        artefacts[sha256] = data
        runs.append(
            Run(spec=digest, seed=0, steps=0, artefact=Artefact(sha256=sha256, size=len(data)))
        )
    submission = Submission(
        track=store.document.track,
        suite=store.document.suite_reference,
        method=Method(
            name=reference.name,
            version="1",
            family=REFERENCE_FAMILY,
            knowledge=reference.knowledge,
        ),
        submitter=Submitter(name=THE_BOARD, key=key.public),
        created=opened,
        runs=tuple(runs),
        runs_started=dict(Counter(class_name for class_name, _ in instances.values())),
        statement=reference.statement,
    )
    return submission.signed(key, Receiver(key.public)), artefacts
