"""Text from elsewhere reaches no terminal as control characters: every command of both packages."""

import json
import logging
import os
import signal

import pytest
from typer.main import get_command
from typer.testing import CliRunner

import leaderboard.cli
import sme_registry.cli
from leaderboard.cli.submit import KEY_VARIABLE
from leaderboard.documents.signed import SigningKey
from sme_registry.io.system import hidden_in
from sme_registry.io.terminal import log_to_terminal
from tests.leaderboard.seasons.sealing import tiny_season
from tests.leaderboard.web import boards
from tests.leaderboard.web.test_client import bundle_of, scripted

HOSTILE = "\x1b[2J\x9b1m\u202ename\u200b\x07\u3164"
APPS = {"sme": sme_registry.cli.app, "sme-leaderboard": leaderboard.cli.app}


def leaves(group, path=()):
    """The commands of a group and of those in it, with their paths."""
    context = group.make_context(group.name, [], resilient_parsing=True)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if hasattr(command, "commands"):
            yield from leaves(command, (*path, name))
        else:
            yield (*path, name), command


COMMANDS = [
    pytest.param(program, path, command, id=" ".join((program, *path)))
    for program, app in APPS.items()
    for path, command in leaves(get_command(app))
]


def printed(program, *arguments):
    result = CliRunner().invoke(APPS[program], [*map(str, arguments)])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exc_info
    return result.output


def assert_clean(text):
    assert hidden_in(text) == set(), text
    assert text.isascii() or text.isprintable() or "\n" in text


