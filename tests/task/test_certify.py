"""Certificates: sound tasks pass, trivial and broken ones do not, and each check can fail."""

import dataclasses
import functools
import json

import numpy as np
import pytest

from sme_registry import SMESpec, load
from sme_registry.errors import OptionError
from sme_registry.task import Task, materialize
from sme_registry.task.certificate import certify
from sme_registry.task.draw import Layer

SMALL = SMESpec(state_dim=3, action_dim=2, seed=1)


def check(certificate, name):
    (found,) = [check for check in certificate.checks if check.name == name]
    return found


def with_layers(task, *layers):
    return dataclasses.replace(task, policies=(layers,))


@functools.cache
def certified(name):
    return certify(load(name))


@pytest.mark.parametrize("name", ["Default", "Complexity10", "Plane10", "StateDim64", "HardSparse"])
def test_sound_tasks_of_the_catalogue_pass_without_a_warning(name):
    assert certified(name).outcome == "passed"


def test_near_trivial_settings_warn_and_still_pass_and_a_notebook_shows_why():
    certificate = certified("Complexity2")
    assert certificate.passed
    assert certificate.outcome == "warning"
    assert check(certificate, "constant_policy_similarity").outcome == "warning"
    html = certificate._repr_html_()
    assert f"{certificate.digest}\nwarning" in html
    assert all(f"<b>{each.name}</b>" in html for each in certificate.checks)


def test_a_trivial_target_is_refused():
    certificate = certify(SMESpec(state_dim=2, action_dim=2, complexity=3))
    found = check(certificate, "constant_policy_similarity")
    assert not certificate.passed
    assert found.value > 0.9  # type: ignore[operator]
    assert found.outcome == "refused"


def broken(name):
    """A task that fails the check of this name."""
    task = materialize(SMALL)
    ((W, b),) = task.policies[0]
    if name == "transition_row_sums":
        return dataclasses.replace(task, W=task.W * (1 + 2.0**-29))
    if name == "distinct_states":
        return dataclasses.replace(task, b=np.array([0.0, 0.25, 0.5]))
    if name == "layers_centred":
        return with_layers(task, Layer(W, b + 1e-6))
    W, b = W.copy(), b.copy()
    if name == "channel_spread":
        W[1] *= 0.05
        b[1] *= 0.05
    else:
        W[0, 0] += 1e-6
    return with_layers(task, Layer(W, b))


@pytest.mark.parametrize(
    "name",
    ["transition_row_sums", "distinct_states", "layers_centred", "channel_spread",
     "layers_orthogonal"],
)  # fmt: skip
def test_a_task_that_breaks_a_rule_is_refused(name):
    assert check(certify(broken(name)), name).outcome == "refused"


@pytest.mark.parametrize("init", ["semi_orthogonal", "unit_variance"])
def test_layers_that_widen_are_judged_by_their_own_rule(init):
    spec = SMESpec(state_dim=3, action_dim=5, complexity=3, hidden_width=8, policy_init=init)
    assert check(certify(spec), "layers_orthogonal").outcome == "passed"


class Folding(Task):
    """A transition that keeps to half of the cube."""

    def transition(self, s, a):  # type: ignore[no-untyped-def, override]
        return super().transition(s, a) / 2.0


class Merging(Task):
    """A transition that sends every lane where the first one goes."""

    def transition(self, s, a):  # type: ignore[no-untyped-def, override]
        return np.broadcast_to(super().transition(s[:1], a[:1]), s.shape)


def recast(task, kind):
    return kind(task.spec, task.W, task.b, task.policies, task.observed)


def test_states_that_do_not_stay_uniform_are_refused():
    certificate = certify(recast(materialize(SMALL), Folding))
    assert check(certificate, "uniform_states").outcome == "refused"
    assert check(certificate, "coverage").value <= 0.25  # type: ignore[operator]
    assert check(certificate, "coverage").outcome == "refused"


def test_lanes_that_merge_are_refused():
    certificate = certify(recast(materialize(SMALL), Merging))
    found = check(certificate, "distinct_states")
    assert found.outcome == "refused"
    assert found.value == pytest.approx(1 / 64)


def test_the_linear_policy_is_reported_and_near_optimal_only_for_one_layer():
    shallow = check(certified("Default"), "linear_policy_reward")
    deep = check(certified("Complexity10"), "linear_policy_reward")
    assert shallow.outcome == deep.outcome == "reported"
    assert shallow.value == pytest.approx(0.87, abs=0.02)  # METHOD, section 2
    assert deep.value == pytest.approx(0.62, abs=0.02)


def test_the_same_seed_gives_the_same_certificate_and_another_one_other_numbers():
    certificates = [certify(SMALL, seed=seed) for seed in range(5)]
    assert certify(materialize(SMALL), seed=3) == certificates[3]
    values = [check(each, "uniform_states").value for each in certificates]
    assert max(values) < 2.6  # type: ignore[type-var]
    assert len(set(values)) == 5


def test_a_team_and_a_single_channel_can_be_certified():
    team = {"agents": [{"action_dim": 1}, {"action_dim": 1, "observes": [0, 2]}]}
    assert certify(SMESpec(state_dim=8, action_dim=2, team=team)).passed
    assert certify(SMESpec(state_dim=1, action_dim=1)).passed


def test_a_seed_out_of_range_is_refused():
    for seed in (-1, 2**53, 0.5, "0", True):
        with pytest.raises(OptionError, match="seed="):
            certify(SMALL, seed=seed)  # type: ignore[arg-type]


def test_a_certificate_is_plain_json_that_names_every_bound():
    plain = json.loads(json.dumps(certify(SMALL).to_dict(), allow_nan=False))
    assert plain["outcome"] == "passed"
    assert plain["digest"] == SMALL.digest
    for entry in plain["checks"]:
        assert entry["meaning"]
        judged = entry["outcome"] != "reported"
        assert judged == (entry["low"] is not None or entry["high"] is not None)
