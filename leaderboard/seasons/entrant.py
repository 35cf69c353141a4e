"""`sme-leaderboard ticket · answer · enter`: take part in a sealed season."""

from __future__ import annotations

import functools
import re
import secrets
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer
from rich.markup import escape

from leaderboard.admission import upload_header
from leaderboard.cli.results import BoardOrUrl, is_url
from leaderboard.cli.submit import (
    DEFAULT_KEY,
    CodeLink,
    Family,
    KeyFile,
    MethodName,
    MethodVersion,
    Statement,
    SubmitterName,
    own_key,
    receiver_of,
)
from leaderboard.documents.signed import Receiver, Signed, SigningKey
from leaderboard.documents.submission import Description
from leaderboard.errors import BoardError, Rejection
from leaderboard.seasons.publication import read_season
from leaderboard.seasons.scoring import enter as enter_folder
from leaderboard.seasons.season import Entry, Season, TicketRequest
from leaderboard.seasons.store import SeasonStore
from leaderboard.web.client import ServedBoard
from sme_registry.errors import OptionError, SpecError
from sme_registry.io import (
    check_new,
    check_writable,
    choice,
    read_regular,
    sha256_of,
    write_atomically,
)
from sme_registry.io.markup import Table, plural
from sme_registry.io.terminal import Progress, err, out
from sme_registry.seasons import WITHOUT_TASK, Instance, Ticket, actions_in, prepare_policy
from sme_registry.seasons.transcript import Signer
from sme_registry.seasons.wire import pack_table, tickets_path, unpack_table
from sme_registry.spec import Setting

app = typer.Typer()

_FILE_BYTES = 2**28  # of answers

_POLICY = typer.Argument(
    metavar="POLICY",
    help="A policy as `sme evaluate` takes it, or an .npy file of actions in the challenge states. "
    "{name} stands for the instance, such as deep-0.",
)
ActionRange = Annotated[
    str | None,
    typer.Option(metavar="RANGE", help="unit or symmetric; an SB3 model's own by default."),
]

Knowledge = Annotated[
    Literal["generic", "family"],
    typer.Option(
        metavar="LEVEL",
        help="What the method knows of the tasks. generic: nothing. family: that they are SMEs. "
        "The two are ranked apart.",
    ),
]

BoardUrl = Annotated[
    str, typer.Argument(metavar="URL", help="The URL of the board that serves the season.")
]


@app.command()
def ticket(
    url: BoardUrl,
    season: Annotated[str, typer.Argument(metavar="SEASON", help="The season's id.")],
    method: MethodName,
    submitter: SubmitterName,
    method_version: MethodVersion = "1",
    family: Family = None,
    knowledge: Knowledge = "generic",
    code: CodeLink = None,
    statement: Statement = "",
    out_file: Annotated[Path, typer.Option("--out", "-o", help="The ticket's new file.")] = Path(
        "ticket.json"
    ),
    key: KeyFile = DEFAULT_KEY,
) -> None:
    """Start a ticket: hidden tasks of a season, for you alone.

    Every ticket counts: instances without answers at its deadline score 1. The file holds the
    ticket's password. If the command is interrupted, repeat it: it asks for the same ticket.

    Examples:

      sme-leaderboard ticket https://board.example winter --method PPO --submitter "A Lab"
    """

    check_new(out_file)
    description = Description(method, submitter, method_version, family, knowledge, code, statement)
    signing_key = own_key(key)
    # Kept until the ticket is: a request that was sent and not answered may have started one.
    request_file = out_file.with_name(f"{out_file.name}.request")
    repeated = request_file.exists()
    season_digest, receiver = served_season(url, season)
    if repeated:
        signed = Signed[TicketRequest].read(read_file(request_file))
        if signed.content.season != season_digest:
            raise OptionError(
                f"{request_file}: asks for a ticket of another season, and may have started one. "
                "Repeat that command, or give another --out."
            )
        signed = signed.for_receiver(receiver, signing_key)
        err().print(f"Repeating {escape(str(request_file))}.", soft_wrap=True)
    else:
        nonce = secrets.token_hex(32)
        request = TicketRequest.from_dict(
            {
                **description.fields(signing_key.public),
                "season": season_digest,
                "nonce": nonce,
                "answers_key": signing_key.of_answers(nonce).public,
                "transcript": 1,
            }
        )
        signed = request.signed(signing_key, receiver)
        write_atomically(request_file, signed.to_bytes())
    try:
        started = request_ticket(url, season, signed, signing_key)
    except Rejection as rejection:
        # Refused is the request, which has started no ticket, or before it is looked for: its
        # sender, with another key or a wrong clock, or where it was sent to.
        unseen = "bad_signature", "stale_time", "season_unknown", "wrong_board"
        if not (repeated and rejection.code in unseen):
            request_file.unlink()
        raise
    started.write(out_file)
    request_file.unlink()

    table = Table(
        f"ticket {started.ticket} of {started.season}",
        {"number": "number", "instance": "name", "S": "number", "A": "number", "steps": "number"},
    )
    for number, place in enumerate(started.places):
        setting = place.member.setting
        sizes = setting.state_dim, setting.action_dim, place.member.budget
        table.add_row(str(number), place.name, *(f"{each:,}" for each in sizes))
    out().print(table)
    out().print(
        f"{escape(str(out_file))}: keep it secret. Answer by {escape(started.deadline)}.",
        soft_wrap=True,
    )


