"""Certificates: sound tasks pass, trivial and broken ones do not, and each check can fail."""

import dataclasses
import functools
import json

import numpy as np
import pytest

from sme_registry import SMESpec, load
from sme_registry.errors import OptionError, ResourceLimitError
from sme_registry.task import Task, materialize
from sme_registry.task.certificate import _limits, _observation, certify
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


# --- Limits, distractors and mixings ------------------------------------------------------------

MOVING = {"distractor_row_sums", "uniform_distractors", "distinct_distractors"}
MIXED = {"mixing_orthogonal", "mixing_centred", "mixing_condition", "mixing_linear_r2"}


def spec(**observation):
    return SMESpec(state_dim=4, action_dim=2, seed=1, observation=observation)


def measured(task, states=4_000):
    return {each.name: each for each in _observation(task, 0, states)}


def outcome(task, name):
    return measured(task)[name].outcome


PLAIN = {each.name for each in certify(SMESpec(state_dim=4, action_dim=2, seed=1)).checks}


def with_mixing(task, *layers):
    return dataclasses.replace(task, mixing=layers)


@pytest.mark.parametrize(
    ("observation", "names"),
    [
        ({"distractors": 4}, set()),
        ({"distractors": 4, "dynamics": "autonomous"}, MOVING),
        ({"distractors": 4, "dynamics": "driven", "mixing": "nonlinear"}, MOVING | MIXED),
        ({"mixing": "orthogonal"}, MIXED | {"mixing_extent"}),
        ({"distractors": 32, "mixing": "nonlinear", "mixing_depth": 3}, MIXED),
    ],
)
def test_a_sound_task_passes_and_has_the_checks_of_its_parts(observation, names):
    certificate = certify(spec(**observation))
    assert certificate.outcome == "passed"
    assert {each.name for each in certificate.checks} - PLAIN == names


def test_deeper_mixings_are_worse_conditioned_and_less_linear():
    orthogonal = measured(materialize(spec(distractors=4, mixing="orthogonal")))
    for name in ("mixing_condition", "mixing_linear_r2", "mixing_extent"):
        assert orthogonal[name].value == pytest.approx(1.0)
    found = [
        measured(materialize(spec(distractors=12, mixing="nonlinear", mixing_depth=depth)))
        for depth in (1, 2, 3)
    ]
    conditions = [each["mixing_condition"].value for each in found]
    r2 = [each["mixing_linear_r2"].value for each in found]
    assert conditions == sorted(conditions)  # type: ignore[type-var]
    assert r2 == sorted(r2, reverse=True)  # type: ignore[type-var]


def test_a_mixing_too_deep_for_float32_is_refused():
    task = materialize(spec(distractors=36, mixing="nonlinear", mixing_depth=3))
    twice = with_mixing(task, *task.mixing, *task.mixing)
    assert outcome(task, "mixing_condition") == "passed"
    assert outcome(twice, "mixing_condition") == "refused"


@pytest.mark.parametrize("fault", ["saturates", "loses a channel"])
def test_a_mixing_that_cannot_be_undone_is_refused(fault):
    task = materialize(spec(distractors=4, mixing="nonlinear"))
    ((W, b),) = task.mixing
    saturated, lossy = Layer(20 * W, 20 * b), Layer(np.concatenate([W[:1], W[:-1]]), b)
    checks = measured(with_mixing(task, saturated if fault == "saturates" else lossy))
    for name in ("mixing_orthogonal", "mixing_condition", "mixing_linear_r2"):
        assert checks[name].outcome == "refused"
    assert np.isfinite(checks["mixing_condition"].value or 0.0)  # JSON has no infinity


@pytest.mark.parametrize("mixing", ["orthogonal", "nonlinear"])
def test_a_mixing_that_is_not_orthogonal_or_off_centre_is_refused(mixing):
    task = materialize(spec(distractors=4, mixing=mixing))
    ((W, b),) = task.mixing
    skewed = W.copy()
    skewed[0, 0] += 1e-6
    assert outcome(with_mixing(task, Layer(skewed, b)), "mixing_orthogonal") == "refused"
    assert outcome(with_mixing(task, Layer(W, b + 1e-6)), "mixing_centred") == "refused"


@pytest.mark.parametrize("scale", [0.9, 1.1])
def test_a_rotation_that_leaves_the_cube_or_does_not_fill_it_is_refused(scale):
    task = materialize(spec(distractors=4, mixing="orthogonal"))
    ((W, _),) = task.mixing
    scaled = Layer(scale * W, 0.5 - 0.5 * scale * W.sum(axis=1))
    assert outcome(with_mixing(task, scaled), "mixing_extent") == "refused"
    assert outcome(with_mixing(task, scaled), "mixing_centred") == "passed"


class FoldingDistractors(Task):
    """Distractors that keep to half of the cube."""

    def distractor_step(self, d, u):  # type: ignore[no-untyped-def, override]
        return super().distractor_step(d, u) / 2.0


