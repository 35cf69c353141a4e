"""Boards of teams: one shared policy, from each agent's own observations; regret by agent."""

import json

import numpy as np
import pytest

from leaderboard import admission
from leaderboard.bundle import make_bundle
from leaderboard.documents.board import BoardDocument
from leaderboard.documents.signed import SigningKey
from leaderboard.documents.submission import Description, Submission
from leaderboard.errors import Rejection
from leaderboard.gate import sandbox
from leaderboard.gate.networks import optimal_onnx
from leaderboard.scoring import ranking
from leaderboard.scoring.score import score_submission
from leaderboard.scoring.verify import verify
from leaderboard.scoring.worker import run_scorer
from leaderboard.store import Store
from leaderboard.web.server import write_site
from sme_registry import EvaluationProtocol
from sme_registry.io import sha256_of
from sme_registry.spec import SuiteFile
from tests.leaderboard.conftest import linear_onnx, plain_submission, suite_of

AGENTS = [
    {"name": "scout_0", "action_dim": 1, "observes": [0]},
    {"name": "driver_0", "action_dim": 2},
]
SUITE = suite_of(team=(2, {"action_dim": 3, "team": {"agents": AGENTS}}), alone=(1, {}))
FILE = SuiteFile(name="mixed", version=1, digest=SUITE.digest, suite=SUITE)
TEAM = SUITE.instances[0]
FIELDS = {
    "title": "Teams",
    "suite_name": "mixed-v1",
    "suite": SUITE,
    "protocol_name": "small",
    "protocol": EvaluationProtocol(states_per_region=100),
    "runs_to_rank": 1,
    "draws": 100,
}
DOCUMENT = BoardDocument(key="0" * 64, rules=3, **FIELDS)
KEY = SigningKey.generate()
WIDTHS = (6, 2)  # s, t/T, r_cum/k and two one-hot entries; the widest agent's channels


def bundle(folder, team):
    """A bundle with this policy on one team, a failed run on the other, and a single agent."""
    folder.mkdir()
    (folder / "team.onnx").write_bytes(team)
    (folder / "alone.onnx").write_bytes(linear_onnx(300))
    policies = ["team.onnx", None, "alone.onnx"]
    rows = [
        {"spec": spec.digest, "policy": policy, "steps": 10, "seed": 0}
        for spec, policy in zip(SUITE.instances, policies, strict=True)
    ]
    (folder / "runs.json").write_text(json.dumps(rows))
    made = make_bundle(
        folder / "bundle",
        Description("Shared", "A Lab"),
        suite=FILE,
        key=KEY,
        runs=[folder / "runs.json"],
    )
    return made.folder


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    """A board whose references and shared policy are scored; nobody changes it."""
    folder = tmp_path_factory.mktemp("teams")
    with Store.create(folder / "board", **FIELDS) as store:
        admission.submit_references(store)
        admission.submit_bundle(store, bundle(folder / "mine", linear_onnx(400, *WIDTHS)), KEY)
    run_scorer(folder / "board")
    return folder / "board"


def test_a_board_of_teams_scores_a_shared_policy_and_each_agent(board, tmp_path):
    with Store.open(board, read_only=True) as store:
        ranking.refuse_unpublishable(store.entries())  # the references of teams score 0 and 1
        id = next(row.id for row in store.entries() if not row.reference)
        result = store.result(id)
        write_site(store, tmp_path / "site")
    assert verify(board, rescore="all").is_confirmed
    team, failed, alone = result.runs
    assert [agent.name for agent in team.agents] == ["scout_0", "driver_0"]
    # ρ of the team is the mean over channels, so its N lies between those of its agents.
    low, high = sorted(agent.normalised_regret[0] for agent in team.agents)
    assert low < team.normalised_regret[0] < high
    assert (failed.agents, alone.agents) == ((), ())
    page = (tmp_path / f"site/submissions/{id.removeprefix('sha256:')}.html").read_text()
    assert page.count("<bdi>driver_0</bdi>") == 1


def test_agents_receive_what_they_observe_and_their_rows_are_checked_in_every_region(monkeypatch):
    seen = []
    checked = []
    call = sandbox.Sandbox.__call__

    def recorded(self, observations):
        seen.append(observations.copy())
        return call(self, observations)

    monkeypatch.setattr(sandbox.Sandbox, "__call__", recorded)
    monkeypatch.setattr(sandbox.Sandbox, "check_last_place", lambda self, seen: None)
    monkeypatch.setattr(
        sandbox.Sandbox, "check_rows", lambda self, seen, rows: checked.append(tuple(seen[0, -2:]))
    )
    data = optimal_onnx(TEAM)
    policy = {"sha256": sha256_of(data), "size": len(data)}
    runs = [{"spec": spec.digest, "seed": 0, "steps": 1} for spec in SUITE.instances]
    submission = Submission.from_dict(
        plain_submission(DOCUMENT, [{**runs[0], "artefact": policy}, *runs[1:]])
    )
    assert score_submission(DOCUMENT, submission, lambda _: data).status == "scored"

    rows = np.concatenate(seen)
    scout = rows[:, 4] == 1.0
    assert scout.any()
    assert not rows[scout, 1].any()  # scout_0 observes the first channel only
    assert rows[~scout, 1].any()
    np.testing.assert_array_equal(rows[:, 4] + rows[:, 5], 1.0)
    # In each of the six regions the random batch is the last one, because there is one.
    assert checked == [(1.0, 0.0), (0.0, 1.0)] * 6


def test_a_policy_of_other_widths_is_rejected(tmp_path):
    with pytest.raises(Rejection, match="onnx_interface"):
        bundle(tmp_path / "mine", linear_onnx(400, 4, 3))
