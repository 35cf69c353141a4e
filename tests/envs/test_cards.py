"""What notebooks show of environments."""

from __future__ import annotations

from typing import Any

import gymnasium
import pytest

import sme_registry
from sme_registry import SMESpec
from sme_registry.envs import SMEEnv

BAD = SMESpec(k=17).named("<script>")


def sb3() -> Any:
    return pytest.importorskip("sme_registry.sb3")


@pytest.mark.parametrize(
    ("make", "texts"),
    [
        (lambda: gymnasium.make("SME/Default-v1").unwrapped,
         ["SMEEnv", "SME/Default-v1", "[10] float32 in [0, 1]: state, t/T, r_cum/k", "not begun"]),
        (lambda: SMEEnv("Default", k=3, action_range="symmetric"),
         ["Not the default: k=3", "[4] float32 in [-1, 1]"]),
        (lambda: SMEEnv(BAD), ["&lt;script&gt;"]),
        (lambda: gymnasium.make_vec("SME/Default-v1", num_envs=7).unwrapped,
         ["num_envs=7", "NextStep", "[4] float32"]),
        (lambda: sme_registry.make_parallel("TeamBlind4"), ["agent_3", "0–1, 6–7", "not begun"]),
        (lambda: sme_registry.make_aec("TeamBlind4"), ["agent_3", "0–1, 6–7"]),
        (lambda: gymnasium.make("SME/Switch5-v1").unwrapped, ["5 visits", "seed=4"]),
        (lambda: sb3().SMEVecEnv("Default", num_envs=3), ["num_envs=3", "SameStep"]),
        (lambda: sb3().SMETeamVecEnv("Team4"), ["agent_3"]),
    ],
)  # fmt: skip
def test_a_card_shows_spaces_episode_and_task(make: Any, texts: list[str]) -> None:
    html = make()._repr_html_()
    for text in texts:
        assert text in html
    assert "<script" not in html
    assert len(html.encode()) < 20_000


def test_the_status_follows_the_episode() -> None:
    team = sme_registry.make_parallel("Team2", horizon=1)
    assert "not begun" in team._repr_html_()
    team.reset(seed=0)
    assert "running" in team._repr_html_()
    team.step({agent: team.action_space(agent).sample() for agent in team.agents})
    assert "ended" in team._repr_html_()