@pytest.mark.parametrize("dynamics", ["autonomous", "driven"])
def test_distractors_that_do_not_stay_uniform_are_refused(dynamics):
    task = materialize(spec(distractors=3, dynamics=dynamics))
    fields = {field.name: getattr(task, field.name) for field in dataclasses.fields(task)}
    assert outcome(FoldingDistractors(**fields), "uniform_distractors") == "refused"


def test_distractors_that_collapse_or_lose_an_actions_mass_are_refused():
    task = materialize(spec(distractors=3, dynamics="driven"))
    assert task.distractor_transition is not None
    W, b = task.distractor_transition
    dyadic = dataclasses.replace(task, distractor_transition=(W, np.array([0.0, 0.25, 0.5])))
    assert outcome(dyadic, "distinct_distractors") == "refused"
    lossy = dataclasses.replace(task, distractor_transition=(W * (1 + 2.0**-29), b))
    assert outcome(lossy, "distractor_row_sums") == "refused"


def test_a_mixing_of_very_many_channels_is_not_measured_and_says_so():
    checks = _observation(materialize(spec(distractors=1_100, mixing="orthogonal")), 0, 2_000)
    skipped = [each for each in checks if each.outcome == "reported"]
    assert [each.name for each in skipped] == ["mixing_condition", "mixing_linear_r2"]
    assert all(each.value is None and "1,104 channels" in each.meaning for each in skipped)


def test_distractors_count_in_the_memory_of_a_certificate(monkeypatch):
    many = spec(distractors=20_000)
    monkeypatch.setenv("SME_MEMORY_LIMIT_GIB", "1")
    materialize(many)
    with pytest.raises(ResourceLimitError, match="distractors=20000"):
        certify(many)


SAFE = SMESpec(safety={"tightness": 0.2}, policy_init="unit_variance")
NAMES = {"broken_limits", "limit_uniformity", "states_with_a_broken_limit", "price_of_safety"}


def changed(scale=1.0, shift=0.0):
    """A task whose v has another last layer."""
    task = materialize(SAFE)
    *layers, (W, b) = task.limiting
    return dataclasses.replace(task, limiting=(*layers, Layer(W * scale, b * scale + shift)))


@pytest.mark.parametrize("tightness", [0.05, 0.2, 0.5])
def test_the_optimum_breaks_its_limits_in_the_share_that_the_tightness_says(tightness):
    shares, prices = [], []
    for seed in range(10):
        task = materialize(SAFE.derive(safety={"tightness": tightness}, seed=seed))
        broken, uniformity, *_, price = _limits(task, 0, 4_000)
        assert (broken.low, broken.high) == (0.5 * tightness, 1.5 * tightness)
        assert uniformity.outcome == "passed"
        shares.append(broken.value)
        prices.append(price.value)
    assert np.mean(shares) == pytest.approx(tightness, rel=0.15)  # SD over draws: at most 0.2 τ
    if tightness == 0.2:
        assert price.name == "price_of_safety"
        assert np.mean(prices) == pytest.approx(0.105, abs=0.02)  # METHOD, section 8


def test_a_sound_task_passes_with_the_price_of_what_its_safe_action_earns_less():
    certificate, task = certify(SAFE), materialize(SAFE)
    assert certificate.outcome == "passed"
    s = np.random.default_rng(0).random((20_000, 8))
    price = np.mean(task.regret(s, task.safe_action(s)))
    assert check(certificate, "price_of_safety").value == pytest.approx(price, abs=0.01)
    states = check(certificate, "states_with_a_broken_limit").value
    channels = check(certificate, "broken_limits").value
    assert channels < states < 4 * channels  # type: ignore[operator]
    assert not {each.name for each in certify(SMESpec()).checks} & NAMES


def test_limits_that_have_collapsed_are_refused():
    found = check(certify(changed(scale=0.05)), "limit_uniformity")
    assert found.outcome == "refused"
    assert found.value == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize(("shift", "share"), [(-5.0, 0.0), (5.0, 0.4)])
def test_limits_that_never_or_too_often_bind_are_refused(shift, share):
    found = check(certify(changed(shift=shift)), "broken_limits")
    assert found.outcome == "refused"
    assert found.value == pytest.approx(share, abs=0.01)


def test_policies_that_stay_near_the_middle_seldom_reach_their_limits():
    middling = SAFE.derive(complexity=2, policy_init="semi_orthogonal", safety={"tightness": 0.1})
    spread = middling.derive(policy_init="unit_variance")
    for spec, outcome in ((middling, "refused"), (spread, "passed")):
        broken, *_ = _limits(materialize(spec), 0, 4_000)
        assert (broken.name, broken.outcome) == ("broken_limits", outcome)


def test_a_layer_of_v_is_held_to_the_rules_of_the_layers_of_the_optimum():
    task = materialize(SAFE)
    ((W, b),) = task.limiting
    W = W.copy()
    W[0, 0] += 1e-6
    skewed = certify(dataclasses.replace(task, limiting=(Layer(W, b),)))
    assert check(skewed, "layers_orthogonal").outcome == "refused"
    assert check(certify(changed(shift=1e-6)), "layers_centred").outcome == "refused"