@app.command()
def answer(
    url: BoardUrl,
    ticket_file: Annotated[Path, typer.Argument(metavar="TICKET", help="The ticket's file.")],
    policy: Annotated[str | None, _POLICY] = None,
    instance: Annotated[
        list[str] | None,
        typer.Option(
            "--instance",
            "-i",
            metavar="NAME",
            help="Only this instance; repeatable. Default: all without answers.",
        ),
    ] = None,
    challenges: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Instead of answers: write the challenge states of each instance into this "
            "folder, for .npy files of actions.",
        ),
    ] = None,
    end_steps: Annotated[
        bool,
        typer.Option(
            "--end-steps", help="With --challenges: also of instances with steps left, for good."
        ),
    ] = False,
    action_range: ActionRange = None,
    algorithm: Annotated[
        str | None, typer.Option(help="Class of a .zip that does not tell it.")
    ] = None,
) -> None:
    """Answer the challenges of a ticket with trained policies.

    It ends the steps of each instance that it answers. The last answers end the ticket.

    Examples:

      sme-leaderboard answer https://board.example ticket.json 'runs/{name}/model.zip'

      sme-leaderboard answer https://board.example ticket.json policy.onnx --instance deep-0

      sme-leaderboard answer https://board.example ticket.json --challenges challenges

      sme-leaderboard answer https://board.example ticket.json 'actions/{name}.npy'
    """
    if (policy is None) == (challenges is None):
        raise OptionError("POLICY, --challenges: one of the two must be given.")
    held = Ticket.read(ticket_file)
    places = {place.name: number for number, place in enumerate(held.places)}
    with Instance(url, held) as first:
        phases = [each.phase for each in first.status().instances]
    for name in instance or ():
        choice("instance", name, places)
    chosen = instance or [name for name in places if phases[places[name]] != "answered"]
    stepped = [name for name in chosen if phases[places[name]] in ("waiting", "stepping")]
    if challenges is not None:
        if stepped and not end_steps:
            raise OptionError(
                f"{', '.join(stepped)}: steps are left, which the challenge ends for good. Add "
                "--end-steps if you want no more of them, or name other instances with --instance."
            )
        _write_challenges(url, held, {name: places[name] for name in chosen}, challenges)
        return
    assert policy is not None  # one of the two is given
    # All are loaded before the first instance's steps end for good.
    policies = {
        places[name]: _prepared(
            each, held.place(places[name]).member.setting, action_range, algorithm
        )
        for name, each in policy_of_each(policy, chosen).items()
    }
    blind = [name for name in stepped if isinstance(policies[places[name]], np.ndarray)]
    if blind:
        raise OptionError(
            f"{', '.join(blind)}: steps are left, so the challenge states are not known yet. Get "
            "them with --challenges FOLDER before you give .npy files of actions."
        )
    with Progress("answering", len(policies), console=err(), unit="instances") as progress:
        for done, (number, prepared) in enumerate(policies.items(), start=1):
            with Instance(url, held, number) as hidden:
                if not isinstance(prepared, np.ndarray):
                    prepared = actions_in(hidden.challenge(), prepared, hidden.setting)
                hidden.send_answers(prepared)
            progress.update(done)
    with Instance(url, held) as first:
        left = sum(each.phase != "answered" for each in first.status().instances)
        if left:
            text = f"{plural(left, 'instance')} without answers"
        elif first.end_ticket():
            text = "The ticket has ended."
        else:
            text = f"The ticket ends at {held.deadline}: some instances were answered elsewhere."
    out().print(escape(text))


def _prepared(
    policy: str, setting: Setting, action_range: str | None, algorithm: str | None = None
) -> Any:
    """A policy, or the array of actions in an .npy file."""
    if policy.endswith(".npy"):
        return unpack_table(read_file(Path(policy)), setting.action_dim)
    return prepare_policy(policy, setting, action_range=action_range, algorithm=algorithm)


def _write_challenges(url: str, ticket: Ticket, places: dict[str, int], folder: Path) -> None:
    check_writable(folder / "challenge.npy")
    with Progress("writing", len(places), console=err(), unit="challenges") as progress:
        for done, (name, number) in enumerate(places.items(), start=1):
            with Instance(url, ticket, number) as hidden:
                write_atomically(folder / f"{name}.npy", pack_table(hidden.challenge()))
            progress.update(done)
    out().print(f"{escape(str(folder))}: {len(places)} challenges", soft_wrap=True)


