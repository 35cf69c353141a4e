import pytest
from typer.testing import CliRunner

from leaderboard.cli import app
from leaderboard.documents.keys import SigningKey
from leaderboard.public_view import PublicView, public_view
from sme_registry.errors import SpecError
from tests.leaderboard.web.site import boards


def test_an_earlier_version_is_shown_with_the_reason_why_it_has_no_rank(tmp_path):
    key = SigningKey.generate()
    with boards.create(tmp_path / "board", classes=1) as store:
        first = boards.submit(store, key, "PPO", [0.2] * 6, statement="first")
        second = boards.submit(store, key, "PPO", [0.2] * 6, statement="second")
        views = [public_view(store, store.entry(id)) for id in (first, second)]
    assert [view.not_ranked for view in views] == ["superseded", ""]
    printed = CliRunner().invoke(app, ["show", str(tmp_path / "board"), first]).stdout
    assert "not ranked" in printed
    assert "each of 1,000,000 steps, 10,000,000 in total" in printed

    assert PublicView.from_dict(views[0].to_dict()) == views[0]
    plain = views[1].to_dict()
    for change in ({"copy_of": [{"id": "x"}]}, {"copy_of": 3}, {"faults": "many"}):
        with pytest.raises(SpecError, match="invalid answer"):
            PublicView.from_dict({**plain, **change})
    for name in ("not_ranked", "copy_of", "faults", "fault"):  # what earlier servers leave out
        del plain[name]
    assert PublicView.from_dict(plain) == views[1]
