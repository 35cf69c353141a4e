"""What a board's definition refuses."""

import pytest
from typer.testing import CliRunner

from leaderboard.cli.app import app
from leaderboard.cli.options import find_suite
from leaderboard.documents.board import BoardDocument
from leaderboard.documents.keys import SigningKey
from sme_registry.errors import SpecError
from sme_registry.spec import Suite

LIMITED = {"safety": {"tightness": 0.2}}
MIXED = {"observation": {"mixing": "orthogonal"}}


@pytest.mark.parametrize("setting", [LIMITED, MIXED], ids=["safety", "observation"])
def test_boards_refuse_classes_with_safety_or_observation(setting):
    classes = [{"name": "Plain", "setting": {}, "seeds": [0]}]
    classes.append({"name": "Other", "setting": setting, "seeds": [0]})
    fields = {"title": "x", "suite_name": "x-v1", "protocol_name": "quick-v1", "protocol": {}}
    fields["key"] = SigningKey.generate().public
    BoardDocument.from_dict({**fields, "suite": Suite.from_dict({"classes": classes[:1]})})
    with pytest.raises(SpecError, match=r"suite: has classes .* \(Other\), and a leaderboard"):
        BoardDocument.from_dict({**fields, "suite": Suite.from_dict({"classes": classes})})


@pytest.mark.parametrize("name", ["safety", "representation"])
def test_commands_refuse_the_suites_of_the_catalogue_that_boards_do_not_score(name, tmp_path):
    with pytest.raises(SpecError, match="safety or observation"):
        find_suite(name)
    result = CliRunner().invoke(app, ["init", f"{tmp_path}/board", "--suite", name])
    assert result.exit_code == 2, result.output
    assert "Choose a suite without them" in " ".join(result.stderr.split())