@app.command()
def enter(
    board: BoardOrUrl,
    published: Annotated[
        Path,
        typer.Argument(metavar="SEASON", help="The folder with what the organiser published."),
    ],
    policy: Annotated[str, _POLICY],
    method: MethodName,
    submitter: SubmitterName,
    method_version: MethodVersion = "1",
    family: Family = None,
    knowledge: Knowledge = "generic",
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

    description = Description(method, submitter, method_version, family, knowledge, code, statement)
    season, signing_key = read_season(published), own_key(key)
    hidden = {each.name: each.member.setting for each in season.hidden}
    without = failed or []
    for name in without:
        if name not in hidden:
            raise OptionError(f"failed={name!r}: must be one of {', '.join(hidden)}.")
    policies = policy_of_each(policy, hidden)
    files: dict[str, bytes] = {}
    with Progress("answering", len(hidden), console=err(), unit="instances") as progress:
        for done, (name, setting) in enumerate(hidden.items(), start=1):
            if name not in without:
                prepared = _prepared(policies[name], setting, action_range)
                if not isinstance(prepared, np.ndarray):
                    states = read_file(published / "challenges" / f"{name}.npy")
                    shown = unpack_table(states, setting.state_dim + 2)
                    prepared = actions_in(shown, prepared, setting)
                files[name] = pack_table(prepared)
            progress.update(done)
    named = {name: {"sha256": sha256_of(data), "size": len(data)} for name, data in files.items()}
    answers = {sha256_of(data): data for data in files.values()}
    entry = Entry.from_dict(
        {
            **description.fields(signing_key.public),
            "season": season.digest,
            "answers": [named.get(name) for name in hidden],
        }
    )
    signed = entry.signed(signing_key, receiver_of(board))
    if is_url(board):
        path, read = f"/api/seasons/{season.id}/entries", answers.__getitem__
        with (
            Progress("uploading", len(answers), console=err(), unit="answers") as progress,
            ServedBoard(board) as served,
        ):
            served.send(path, signed, answers, read, signing_key, progress.update)
    else:
        with SeasonStore.open(Path(board)) as store:
            enter_folder(store, signed, answers=answers.__getitem__)
    out().print(signed.id, soft_wrap=True)
    err().print(
        f"The season closes at {season.closes}; until then a later entry of "
        f"{escape(method)} replaces this one.",
        soft_wrap=True,
    )


def served_season(url: str, id: str) -> tuple[str, Receiver]:
    """The digest of a season of a served board, and for whom to sign what is sent to it."""
    if not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", id):
        raise OptionError(
            f"season={id!r:.80}: must be an id of letters, digits, '_' and '-'. Copy it from the "
            "board."
        )
    with ServedBoard(url) as served:
        answer = served.request("GET", f"/api/seasons/{id}")
        try:
            found = Season.from_dict(answer["document"], "season.json")
        except (SpecError, LookupError, TypeError) as error:
            raise BoardError(f"{url}: answered with no season: {error}") from None
        return found.digest, served.receiver()


def request_ticket(url: str, season: str, signed: Signed[TicketRequest], key: SigningKey) -> Ticket:
    """Start a ticket, or get the one that this request has started before, with its signer."""
    sign = functools.partial(upload_header, key, signed.id, signed.receiver)
    with ServedBoard(url) as served:
        answer = served.request("POST", tickets_path(season), signed.to_bytes(), sign)
    try:
        ticket = Ticket.from_dict(answer, "ticket")
    except SpecError as error:
        raise BoardError(f"{url}: answered with no ticket: {error}") from None
    return ticket.model_copy(update={"signer": signer_of(signed, key)})


def policy_of_each(policy: str, names: Collection[str]) -> dict[str, str]:
    """The policy of each instance, by its name, which replaces `{name}`."""
    if len(names) > 1 and "{name}" not in policy and policy not in WITHOUT_TASK:
        raise OptionError(
            f"policy={policy!r}: must contain {{name}}, the name of the instance, such as "
            f"{next(iter(names))}: each task has a policy of its own."
        )
    return {name: policy.replace("{name}", name) for name in names}


def read_file(path: Path) -> bytes:
    """The bytes of a file; raises `OptionError` if it cannot be read, as a pipe cannot."""
    try:
        return read_regular(path, _FILE_BYTES, links=True)
    except OSError as error:
        raise OptionError(f"{path}: cannot be read: {error.strerror}. Correct the path.") from None


def signer_of(request: Signed[TicketRequest], key: SigningKey) -> Signer | None:
    """What signs a ticket's transcripts, if the request names `SigningKey.of_answers` of a key."""
    answers = key.of_answers(request.content.nonce)
    if request.board is None or request.content.answers_key != answers.public:
        return None
    return Signer(
        board=request.board, address=request.address, request=request.id, key=answers.secret
    )
