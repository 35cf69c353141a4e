"""The command line, as it is typed, from a key to a page; and its exit codes."""

import contextlib
import inspect
import json
import re
import shutil
import sqlite3
from pathlib import Path

import httpx
import pytest
from typer.main import get_command
from typer.testing import CliRunner

from leaderboard.cli import admin, app
from leaderboard.cli.submit import KEY_VARIABLE
from leaderboard.documents.board import hex_of
from leaderboard.documents.signed import SigningKey
from leaderboard.gate import isolation
from leaderboard.scoring.worker import run_scorer
from leaderboard.store import Store
from sme_registry import EvaluationProtocol
from sme_registry.io import sha256_of
from sme_registry.spec import ProtocolFile, SuiteFile
from sme_registry.training import train
from tests.leaderboard.conftest import document_path, linear_onnx, tiny_suite
from tests.leaderboard.serving import serving

PANELS = {
    "To submit": "submit withdraw",
    "To read": "rank show fetch verify",
    "To host": "init serve score site season admin demo",
    "Seasons": "enter ticket answer",
}
SUBMIT = ("--method", "Linear", "--submitter", "A Lab")


def board_command(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def good(*arguments):
    result = board_command(*arguments)
    assert result.exit_code == 0, result.output
    return result.stdout


def fails(code, *arguments):
    """The one line of a command that ends with this exit code."""
    result = board_command(*arguments)
    assert result.exit_code == code, result.output
    assert result.stderr.splitlines()[-1].startswith("error: ")
    assert "Traceback" not in result.output
    return result.stderr


def furnish(folder):
    """A small suite, a protocol and two runs: all that a newcomer has."""
    suite, protocol = tiny_suite(), EvaluationProtocol(states_per_region=200)
    SuiteFile(name="tiny", version=1, digest=suite.digest, suite=suite).write(
        folder / "tiny-v1.json"
    )
    ProtocolFile(name="small", version=1, digest=protocol.digest, protocol=protocol).write(
        folder / "small-v1.json"
    )
    (folder / "policy.onnx").write_bytes(linear_onnx(300))
    digest = suite.instances[0].digest
    runs = [
        {"spec": digest, "policy": "policy.onnx", "steps": 1000, "seed": 0},
        {"spec": digest, "policy": None, "steps": 10, "seed": 1},
    ]
    (folder / "runs.json").write_text(json.dumps(runs))


@pytest.fixture(autouse=True)
def _furnished(home, monkeypatch):
    monkeypatch.setattr(admin, "run_scorers", scored_here)
    furnish(home)


def scored_here(board, workers, *, work, progress):
    """Without processes, each of which takes seconds to start; `scored_folder` has them."""
    run_scorer(board, work=work)


@pytest.fixture(scope="module")
def scored_folder(tmp_path_factory):
    """A board on which runs are scored, their bundle and its key; and the submission's id."""
    folder = tmp_path_factory.mktemp("scored")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv(KEY_VARIABLE, str(folder / "my.key"))
        furnish(folder)
        make_board()
        sent = board_command("submit", "runs.json", "board", *SUBMIT, "--out", "bundle")
        assert sent.exit_code == 0, sent.output
        assert f"Created your signing key, {folder / 'my.key'}" in sent.stderr
        assert "Next: sme-leaderboard score board" in sent.stderr
        id = sent.stdout.splitlines()[-1]
        assert good("submit", "bundle", "board").splitlines()[-1] == id  # twice is once
        assert good("score", "board").strip() == "3 scored."
        assert good("score", "board").strip() == "No submission is waiting."
    return folder, id


@pytest.fixture
def scored(scored_folder):
    """A copy of the scored board, the bundle and the key; the submission's id."""
    shutil.copytree(scored_folder[0], ".", dirs_exist_ok=True)
    return scored_folder[1]


def make_board():
    good(
        "init", "board", "--suite", "tiny-v1.json", "--protocol", "small-v1.json",
        "--runs-to-rank", "2",
    )  # fmt: skip


def make_bundle(name="bundle", *more, board="board"):
    """The id of a submission for a board, which is not sent."""
    options = ("--out", name, "--dry-run", "--no-check", *SUBMIT, *more)
    return good("submit", "runs.json", board, *options).split()[-1]


def test_help_teaches_every_command_with_an_example_and_few_options(monkeypatch):
    """Markdown would remove asterisks and angle brackets of examples."""
    monkeypatch.setenv("COLUMNS", "80")
    group = get_command(app)
    loaded = {name: group.load(name) for names in PANELS.values() for name in names.split()}
    commands = {(name,): command for name, command in loaded.items()}
    for name in ("season", "admin"):
        group_of = commands.pop((name,))
        commands |= {(name, each): command for each, command in group_of.commands.items()}
    panels = good("--help").split("╭─ ")[2:]
    listed = {text.partition(" ─")[0]: re.findall(r"^│ (\w+)", text, re.M) for text in panels}
    assert {panel: " ".join(names) for panel, names in listed.items()} == PANELS
    for path, command in commands.items():
        lines = good(*path, "--help").splitlines()
        prose = lines[: next(n for n, line in enumerate(lines) if line.startswith("╭"))]
        assert len([line for line in prose[2:] if line.strip()]) <= 15
        text = " ".join(" ".join(lines).replace("│", " ").split())
        options = text.partition("─ Options")[2].partition("╯")[0]
        assert 1 <= len(re.findall(r" --[a-z]", options)) <= 10
        examples = inspect.getdoc(command.callback).partition("Examples:")[2].split("\n\n")
        examples = list(filter(None, map(str.strip, examples)))
        name = f"sme-leaderboard {' '.join(path)}"
        assert any(each.startswith(name) for each in examples)
        assert all(each in text for each in examples)


@pytest.mark.parametrize(
    ("former", "words"),
    [
        ("keygen", "admin key"),
        ("new b --runs r", "submit RUNS BOARD"),
        ("check b", "--dry-run"),
        ("export-sb3 model.zip", "export_onnx"),
        ("export model.zip", "export_onnx"),
        ("reindex board", "admin reindex"),
        ("clock board", "admin clock"),
        ("gc board", "admin gc"),
    ],
)
def test_a_former_command_says_what_replaces_it(former, words):
    (line,) = fails(2, *former.split()).splitlines()
    assert words in line


def test_scoring_refuses_a_broken_bubblewrap_and_warns_of_a_missing_one(monkeypatch):
    make_board()
    broken = Path("bin/bwrap").absolute()
    broken.parent.mkdir()
    broken.write_text("#!/bin/sh\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("PATH", str(broken.parent))
    isolation._bwrap.cache_clear()
    assert "bubblewrap is installed" in fails(2, "score", "board")
    good("submit", "runs.json", "board", *SUBMIT, "--dry-run")  # one's own
    assert isolation.isolation_for_own() == "process"
    asked = board_command("score", "board", "--unsafe-no-sandbox")
    assert (asked.exit_code, "bubblewrap" in asked.stderr) == (0, False)
    broken.unlink()
    result = board_command("score", "board")
    assert result.exit_code == 0
    assert "bubblewrap is not installed" in " ".join(result.stderr.split())
    with Store.open("board", read_only=True) as store:
        kinds = {store.result(entry.id).isolation for entry in store.entries()}
    assert kinds == {"process"}


def test_a_scored_board_is_ranked_shown_verified_and_written_as_pages(scored):
    ranking = good("rank", "board", "--json")
    assert {"optimal", "Linear"} <= {row["method"] for row in json.loads(ranking)["rows"]}
    assert scored in ranking
    assert "Linear" in good("rank", "board")
    assert good("rank", "board", "--csv").count("\n") >= 4
    assert "tabular" in good("rank", "board", "--latex")

    shown = json.loads(good("show", "board", scored, "--json"))
    # One of its two runs failed, and scores 1: the IQM of two is their mean.
    alone = shown["result"]["runs"][0]["wd_regret"]
    assert shown["result"]["scores"]["wd_regret"]["value"] == pytest.approx((alone + 1.0) / 2)
    assert shown["withheld"] == ""
    words = good("show", "board", scored.removeprefix("sha256:")[:8])
    assert "A Lab" in words
    assert "WD regret" in words
    assert "withdrawn" not in words

    assert "Verified" in good("verify", "board", "--rescore", "1")
    page = Path(good("site", "board", "--out", "public").strip())
    assert page == Path("public/index.html").resolve()
    assert "Linear" in page.read_text()
    assert SuiteFile.read("public/suite.json") == SuiteFile.read("tiny-v1.json")
    assert json.loads(Path("public/definition.json").read_text())["runs_to_rank"] == 2


def test_a_withdrawal_grows_the_log_that_verify_has_printed_the_digest_of(scored):
    kept = json.loads(good("verify", "board", "--json"))["log_digest"]
    assert kept in good("verify", "board")
    reason = "a bug in [bold]the wrapper[/]"
    good("withdraw", "board", scored, "--reason", reason)
    assert "Verified" in good("verify", "board", "--contains", kept)
    cut = fails(3, "verify", "board", "--contains", "sha256:" + "0" * 64)
    assert "cut or rewritten" in " ".join(cut.split())
    assert "contains=" in fails(2, "verify", "board", "--contains", "3f2a")

    assert scored not in good("rank", "board", "--json")
    assert "withdrawn" in fails(1, "submit", "bundle", "board")
    assert reason in good("show", "board", scored)
    plain = json.loads(good("show", "board", scored, "--json"))
    assert plain["withdrawal"]["withdrawal"]["reason"] == reason


def test_a_dry_run_computes_the_same_scores_as_the_board_and_sends_nothing(scored):
    on_board = json.loads(good("show", "board", scored, "--json"))["result"]
    answer = json.loads(good("submit", "bundle", "board", "--dry-run", "--json"))
    assert (answer["id"], answer["sent"], answer["page"]) == (scored, False, None)
    at_home = answer["result"]
    assert at_home["enough_runs"]
    for run in (*at_home["runs"], *on_board["runs"]):
        run.pop("rounding", None)  # measured on random states
    for field in ("scores", "runs", "classes", "suite", "protocol"):
        assert at_home[field] == on_board[field]
    before = good("rank", "board", "--csv").count("\n")
    assert "WD regret" in good("submit", "runs.json", "board", *SUBMIT, "--dry-run")
    assert good("rank", "board", "--csv").count("\n") == before
    assert "waiting" not in good("score", "board").replace("No submission is waiting", "")


def test_a_rejection_exits_with_1_and_its_code_and_sends_nothing():
    make_board()
    Path("policy.onnx").write_bytes(b"not a model")
    new = ("submit", "runs.json", "board", *SUBMIT, "--out", "bundle")
    assert "onnx_malformed" in fails(1, *new)
    assert not Path("bundle").exists()

    Path("policy.onnx").write_bytes(linear_onnx(float("nan")))
    assert "run_not_finite" in fails(1, *new)
    with Store.open("board", read_only=True) as store:
        assert len(store.entries()) == 2  # the reference rows
    next(Path("bundle/artefacts").iterdir()).write_bytes(linear_onnx(301))
    for options in ((), ("--dry-run",), ("--no-check",)):
        assert "artefact_digest" in fails(1, "submit", "bundle", "board", *options)


def test_invalid_usage_exits_with_2():
    public = good("admin", "key").split()[-1]
    assert good("admin", "key").split()[-1] == public
    assert "init" in fails(2, "rank", "nowhere")
    make_board()
    new = ("submit", "runs.json", "board", *SUBMIT)
    assert "no such folder" in fails(2, "submit", "runs/*", "board", *SUBMIT)
    assert "Correct the pattern" in fails(2, "submit", "runs/ppo**", "board", *SUBMIT)
    assert "knowledge" in fails(2, *new, "--knowledge", "much")
    assert "CLASS=N" in fails(2, *new, "--started", "many")
    assert "--method, --submitter" in fails(2, *new[:3])
    make_bundle()
    assert "already exists" in fails(2, *new, "--out", "bundle")
    assert "--method, --submitter: RUNS is a bundle" in fails(2, "submit", "bundle", *new[2:])
    assert "at most one" in fails(2, "rank", "board", "--json", "--csv")
    assert "new folder" in fails(2, "init", "board", "--suite", "tiny-v1.json")
    assert "no submission" in fails(2, "show", "board", "abcdef0123")


def test_what_is_no_board_is_refused_with_advice():
    make_board()
    Path("empty").mkdir()
    before = sorted(Path().rglob("*"))
    for command in ("verify", "score", "site", "serve", "admin reindex", "admin gc", "rank"):
        url = "http://127.0.0.1:8000"
        assert f"sme-leaderboard fetch {url} FOLDER" in fails(2, *command.split(), url)
    for board, advice in {
        "board/board.json": "Give the folder",
        "tiny-v1.json": "Give the folder",
        "core": "no such folder",
        "empty": "contains no board",
    }.items():
        assert advice in fails(2, "rank", board)
    for board, advice in {
        "core-v1": "board --suite core",
        "http://127.0.0.1:8000": "serve",
    }.items():
        assert advice in fails(2, "init", board)
    for arguments in (("withdraw", "localhost:1", "abcd"), ("submit", "bundle", "localhost:1")):
        assert "its whole URL" in fails(2, *arguments)
    assert sorted(Path().rglob("*")) == before


def test_a_folder_may_have_the_name_of_a_suite():
    good("init", "./core", "--suite", "tiny-v1.json", "--protocol", "small-v1.json")
    assert Store.open("core", read_only=True).document.suite_name == "tiny-v1"
    assert "waiting" in fails(2, "rank", "core")


def test_a_practice_board_ranks_few_runs_and_says_so():
    created = good("init", "board", "--suite", "tiny-v1.json", "--practice")
    assert "practice" in created
    with Store.open("board", read_only=True) as store:
        assert (store.document.runs_to_rank, store.document.protocol_name) == (1, "quick-v1")
        assert store.document.runs_needed == 1
        assert store.document.practice
    assert "without a rank" not in good("submit", "runs.json", "board", *SUBMIT)
    good("score", "board")
    ranking = json.loads(good("rank", "board", "--json"))
    assert ranking["runs_to_rank"] == 1
    assert [row["first"] for row in ranking["rows"] if row["method"] == "Linear"] == [1]
    assert "practice" in good("rank", "board")
    good("site", "board", "--out", "public")
    assert "practice board" in Path("public/index.html").read_text()


def test_a_board_keeps_the_description_and_tags_of_its_suite_if_there_are_any():
    plain = SuiteFile.read("tiny-v1.json")
    file = plain.model_copy(update={"description": "Our lab's suite.", "tags": ("ours",)})
    file.write("described.json")
    good("init", "board", "--suite", "described.json")
    with serving(Path("board")) as url:
        served = httpx.get(f"{url}/suite.json").json()
    assert SuiteFile.from_dict(served) == file
    good("init", "again", "--suite", "board")
    assert json.loads(Path("again/board.json").read_text())["suite_tags"] == ["ours"]
    good("init", "plain", "--suite", "tiny-v1.json")
    names = json.loads(Path("plain/board.json").read_text())
    assert not [name for name in names if "suite_d" in name]


def test_everything_a_submitter_needs_is_at_the_boards_address(scored):
    with serving(Path("board")) as url:
        Path("policy.onnx").write_bytes(linear_onnx(301))
        named = ("--method", "Other", "--submitter", "A Lab")
        sent = board_command("submit", "runs.json", url, *named)
        assert sent.exit_code == 0, sent.output
        id = sent.stdout.splitlines()[-1]
        assert "WD regret" in sent.stdout
        assert f"{url}/submissions/{hex_of(id)}" in sent.stderr
        assert f"sme-leaderboard show {url} {id}" in sent.stderr
        shown = good("show", url, id)
        assert "waiting" in shown
        assert re.search(r"place in the queue +1 of 1$", shown, re.M)
        good("withdraw", url, id, "--reason", "a bug")
        words = good("show", url, id)
        assert "withdrawn" in words
        assert "a bug" in words
        assert "WD regret" in good("show", url, scored)
        remote = json.loads(good("show", url, scored, "--json"))
    assert remote["result"]["scores"]["wd_regret"]["value"] > 0


def test_score_lists_what_it_could_not_score_and_why_and_counts_its_own(scored):
    Path("policy.onnx").write_bytes(linear_onnx(301))
    named = ("--method", "Other", "--submitter", "A Lab")
    id = good("submit", "runs.json", "board", *named, "--no-check").strip()
    with Store.open("board", read_only=True) as store:
        run = next(run for run in store.submission(id).content.runs if run.artefact)
        path = store.folder.object(run.artefact.sha256)
    artefact = path.read_bytes()
    path.chmod(0o644)
    path.write_bytes(b"damaged")
    for attempts in (2, 3):
        result = board_command("score", "board")
        assert result.exit_code == 1
        (line,) = [line for line in result.stderr.splitlines() if id in line]
        assert f"{attempts} attempts" in line
        assert f"objects/{path.parent.name}/{path.name}" in line
        assert str(Path.cwd()) not in line
        assert "1 waiting" in result.stdout
    path.write_bytes(artefact)
    assert good("score", "board").strip() == "1 scored. Done before: 3."


def test_an_altered_result_exits_with_3_and_is_named(scored):
    path = document_path("board", scored, "result")
    path.chmod(0o644)
    path.write_text(path.read_text().replace('"wd_regret"', '"dw"', 1))
    assert path.name in fails(3, "verify", "board")


def test_a_board_without_its_key_accepts_nothing():
    make_board()
    make_bundle()
    Path("board/board.key").unlink()
    before = sorted(Path("board/objects").rglob("*"))
    message = fails(2, "submit", "bundle", "board")
    assert "without the board's key" in " ".join(message.split())
    assert sorted(Path("board/objects").rglob("*")) == before


def test_the_index_comes_back_from_the_files(scored, monkeypatch):
    # A ranking says when it was written, to the second.
    monkeypatch.setattr("leaderboard.cli.results.now", lambda: "2026-01-01T00:00:00Z")
    before = good("rank", "board", "--csv")
    for path in Path("board").glob("index.sqlite*"):
        path.unlink()
    assert "Indexed 3 entries" in good("admin", "reindex", "board")
    assert good("rank", "board", "--csv") == before
    with contextlib.closing(sqlite3.connect("board/index.sqlite")) as index:
        assert index.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def test_gc_removes_unnamed_artefacts_and_a_dry_run_only_counts_them(scored):
    data, key = linear_onnx(1), SigningKey.generate()
    with Store.open("board") as store:
        store.put_object(sha256_of(data), data, by=key.public)
        path = store.folder.object(sha256_of(data))
    gc = ("admin", "gc", "board", "--older-than-hours", "0")
    assert "1 files" in good(*gc, "--dry-run")
    assert path.exists()
    good(*gc)
    assert not path.exists()
    assert "Verified" in good("verify", "board")


def test_a_demonstration_replaces_an_earlier_one_and_nothing_else():
    train(
        {"state_dim": 2, "action_dim": 1}, algorithm="A2C", steps=64, folder="run",
        protocol={"states_per_region": 200}, progress=False,
    )  # fmt: skip
    trained = Path("run")
    good("demo", trained)
    demonstrated = Path("run/leaderboard")
    first = (demonstrated / "board" / "board.key").read_text()
    (demonstrated / "site" / "extra.html").write_text("of the earlier one")
    good("demo", trained)
    assert (demonstrated / "board" / "board.key").read_text() != first
    assert not (demonstrated / "site" / "extra.html").exists()

    make_board()
    Path("pages/site").mkdir(parents=True)
    Path("linked").mkdir()
    Path("linked/board").symlink_to(demonstrated.resolve() / "board")
    for name, folder in (("board", "."), ("site", "pages"), ("board", "linked")):
        before = {path: path.stat().st_mtime_ns for path in Path().rglob("*")}
        message = fails(2, "demo", trained, "--out", folder)
        assert f"{Path(folder) / name}: already exists" in " ".join(message.split())
        assert "Nothing was removed" in message
        assert {path: path.stat().st_mtime_ns for path in Path().rglob("*")} == before
