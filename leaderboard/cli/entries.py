"""`sme-leaderboard enter`: take part in a sealed-offline season."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape

from leaderboard.cli.options import (
    DEFAULT_KEY,
    ActionRange,
    BoardOrUrl,
    CodeLink,
    Family,
    KeyFile,
    MethodName,
    MethodVersion,
    SealedKnowledge,
    Statement,
    SubmitterName,
    answers_in,
    board_document,
    is_url,
    manifest_fields,
    policy_of_each,
    read_file,
)
from leaderboard.documents.keys import SigningKey
from sme_registry.errors import OptionError
from sme_registry.io import sha256_of
from sme_registry.io.terminal import Progress, err, out


def enter(
    board: BoardOrUrl,
    published: Annotated[
        Path,
        typer.Argument(metavar="SEASON", help="The folder with what the organiser published."),
    ],
    policy: Annotated[
        str,
        typer.Argument(
            metavar="POLICY",
            help="A policy as `sme evaluate` takes it, or an .npy file of actions in the challenge "
            "states. {name} stands for the instance, such as deep-0.",
        ),
    ],
    method: MethodName,
    submitter: SubmitterName,
    method_version: MethodVersion = "1",
    family: Family = None,
    knowledge: SealedKnowledge = "generic",
    failed: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="An instance without a policy; scores 1. Repeatable."),
    ] = None,
    action_range: ActionRange = None,
    code: CodeLink = None,
    statement: Statement = "",
    key: KeyFile = DEFAULT_KEY,
) -> None:
    """Answer the challenges of a sealed-offline season, and send the answers.

    Only arrays of actions are sent, and no policy. The last entry of your key and method before
    the close counts; nothing is scored before the reveal.

    Examples:

      sme-leaderboard enter board autumn '{name}.npz' --method IQL --submitter "A Lab"

      sme-leaderboard enter board autumn '{name}.npy' --method X --submitter Y --failed deep-3
    """
    from leaderboard import intake
    from leaderboard.documents.entry import Entry
    from leaderboard.scoring.publication import name_of, read_season
    from leaderboard.store import Store
    from leaderboard.web import client

    season, signing_key = read_season(published), SigningKey.read(key)
    hidden = {name_of(each): each.member.setting for each in season.hidden}
    without = failed or []
    for name in without:
        if name not in hidden:
            raise OptionError(f"failed={name!r}: must be one of {', '.join(hidden)}.")
    policies = policy_of_each(policy, hidden)
    files: list[bytes | None] = []
    with Progress("answering", len(hidden), console=err(), unit="instances") as progress:
        for done, (name, setting) in enumerate(hidden.items(), start=1):
            states = published / "challenges" / f"{name}.npy"
            files.append(
                None if name in without else _answers(policies[name], states, setting, action_range)
            )
            progress.update(done)
    digests = [None if data is None else sha256_of(data) for data in files]
    data = {name: each for name, each in zip(digests, files, strict=True) if name and each}
    entry = Entry.from_dict(
        {
            **manifest_fields(
                signing_key.public,
                method=(method, method_version, family, knowledge),
                submitter=submitter,
                code=code,
                statement=statement,
            ),
            "season": season.digest,
            "answers": [name and {"sha256": name, "size": len(data[name])} for name in digests],
        }
    )
    signed = entry.signed(signing_key, board_document(board).key)
    if is_url(board):
        with Progress("uploading", len(data), console=err(), unit="answers") as progress:
            client.enter(board, season.id, signed, data, signing_key, progress=progress.update_of)
    else:
        with Store.open(Path(board)) as store:
            intake.enter(store, signed, answers=data.__getitem__)
    out().print(signed.id, soft_wrap=True)
    err().print(
        f"The season closes at {season.closes}; until then a later entry of "
        f"{escape(method)} replaces this one.",
        soft_wrap=True,
    )


def _answers(policy: str, states: Path, setting: Any, action_range: str | None) -> bytes:
    """The file of answers: the given one, or a policy's actions in the challenge states."""
    from sme_registry.seasons import actions_in, prepare_policy
    from sme_registry.seasons.wire import pack_table, unpack_table

    given = answers_in(policy)
    if given is not None:
        return given
    prepared = prepare_policy(policy, setting, action_range=action_range)
    shown = unpack_table(read_file(states), setting.state_dim + 2)
    return pack_table(actions_in(shown, prepared, setting))