@pytest.mark.parametrize(("program", "path", "command"), COMMANDS)
def test_no_argument_or_file_reaches_the_terminal_unchanged(
    program, path, command, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    evil = tmp_path / "evil.json"
    evil.write_text(json.dumps({HOSTILE: HOSTILE, "name": HOSTILE, "spec": {HOSTILE: 1}}))
    shown = printed(program, *path, *[HOSTILE] * 9)  # too many for any command
    shown += printed(program, *path, f"--{HOSTILE}")
    places = [each for each in command.params if each.param_type_name == "argument"]
    if places and "demo" not in path:
        needed = [
            part
            for each in command.params
            if each.param_type_name == "option" and each.required
            for part in (each.opts[0], HOSTILE)
        ]
        for value in (HOSTILE, evil, os.devnull):
            shown += printed(program, *path, *[value] * len(places), *needed)
    assert shown
    assert_clean(shown)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working directory, with a key."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(KEY_VARIABLE, str(tmp_path / "my.key"))
    SigningKey.generate().write("my.key")
    return tmp_path


def test_readers_of_a_board_s_folder_show_its_names_as_escapes(folder):
    """A folder from strangers holds names that no honest board accepts."""
    names = {"version": HOSTILE[:8], "submitter": HOSTILE, "statement": f"{HOSTILE}\n{HOSTILE}"}
    with boards.create(folder / "board", classes=1) as store:
        id = boards.submit(store, SigningKey.generate(), HOSTILE, [0.2] * 6, **names)
        refusal = "onnx_op", f"node {HOSTILE}"
        refused = boards.submit(store, SigningKey.generate(), HOSTILE, None, rejected=refusal)
        store.announce(tiny_season(title=HOSTILE))
    shown = [
        printed("sme-leaderboard", *line.split())
        for line in (
            "rank board",
            "rank board --csv",
            "rank board --latex",
            f"show board {id}",
            f"show board {refused}",
            "season show board sealed-offline",
        )
    ]
    for text in shown:
        assert_clean(text)
        assert r"\x1b" in text or "textbackslash{}x1b" in text
    for line in ("rank board --json", f"show board {id} --json"):
        text = printed("sme-leaderboard", *line.split())
        assert_clean(text)
        assert repr(HOSTILE)[1:-1] in str(json.loads(text))


def test_a_hostile_server_s_words_are_escapes_in_every_command_that_reaches_one(folder):
    with boards.create(folder / "board", classes=1) as store:
        bundle_of(folder / "bundle", store, SigningKey.generate())
    commands = (
        "submit bundle URL",
        "submit bundle URL --dry-run",
        f"show URL {'0' * 64}",
        f"withdraw URL {'0' * 64}",
        "ticket URL autumn --method X --submitter Y --out new.json",
        "answer URL ticket.json constant",
    )
    ticket = {
        "season": "autumn",
        "ticket": 1,
        "token": "0" * 64,
        "deadline": HOSTILE,
        "lanes": 1,
        "classes": [{"name": "deep", "setting": {}, "instances": 1, "budget": 9}],
        "signer": {"board": "0" * 64, "request": f"sha256:{'0' * 64}", "key": "1" * 64},
    }
    (folder / "ticket.json").write_text(json.dumps(ticket))
    words = {"code": "quota", "message": f"{HOSTILE}\nerror: forged"}
    for status, body in (
        (429, words),
        (500, {**words, "code": HOSTILE}),
        (200, {HOSTILE: HOSTILE, "id": HOSTILE, "key": HOSTILE}),
    ):
        answer = status, json.dumps(body).encode()
        with scripted(lambda *_, answer=answer: answer) as (url, _):
            for line in commands:
                shown = printed("sme-leaderboard", *line.replace("URL", url).split())
                assert_clean(shown)
                assert "\nerror: forged" not in shown
                assert r"\x1b" in shown or status == 200


def test_documents_of_the_core_show_foreign_text_as_escapes(folder):
    printed("sme", "new", "mine.json", "--description", "plain")
    file = json.loads((folder / "mine.json").read_text())
    (folder / "evil.json").write_text(json.dumps({**file, "description": HOSTILE}))
    for line in ("show evil.json", "show evil.json --json", "check evil.json"):
        assert_clean(printed("sme", *line.split()))


def test_logs_and_warnings_are_cleaned_too(capsys, monkeypatch):
    root = logging.getLogger()
    monkeypatch.setattr(root, "handlers", [])
    log_to_terminal()
    logging.getLogger("sme_registry.seasons.wire").warning("no answer: %s", HOSTILE)
    shown = capsys.readouterr().err
    assert_clean(shown)
    assert r"no answer: \x1b[2J" in shown


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes here")
def test_pipes_and_devices_are_refused_at_once(folder):
    """Where they were read, these commands waited for ever, or filled the memory."""

    def late(*_):
        raise AssertionError("the command waits")

    os.mkfifo(folder / "pipe")
    for name in ("bundle", "season", "challenges"):
        (folder / name).mkdir()
    with boards.create(folder / "board", classes=1):
        pass
    plan = {**tiny_season().to_dict()}
    (folder / "good").mkdir()
    (folder / "good" / "season.json").write_text(json.dumps(plan))
    before = signal.signal(signal.SIGALRM, late)
    for special in ("pipe", "/dev/zero", "/dev/stdin"):
        for name, within in (("submission.json", "bundle"), ("season.json", "season")):
            (folder / within / name).unlink(missing_ok=True)
            (folder / within / name).symlink_to(folder / special)
        for suffix in ("npy", "npz", "onnx", "zip"):
            for instance in ("deep-0", "deep-1"):
                (folder / f"{instance}.{suffix}").unlink(missing_ok=True)
                (folder / f"{instance}.{suffix}").symlink_to(folder / special)
        for line in (
            f"submit {special} board",
            "submit bundle board",
            f"submit bundle board --key {special}",
            f"season publish board {special}",
            "season publish board season",
            f"enter board {special} constant --method X --submitter Y",
            "enter board season constant --method X --submitter Y",
            f"enter board good {special} --method X --submitter Y",
            "enter board good {name}.npy --method X --submitter Y",
            "enter board good {name}.npz --method X --submitter Y",
            "enter board good {name}.onnx --method X --submitter Y",
            "enter board good {name}.zip --method X --submitter Y",
            f"enter board good constant --method X --submitter Y --key {special}",
            f"answer http://127.0.0.1:1 {special} constant",
            f"season new board {special}",
        ):
            signal.alarm(20)
            shown = printed("sme-leaderboard", *line.split())
            signal.alarm(0)
            assert "error:" in shown, line
    signal.signal(signal.SIGALRM, before)
