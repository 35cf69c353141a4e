"""`sme` as a user types it, and what holds for every command that succeeds or refuses."""

from typer.testing import CliRunner

from sme_registry.cli import app


def sme(*arguments):
    """Run a command in this process."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def good(*arguments):
    """The result of a command that must succeed."""
    result = sme(*arguments)
    assert result.exit_code == 0, result.output
    return result


def refused(*arguments):
    """The message of a command that must refuse, after the rules that hold for all of them."""
    result = sme(*arguments)
    assert result.exit_code == 2, result.output
    assert result.stderr.startswith("error: ")
    assert "Traceback" not in result.output
    return result.stderr
