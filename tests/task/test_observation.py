"""What the agent sees in place of the state: METHOD, section 9."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtr, ndtri

from sme_registry import SMESpec
from sme_registry.errors import ActionError, SpecError, StateError
from sme_registry.task import materialize
from tests.strategies import observations, spec_fields


@st.composite
def observed_tasks(draw):
    fields = draw(spec_fields(team=False)) | {"observation": draw(observations())}
    return materialize(SMESpec.from_dict(fields))


def task_of(**observation):
    return materialize(SMESpec(seed=3, observation=observation))


def inside(task, count=40):
    """States and distractors in the cube."""
    random = np.random.default_rng(20261122)
    widths = task.spec.state_dim, task.spec.distractors
    return tuple(random.random((count, width)) for width in widths)


@given(observed_tasks())
def test_the_agent_sees_numbers_in_the_unit_cube_which_can_be_undone(task):
    s, d = inside(task)
    corners = (np.sign(s - 0.5) + 1) / 2, (np.sign(d - 0.5) + 1) / 2
    for states, distractors in ((s, d), corners):
        x = task.seen(states, distractors)
        assert x.shape == (40, task.spec.observation_dim - 2)
        assert ((x >= -1e-15) & (x <= 1.0 + 1e-15)).all()
    x = task.seen(s, d)
    np.testing.assert_allclose(task.seen(s[1], d[1]), x[1], rtol=0, atol=1e-14)
    for W, b in reversed(task.mixing):
        z = x if task.spec.observation.mixing == "orthogonal" else ndtri(x)
        x = np.linalg.solve(W, (z - b).T).T
    np.testing.assert_allclose(x, np.concatenate([s, d], axis=1), rtol=0, atol=1e-8)


def test_without_a_mixing_the_agent_sees_state_and_distractors():
    task = task_of(distractors=3)
    s, d = inside(task)
    np.testing.assert_array_equal(task.seen(s, d), np.concatenate([s, d], axis=1))
    plain = materialize(SMESpec())
    np.testing.assert_array_equal(plain.seen(s), s)
    assert (SMESpec().observation_dim, task.spec.observation_dim) == (10, 13)


def test_an_orthogonal_mixing_turns_about_the_centre_and_shrinks_no_more_than_it_must():
    task = task_of(distractors=8, mixing="orthogonal")
    ((W, _),) = task.mixing
    c = 1.0 / np.linalg.norm(W, axis=1)
    np.testing.assert_allclose(c, c[0])
    np.testing.assert_allclose(W @ W.T * c[0] ** 2, np.eye(16), atol=1e-14)
    np.testing.assert_allclose(task.seen(np.full(8, 0.5), np.full(8, 0.5)), 0.5, atol=1e-15)
    widest = np.abs(W).sum(axis=1).argmax()
    corner = (np.sign(W[widest]) + 1) / 2
    assert task.seen(corner[:8], corner[8:])[widest] == pytest.approx(1.0)


def test_a_nonlinear_mixing_is_its_uniform_layers():
    task = task_of(distractors=4, mixing="nonlinear", mixing_depth=3)
    s, d = inside(task)
    x = np.concatenate([s, d], axis=1)
    for W, b in task.mixing:
        np.testing.assert_allclose(W @ W.T, 12.0 * np.eye(12), atol=1e-12)
        np.testing.assert_allclose(W @ np.full(12, 0.5) + b, 0.0, atol=1e-14)
        x = ndtr(x @ W.T + b)
    np.testing.assert_allclose(task.seen(s, d), x, rtol=0, atol=1e-15)
    shallow = task_of(distractors=4, mixing="nonlinear", mixing_depth=2)
    assert (len(shallow.mixing), len(task.mixing)) == (2, 3)
    for one, other in zip(shallow.mixing, task.mixing[:2], strict=True):
        np.testing.assert_array_equal(one.W, other.W)


@given(observed_tasks())
def test_distractors_move_by_the_equations_of_the_state(task):
    if task.distractor_transition is None:
        assert task.spec.observation.dynamics in (None, "noise")
        return
    W, b = task.distractor_transition
    _, d = inside(task)
    u = np.random.default_rng(2).random((40, task.spec.action_dim)).astype(np.float32)
    expected = np.arccos(np.cos(2.0 * np.pi * (d + u @ W + b))) / np.pi
    np.testing.assert_allclose(task.distractor_step(d, u), expected, rtol=0, atol=3e-8)
    np.testing.assert_array_equal(task.distractor_step(d[0], u[0]), task.distractor_step(d, u)[0])
    np.testing.assert_array_equal(W.sum(axis=1), 1.0)


def test_bad_distractors_are_refused_with_their_shape():
    task, plain = task_of(distractors=3, dynamics="driven"), materialize(SMESpec(seed=3))
    s, step = np.zeros(8), task.distractor_step
    for call in (lambda d: task.seen(s, d), lambda d: step(d, np.zeros(4))):
        with pytest.raises(StateError, match=r"distractors of shape \(2,\): must be \[3\]"):
            call(np.zeros(2))
        with pytest.raises(StateError, match="distractors: has NaN or infinite entries"):
            call(np.full(3, np.nan))
    for call, error, words in (
        (lambda: task.seen(s), StateError, r"distractors of shape \(0,\).* distractors is 3"),
        (lambda: step(np.zeros(3), np.zeros(3)), ActionError, r"action of shape \(3,\): .*\[4\]"),
        (lambda: task.seen(np.zeros(7), np.zeros(3)), StateError, "state of shape"),
        (
            lambda: task.seen(np.zeros((5, 8)), np.zeros((3, 3))),
            StateError,
            r"distractors of shape \(3, 3\): must be \[5, 3\], one",
        ),
        (
            lambda: step(np.zeros((5, 3)), np.zeros((3, 4))),
            ActionError,
            r"action of shape \(3, 4\): must be \[5, 4\], one",
        ),
        (lambda: plain.seen(s, np.zeros(3)), StateError, r"distractors .*\(3,\): must be \[0\]"),
        (lambda: plain.distractor_step(np.zeros(3), np.zeros(4)), SpecError, "this task has none"),
        (
            lambda: task_of(distractors=3).distractor_step(np.zeros(3), np.zeros(4)),
            SpecError,
            "drawn anew each step.*dynamics='autonomous'",
        ),
    ):
        with pytest.raises(error, match=words):
            call()


def test_a_state_is_seen_with_each_of_many_distractors_and_they_with_it():
    task = task_of(distractors=3, mixing="orthogonal")
    s, d = inside(task, 5)
    ones = np.ones((5, 1))
    assert np.array_equal(task.seen(s[0], d), task.seen(ones * s[0], d))
    assert np.array_equal(task.seen(s, d[0]), task.seen(s, ones * d[0]))
