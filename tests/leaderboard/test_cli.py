"""The command line, as it is typed, from a key to a page; and its exit codes."""

from __future__ import annotations

import inspect
import json
import sqlite3
from pathlib import Path

import httpx
import pytest
from typer.testing import CliRunner, Result

from leaderboard.artefact import isolation
from leaderboard.cli import app
from leaderboard.cli.options import KEY_VARIABLE
from leaderboard.documents.board import hex_of
from leaderboard.documents.keys import SigningKey
from leaderboard.scoring.score import score_submission
from leaderboard.store import Store
from sme_registry import EvaluationProtocol, SMESpec
from sme_registry.io import sha256_of
from sme_registry.spec import ProtocolFile, SuiteFile
from tests.leaderboard.conftest import linear_onnx, tiny_suite
from tests.leaderboard.serving import serving

READERS = ("rank", "show", "verify")
KEEPERS = ("init", "score", "site", "serve", "reindex", "gc", "demo")
COMMANDS = ("keygen", "export-sb3", "new", "check", "submit", "withdraw", *READERS, *KEEPERS)


def board_command(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def good(*arguments: str | Path) -> str:
    result = board_command(*arguments)
    assert result.exit_code == 0, result.output
    return result.stdout


def fails(code: int, *arguments: str | Path) -> str:
    """The one line of a command that ends with this exit code."""
    result = board_command(*arguments)
    assert result.exit_code == code, result.output
    assert result.stderr.splitlines()[-1].startswith("error: ")
    assert "Traceback" not in result.output
    return result.stderr


@pytest.fixture(autouse=True)
def _home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An empty folder, a key and a small suite: all that a newcomer has."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setenv(KEY_VARIABLE, str(tmp_path / "my.key"))
    suite = tiny_suite()
    SuiteFile(name="tiny", version=1, digest=suite.digest, suite=suite).write("tiny-v1.json")
    protocol = EvaluationProtocol(states_per_region=200)
    ProtocolFile(name="small", version=1, digest=protocol.digest, protocol=protocol).write(
        "small-v1.json"
    )
    Path("policy.onnx").write_bytes(linear_onnx(300))
    spec: SMESpec = suite.instances[0]
    runs = [
        {"spec": spec.digest, "policy": "policy.onnx", "steps": 1000, "seed": 0},
        {"spec": spec.digest, "policy": None, "steps": 10, "seed": 1},
    ]
    Path("runs.json").write_text(json.dumps(runs))


def make_board() -> None:
    good(
        "init", "board", "--suite", "tiny-v1.json", "--protocol", "small-v1.json",
        "--runs-to-rank", "2",
    )  # fmt: skip


def make_bundle(name: str = "bundle", *more: str) -> str:
    """The submission's id."""
    return good(
        "new", name, "--runs", "runs.json", "--suite", "tiny-v1.json", "--method", "Linear",
        "--submitter", "A Lab", *more,
    ).split()[0]  # fmt: skip


def test_help_teaches_every_command_with_an_example() -> None:
    top = good("--help")
    for command in COMMANDS:
        assert command in top
        assert f"sme-leaderboard {command}" in good(command, "--help")


def test_help_prints_the_examples_unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Markdown would remove asterisks and angle brackets."""
    monkeypatch.setenv("COLUMNS", "80")
    for command in app.registered_commands:
        assert command.callback is not None
        examples = inspect.getdoc(command.callback).partition("Examples:")[2].split("\n\n")
        shown = " ".join(good(command.name, "--help").split())
        for example in filter(None, map(str.strip, examples)):
            assert example in shown


def test_scoring_refuses_a_broken_bubblewrap_and_warns_of_a_missing_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    make_board()
    broken = Path("bin/bwrap").absolute()
    broken.parent.mkdir()
    broken.write_text("#!/bin/sh\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("PATH", str(broken.parent))
    isolation._bwrap.cache_clear()
    assert "bubblewrap is installed" in fails(2, "score", "board")
    good("keygen")
    make_bundle()
    good("check", "bundle", "--suite", "tiny-v1.json", "--protocol", "small-v1.json")  # one's own
    assert isolation.isolation_for_own() == "process"
    broken.unlink()
    result = board_command("score", "board")
    assert result.exit_code == 0
    assert "bubblewrap is not installed" in " ".join(result.stderr.split())
    with Store.open("board", read_only=True) as store:
        kinds = {store.result(entry.id).isolation for entry in store.entries()}  # type: ignore[union-attr]
    assert kinds == {"process"}


def test_scoring_without_a_sandbox_can_be_asked_for() -> None:
    make_board()
    result = board_command("score", "board", "--unsafe-no-sandbox")
    assert (result.exit_code, "bubblewrap" in result.stderr) == (0, False)
    with Store.open("board", read_only=True) as store:
        kinds = {store.result(entry.id).isolation for entry in store.entries()}  # type: ignore[union-attr]
    assert kinds == {"process"}


def test_from_a_key_to_a_page() -> None:
    assert "public key" in good("keygen")
    make_board()
    id = make_bundle()
    checked = good("check", "bundle", "--suite", "tiny-v1.json", "--protocol", "small-v1.json")
    assert "WD regret" in checked

    assert good("submit", "bundle", "board").strip() == id
    assert good("submit", "bundle", "board").strip() == id  # twice is once
    assert good("score", "board").strip() == "3 scored."
    assert good("score", "board").strip() == "No submission is waiting."

    ranking = json.loads(good("rank", "board", "--json"))
    text = json.dumps(ranking)
    assert id in text
    assert "optimal" in text
    assert "Linear" in good("rank", "board")
    assert good("rank", "board", "--csv").count("\n") >= 4
    assert "tabular" in good("rank", "board", "--latex")

    shown = json.loads(good("show", "board", id, "--json"))
    # One of its two runs failed, and scores 1: the IQM of two is their mean.
    alone = shown["result"]["runs"][0]["wd_regret"]
    assert shown["result"]["scores"]["wd_regret"]["value"] == pytest.approx((alone + 1.0) / 2)
    assert "A Lab" in good("show", "board", id.removeprefix("sha256:")[:8])

    assert "Verified" in good("verify", "board", "--rescore", "1")
    page = Path(good("site", "board", "--out", "public").strip())
    assert page == Path("public/index.html").resolve()
    assert "Linear" in page.read_text()

    good("withdraw", "board", id, "--reason", "a bug")
    assert id not in json.dumps(json.loads(good("rank", "board", "--json")))
    assert "withdrawn" in fails(1, "submit", "bundle", "board")


def test_check_and_board_compute_the_same_scores() -> None:
    good("keygen")
    make_board()
    id = make_bundle()
    here = ("--suite", "tiny-v1.json", "--protocol", "small-v1.json")
    at_home = json.loads(good("check", "bundle", *here, "--json"))
    good("submit", "bundle", "board")
    good("score", "board")
    on_board = json.loads(good("show", "board", id, "--json"))["result"]
    for run in (*at_home["runs"], *on_board["runs"]):
        run.pop("rounding", None)  # measured on random states
    for field in ("scores", "runs", "classes", "suite", "protocol"):
        assert at_home[field] == on_board[field]


def test_a_rejection_exits_with_1_and_its_code() -> None:
    good("keygen")
    make_board()
    Path("policy.onnx").write_bytes(b"not a model")
    new = ("new", "bundle", "--runs", "runs.json", "--suite", "tiny-v1.json")
    assert "onnx_malformed" in fails(1, *new, "--method", "M", "--submitter", "S")
    assert not Path("bundle").exists()

    Path("policy.onnx").write_bytes(linear_onnx(300))
    make_bundle()
    next(Path("bundle/artefacts").iterdir()).write_bytes(linear_onnx(301))
    assert "artefact_digest" in fails(1, "submit", "bundle", "board")
    assert "artefact_digest" in fails(1, "check", "bundle", "--suite", "tiny-v1.json")


def test_invalid_usage_exits_with_2() -> None:
    good("keygen")
    assert "already exists" in fails(2, "keygen")
    assert "init" in fails(2, "rank", "nowhere")
    assert "no such folder" in fails(
        2, "new", "b", "--runs", "runs/*", "--method", "M", "--submitter", "S"
    )
    assert "knowledge" in fails(
        2, "new", "b", "--runs", "runs.json", "--method", "M", "--submitter", "S",
        "--knowledge", "much", "--suite", "tiny-v1.json",
    )  # fmt: skip
    assert "CLASS=N" in fails(
        2, "new", "b", "--runs", "runs.json", "--method", "M", "--submitter", "S",
        "--started", "many", "--suite", "tiny-v1.json",
    )  # fmt: skip
    make_board()
    assert "at most one" in fails(2, "rank", "board", "--json", "--csv")
    assert "new folder" in fails(2, "init", "board", "--suite", "tiny-v1.json")
    assert "no submission" in fails(2, "show", "board", "abcdef0123")


@pytest.mark.parametrize("command", ["verify", "score", "site", "serve", "reindex", "gc"])
def test_a_url_is_no_folder(command: str) -> None:
    assert "Open the URL" in fails(2, command, "http://127.0.0.1:8000")


@pytest.mark.parametrize(
    ("board", "advice"),
    [
        ("http://127.0.0.1:8000", "Open the URL"),
        ("board/board.json", "Give the folder"),
        ("tiny-v1.json", "is a file"),
        ("127.0.0.1:8000", "http://127.0.0.1:8000"),
        ("core", "init board --suite core"),
        ("nowhere", "no such folder"),
        ("empty", "contains no board"),
    ],
)
def test_what_is_no_board_is_refused_with_advice(board: str, advice: str) -> None:
    make_board()
    Path("empty").mkdir()
    before = sorted(Path().rglob("*"))
    assert advice in fails(2, "rank", board)
    assert sorted(Path().rglob("*")) == before


@pytest.mark.parametrize("command", ["submit", "withdraw", "show", "check"])
@pytest.mark.parametrize(
    ("board", "advice"),
    [("localhost:8000", "http://localhost:8000"), ("smoke-v1", "--suite smoke"), ("x", "folder")],
)
def test_commands_that_accept_a_url_say_what_is_wrong_with_another_board(
    command: str, board: str, advice: str
) -> None:
    arguments = (board, "abcd") if command in ("withdraw", "show") else ("bundle", board)
    assert advice in fails(2, command, *arguments)


@pytest.mark.parametrize(
    ("board", "advice"),
    [
        ("core", "init board --suite core"),
        ("core-v1", "init board --suite core"),
        ("http://127.0.0.1:8000", "serve"),
        ("tiny-v1.json", "init board --suite tiny-v1.json"),
    ],
)
def test_init_creates_no_board_where_something_else_was_meant(board: str, advice: str) -> None:
    before = sorted(Path().rglob("*"))
    assert advice in fails(2, "init", board)
    assert sorted(Path().rglob("*")) == before


def test_a_folder_may_have_the_name_of_a_suite() -> None:
    good("init", "./core", "--suite", "tiny-v1.json", "--protocol", "small-v1.json")
    assert Store.open("core", read_only=True).document.suite_name == "tiny-v1"
    assert "waiting" in fails(2, "rank", "core")


def test_a_practice_board_ranks_few_runs_and_says_so() -> None:
    good("keygen")
    created = good("init", "board", "--suite", "tiny-v1.json", "--practice")
    assert "practice" in created
    with Store.open("board", read_only=True) as store:
        assert (store.document.runs_to_rank, store.document.protocol_name) == (1, "quick-v1")
        assert store.document.runs_needed == 1
        assert store.document.practice
    make_bundle()
    assert "without a rank" not in good("check", "bundle", "board")
    good("submit", "bundle", "board")
    good("score", "board")
    ranking = json.loads(good("rank", "board", "--json"))
    assert ranking["runs_to_rank"] == 1
    assert [row["first"] for row in ranking["rows"] if row["method"] == "Linear"] == [1]
    assert "practice" in good("rank", "board")
    good("site", "board", "--out", "public")
    assert "practice board" in Path("public/index.html").read_text()


def test_a_board_says_at_its_creation_how_many_runs_a_rank_needs() -> None:
    created = good("init", "board", "--suite", "smoke")
    with Store.open("board", read_only=True) as store:
        assert store.document.runs_needed == 30
        assert not store.document.practice
    assert "30 trained policies" in created
    assert "practice" not in created


def test_check_scores_as_the_board_that_is_given() -> None:
    good("keygen")
    make_board()
    make_bundle()
    at_home = json.loads(good("check", "bundle", "board", "--json"))
    assert at_home["enough_runs"]  # two runs suffice on this board, and ten elsewhere
    with Store.open("board", read_only=True) as store:
        assert at_home["protocol"] == store.document.protocol.digest
    message = fails(2, "check", "bundle", "board", "--protocol", "small-v1.json")
    assert "BOARD has both" in message


def test_init_mentions_that_a_server_scores_the_reference_rows() -> None:
    created = good("init", "board", "--suite", "tiny-v1.json")
    assert "sme-leaderboard serve board" in created
    assert "sme-leaderboard score board" in created


@pytest.mark.parametrize("command", ["withdraw", "show"])
def test_help_says_that_a_url_needs_the_full_id(command: str) -> None:
    shown = " ".join(good(command, "--help").replace("│", " ").split())
    assert "in full for a URL" in shown
    assert f"sme-leaderboard {command} https://board.example sha256:" in shown


def test_a_board_keeps_the_description_and_tags_of_its_suite() -> None:
    suite = tiny_suite()
    file = SuiteFile(
        name="tiny",
        version=1,
        description="Our lab's suite.",
        tags=("ours",),
        digest=suite.digest,
        suite=suite,
    )
    file.write("described.json")
    good("init", "board", "--suite", "described.json")
    with serving(Path("board")) as url:
        served = httpx.get(f"{url}/suite.json").json()
    assert SuiteFile.from_dict(served) == file
    good("init", "again", "--suite", "board")
    assert json.loads(Path("again/board.json").read_text())["suite_tags"] == ["ours"]


def test_a_board_without_a_description_has_no_field_for_it() -> None:
    make_board()
    assert not [
        name for name in json.loads(Path("board/board.json").read_text()) if "suite_d" in name
    ]


def test_a_bundle_for_one_board_is_accepted_there_only() -> None:
    good("keygen")
    make_board()
    good("init", "other", "--suite", "tiny-v1.json", "--protocol", "small-v1.json")
    arguments = ("--runs", "runs.json", "--method", "Linear", "--submitter", "A Lab")
    assert "--suite" in fails(
        2, "new", "bundle", "--board", "board", "--suite", "tiny-v1.json", *arguments
    )
    id = good("new", "bundle", "--board", "board", *arguments).split()[0]
    assert "wrong_board" in fails(1, "submit", "bundle", "other")
    assert good("submit", "bundle", "board").strip() == id
    unbound = make_bundle("unbound")
    for board in ("board", "other"):  # signed anew for each
        assert good("submit", "unbound", board).strip() == unbound


def test_everything_a_submitter_needs_is_at_the_boards_address() -> None:
    good("keygen")
    make_board()
    with serving(Path("board")) as url:
        id = good(
            "new", "bundle", "--runs", "runs.json", "--suite", url, "--method", "Linear",
            "--submitter", "A Lab",
        ).split()[0]  # fmt: skip
        assert json.loads(good("check", "bundle", url, "--json"))["enough_runs"]
        sent = board_command("submit", "bundle", url)
        assert (sent.exit_code, sent.stdout.strip()) == (0, id)
        assert f"{url}/submissions/{hex_of(id)}" in sent.stderr
        assert f"sme-leaderboard show {url} {id}" in sent.stderr
        assert "waiting" in good("show", url, id)
        good("score", "board")
        assert "WD regret" in good("show", url, id)
        remote = json.loads(good("show", url, id, "--json"))
        good("withdraw", url, id)
        assert "withdrawn" in good("show", url, id)
    assert remote["result"]["scores"]["wd_regret"]["value"] > 0
    good("site", "board", "--out", "public")
    assert SuiteFile.read("public/suite.json") == SuiteFile.read("tiny-v1.json")
    assert json.loads(Path("public/definition.json").read_text())["runs_to_rank"] == 2


def test_a_board_whose_references_wait_shows_nothing() -> None:
    make_board()
    assert "reference" in fails(2, "rank", "board")
    assert "reference" in fails(2, "site", "board")
    assert not Path("board/site/index.html").exists()


def test_score_lists_what_it_could_not_score_and_why() -> None:
    good("keygen")
    make_board()
    id = make_bundle()
    good("submit", "bundle", "board")
    with Store.open("board", read_only=True) as store:
        run = next(run for run in store.submission(id).submission.runs if run.artefact)
        path = store.folder.object(run.artefact.sha256)
    artefact = path.read_bytes()
    path.write_bytes(b"damaged")
    for attempts in (2, 3):
        result = board_command("score", "board")
        assert result.exit_code == 1
        (line,) = [line for line in result.stderr.splitlines() if id in line]
        assert f"{attempts} attempts" in line
        assert f"objects/{path.parent.name}/{path.name}" in line
        assert str(Path.cwd()) not in line
        assert "1 waiting" in result.stdout
    assert "optimal" in good("rank", "board")  # the others were scored
    path.write_bytes(artefact)
    assert "1 scored" in good("score", "board")
    assert "No submission is waiting" in good("score", "board")


def test_show_withholds_scores_until_the_references_are_right_with_the_reason() -> None:
    good("keygen")
    make_board()
    id = make_bundle()
    good("submit", "bundle", "board")
    with Store.open("board") as store:
        claims = [store.queue.claim(f"worker {number}") for number in range(3)]
        assert claims[2] is not None
        assert claims[2].id == id
        submission = store.submission(id).submission
        result = score_submission(store.document, submission, store.objects.read)
        assert store.queue.finish(claims[2], result)
        for claim in claims[:2]:
            assert claim is not None
            store.queue.release(claim)
    shown = good("show", "board", id)
    assert "scored" in shown
    assert "reference row 'optimal': waiting" in shown
    assert "regret" not in shown
    plain = json.loads(good("show", "board", id, "--json"))
    assert (plain["status"], plain["result"]) == ("scored", None)
    assert "'optimal'" in plain["withheld"]

    good("score", "board")
    assert "WD regret" in good("show", "board", id)
    plain = json.loads(good("show", "board", id, "--json"))
    assert plain["result"]["scores"]["wd_regret"]["value"] > 0
    assert plain["withheld"] == ""


def test_show_prints_the_reason_for_a_withdrawal() -> None:
    good("keygen")
    make_board()
    id = make_bundle()
    good("submit", "bundle", "board")
    assert "withdrawn" not in good("show", "board", id)
    good("withdraw", "board", id, "--reason", "a bug in [bold]the wrapper[/]")
    assert "a bug in [bold]the wrapper[/]" in good("show", "board", id)
    plain = json.loads(good("show", "board", id, "--json"))
    assert plain["withdrawal"]["withdrawal"]["reason"] == "a bug in [bold]the wrapper[/]"


def test_an_altered_result_exits_with_3_and_is_named() -> None:
    make_board()
    good("score", "board")
    path = sorted(Path("board/results").iterdir())[0]
    path.write_text(path.read_text().replace('"wd_regret"', '"dw"', 1))
    assert path.name in fails(3, "verify", "board")


def test_the_digest_that_verify_prints_is_found_in_the_log_later() -> None:
    make_board()
    kept = json.loads(good("verify", "board", "--json"))["log_digest"]
    assert kept in good("verify", "board")
    good("score", "board")
    assert "Verified" in good("verify", "board", "--contains", kept)
    assert "cut or rewritten" in " ".join(
        fails(3, "verify", "board", "--contains", "sha256:" + "0" * 64).split()
    )
    assert "contains=" in fails(2, "verify", "board", "--contains", "3f2a")


def test_score_reports_its_own_submissions() -> None:
    good("keygen")
    make_board()
    assert good("score", "board").strip() == "2 scored."
    make_bundle()
    good("submit", "bundle", "board")
    assert good("score", "board").strip() == "1 scored. Done before: 2."


def test_a_board_without_its_key_accepts_nothing() -> None:
    good("keygen")
    make_board()
    make_bundle()
    Path("board/board.key").unlink()
    before = sorted(Path("board/objects").rglob("*"))
    message = fails(2, "submit", "bundle", "board")
    assert "without the board's key" in " ".join(message.split())
    assert "keygen" not in message
    assert sorted(Path("board/objects").rglob("*")) == before


def test_the_index_comes_back_from_the_files(monkeypatch: pytest.MonkeyPatch) -> None:
    # A ranking says when it was written, to the second.
    monkeypatch.setattr("leaderboard.exports.now", lambda: "2026-01-01T00:00:00Z")
    good("keygen")
    make_board()
    make_bundle()
    good("submit", "bundle", "board")
    good("score", "board")
    before = good("rank", "board", "--csv")
    for path in Path("board").glob("index.sqlite*"):
        path.unlink()
    assert "Indexed 3 entries" in good("reindex", "board")
    assert good("rank", "board", "--csv") == before
    with sqlite3.connect("board/index.sqlite") as index:
        assert index.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    index.close()


def test_gc_removes_unnamed_artefacts_and_a_dry_run_only_counts_them() -> None:
    make_board()
    key = SigningKey.generate()
    data = linear_onnx(1)
    digest = sha256_of(data)
    with Store.open("board") as store:
        store.put_object(digest, [data], by=key.public)
    assert "1 files" in good("gc", "board", "--older-than-hours", "0", "--dry-run")
    with Store.open("board") as store:
        assert store.objects.has(digest)
    good("gc", "board", "--older-than-hours", "0")
    with Store.open("board") as store:
        assert not store.objects.has(digest)
    good("score", "board")
    assert "Verified" in good("verify", "board")


@pytest.fixture
def trained() -> Path:
    """A run of a few steps."""
    from sme_registry.training import train

    train(
        {"state_dim": 2, "action_dim": 1}, algorithm="A2C", steps=64, folder="run",
        protocol={"states_per_region": 200}, progress=False,
    )  # fmt: skip
    return Path("run")


def test_a_demonstration_replaces_an_earlier_one_and_nothing_else(trained: Path) -> None:
    good("demo", trained)
    demonstrated = Path("run/leaderboard")
    first = (demonstrated / "board" / "board.key").read_text()
    (demonstrated / "site" / "extra.html").write_text("of the earlier one")
    good("demo", trained)
    assert (demonstrated / "board" / "board.key").read_text() != first
    assert not (demonstrated / "site" / "extra.html").exists()

    make_board()
    Path("bundles/bundle").mkdir(parents=True)
    Path("bundles/bundle/mine.txt").write_text("kept")
    Path("pages/site").mkdir(parents=True)
    Path("linked").mkdir()
    Path("linked/board").symlink_to(demonstrated.resolve() / "board")
    for name, folder in (
        ("board", "."),
        ("bundle", "bundles"),
        ("site", "pages"),
        ("board", "linked"),
    ):
        before = {path: path.stat().st_mtime_ns for path in Path().rglob("*")}
        message = fails(2, "demo", trained, "--out", folder)
        assert f"{Path(folder) / name}: already exists" in " ".join(message.split())
        assert "Nothing was removed" in message
        assert {path: path.stat().st_mtime_ns for path in Path().rglob("*")} == before


@pytest.mark.parametrize("name", ["submit", "verify", "score", "rank", "serve", "export"])
def test_commands_that_scripts_rely_on_exist(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        app([name, "--help"])
    assert ended.value.code == 0
    assert f"sme-leaderboard {name}" in capsys.readouterr().out
