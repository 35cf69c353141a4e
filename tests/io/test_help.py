"""Help texts show what their source says, and the shell completes names."""

import inspect
import re
from typing import Any

import pytest
import typer
from rich.text import Text
from typer.testing import CliRunner

from leaderboard.cli import app as leaderboard
from sme_registry.cli import app as sme

APPS = {"sme": sme, "sme-leaderboard": leaderboard}


def commands(command, path=()):
    for name in getattr(command, "modules", ()):
        command.load(name)
    yield path, command
    for name, child in getattr(command, "commands", {}).items():
        yield from commands(child, (*path, name))


COMMANDS = [
    pytest.param(program, path, command, id=" ".join((program, *path)))
    for program, app in APPS.items()
    for path, command in commands(typer.main.get_command(app))
]


def words(text):
    return f" {' '.join(re.sub('[│╭╮╰╯─]', ' ', text).split())} "


@pytest.mark.parametrize(("program", "path", "command"), COMMANDS)
def test_help_shows_its_source_unchanged(program: str, path: tuple[str, ...], command: Any) -> None:
    result = CliRunner().invoke(APPS[program], [*path, "--help"], env={"COLUMNS": "80"})
    shown = words(result.stdout)
    source = inspect.getdoc(command.callback) if path and not hasattr(command, "commands") else None
    for paragraph in (source or Text.from_markup(command.help).plain).split("\n\n"):
        assert words(paragraph) in shown
    for parameter in command.params:
        text = Text.from_markup(getattr(parameter, "help", None) or "").plain
        for word in text.split():
            assert f" {word} " in shown  # a longer word would be cut: use a shorter one


@pytest.mark.parametrize(("program", "path", "command"), COMMANDS)
def test_help_shows_ten_options_at_most_below_a_few_lines(program, path, command):
    result = CliRunner().invoke(APPS[program], [*path, "--help"], env={"COLUMNS": "80"})
    above, *panels = re.split("(?=╭─ )", result.stdout)
    (options,) = (panel for panel in panels if panel.startswith("╭─ Options"))
    assert len(re.findall(r"^│ [ *]{0,3}--?[a-z]", options, re.M)) <= 10
    prose = above.split("Examples:")[0] if program == "sme-leaderboard" else above
    assert sum(bool(line.strip()) for line in prose.splitlines()[2:]) <= 15


def test_examples_are_lines_without_empty_ones_between_and_a_suggestion_has_one_mark():
    lines = CliRunner().invoke(sme, ["list", "--help"], env={"COLUMNS": "80"}).stdout.splitlines()
    start = lines.index(next(line for line in lines if line.strip() == "Examples:"))
    examples = [line.strip() for line in lines[start + 1 : start + 5]]
    assert [text.partition(" ")[0] for text in examples] == ["", "sme", "sme", "sme"]
    message = CliRunner().invoke(sme, ["shwo"]).stderr
    assert "Did you mean 'show'? See `sme --help`." in message


@pytest.mark.parametrize(
    ("program", "line", "expected"),
    [
        ("sme", "sme st", {"study"}),
        ("sme", "sme train Defau", {"Default"}),
        ("sme", "sme train SME/Defau", {"SME/Default-v1"}),
        ("sme", "sme show smo", {"smoke"}),
        ("sme", "sme study run smo", {"smoke"}),
        ("sme", "sme evaluate linear Default --protocol qu", {"quick"}),
        ("sme", "sme evaluate opt", {"optimal"}),
        ("sme-leaderboard", "sme-leaderboard init board --suite cor", {"core"}),
        ("sme-leaderboard", "sme-leaderboard sea", {"season"}),
    ],
)
def test_the_shell_completes_names(program, line, expected):
    settings = {
        f"_{program.replace('-', '_').upper()}_COMPLETE": "complete_bash",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(line.split()) - 1),
    }
    result = CliRunner().invoke(APPS[program], [], env=settings)
    assert set(result.stdout.split()) == expected
