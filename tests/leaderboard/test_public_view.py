import pytest
from typer.testing import CliRunner

from leaderboard.cli import app
from leaderboard.documents.keys import SigningKey
from leaderboard.public_view import PublicView, public_view
from sme_registry.errors import SpecError
from tests.leaderboard.web.site import boards


def view_of(store, id):
    entry = store.entry(id)
    assert entry is not None
    return public_view(store, entry)


def test_an_earlier_version_is_shown_with_the_reason_why_it_has_no_rank(tmp_path):
    key = SigningKey.generate()
    with boards.create(tmp_path / "board", classes=1) as store:
        first = boards.submit(store, key, "PPO", [0.2] * 6, statement="first")
        second = boards.submit(store, key, "PPO", [0.2] * 6, statement="second")
        views = [view_of(store, id) for id in (first, second)]
    assert [view.not_ranked for view in views] == ["superseded", ""]
    assert PublicView.from_dict(views[0].to_dict()) == views[0]
    printed = CliRunner().invoke(app, ["show", str(tmp_path / "board"), first]).stdout
    assert "not ranked" in printed
    assert "each of 1,000,000 steps, 10,000,000 in total" in printed


def test_an_earlier_servers_answer_is_read_and_nonsense_refused(tmp_path):
    with boards.create(tmp_path / "board", classes=1) as store:
        view = view_of(store, boards.submit(store, SigningKey.generate(), "PPO", [0.2] * 6))
    plain = view.to_dict()
    for change in ({"copy_of": [{"id": "x"}]}, {"copy_of": 3}, {"faults": "many"}):
        with pytest.raises(SpecError, match="invalid answer"):
            PublicView.from_dict({**plain, **change})
    for name in ("not_ranked", "copy_of", "faults", "fault"):
        del plain[name]
    assert PublicView.from_dict(plain) == view
