"""In fresh processes: everything works without Numba, and its compiled code is kept on disk."""

import io
import json
import os
import subprocess
import sys
import textwrap
import threading

import pytest

from sme_registry.task.engine import compiling

EPISODE = """
    import gymnasium, numpy as np, sme_registry
    states = []
    for env in (
        gymnasium.make("SME/Complexity3-v1"),
        gymnasium.make_vec("SME/Complexity3-v1", num_envs=3),
    ):
        env.reset(seed=3)
        for t in range(20):
            shape = env.action_space.shape
            a = np.modf(0.61803 * (t + np.arange(1, 1 + np.prod(shape))))[0].reshape(shape)
            env.step(a.astype(np.float32))
        states.append([x.hex() for x in np.ravel(env.unwrapped.state).tolist()])
"""
HIDE = "import sys; sys.modules['numba'] = None\n"


def run(script, **environment):
    """The standard output of a script in a fresh process, as JSON."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", textwrap.dedent(script)],
        capture_output=True, text=True, check=False, timeout=120,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **environment},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_without_numba_the_same_episodes_have_the_same_bits_and_all_else_works(tmp_path):
    show = "import json, sys; print(json.dumps([states, sys.modules.get('numba') is not None]))"
    rest = f"""
        import json, os
        spec = sme_registry.load("Default")
        path = sme_registry.save(spec, {str(tmp_path / "task.json")!r})
        task = sme_registry.materialize(spec)
        report = sme_registry.evaluate(
            lambda observation: task.optimal_action(observation[:, :-2]), path, "quick-v1"
        )
        assert report.regions[0].similarity > 1.0 - 1e-6
        os.environ["SME_BACKEND"] = "numba"
        try:
            sme_registry.make("SME/Default-v1")
        except sme_registry.errors.MissingDependencyError as error:
            assert str(error).startswith("SME_BACKEND='numba': Numba is not installed.")
        else:
            raise AssertionError
    """
    episode = textwrap.dedent(EPISODE)
    plain, loaded = run(HIDE + episode + textwrap.dedent(rest) + show)
    assert not loaded
    pytest.importorskip("numba")
    fast, loaded = run(episode + show)
    assert loaded
    assert plain == fast


def test_what_steps_is_compiled_when_it_does_and_a_second_process_loads_it():
    pytest.importorskip("numba")
    script = """
    import json
    from numba.core.dispatcher import Dispatcher
    from sme_registry.task import kernels
    kept = {name: f for name, f in vars(kernels).items() if isinstance(f, Dispatcher)}
    print(json.dumps({
        name: [sum(f.stats.cache_hits.values()), sum(f.stats.cache_misses.values())]
        for name, f in kept.items() if f._cache.cache_path is not None
    }))
    """
    run(EPISODE + script)
    counts = run(EPISODE + script)
    assert counts["step_packed"] == counts["step_many"] == [1, 0]  # one type of actions
    assert counts["step_one"] == counts["network"] == [0, 0]  # wide policies, mixings


class Terminal(io.StringIO):
    def __init__(self):
        super().__init__()
        self.written = threading.Event()

    def isatty(self):
        return True

    def flush(self):
        self.written.set()


def test_a_terminal_is_told_while_it_waits(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setattr(sys.modules[compiling.__module__], "_PATIENCE", 0.0)
    with compiling():
        assert terminal.written.wait(60)
    assert "Numba" in terminal.getvalue()
    assert terminal.getvalue().count("\n") == 1


def test_a_log_and_a_terminal_that_does_not_wait_are_told_nothing(monkeypatch):
    for stream, patience in ((Terminal(), 3600.0), (io.StringIO(), 0.0)):
        monkeypatch.setattr(sys, "stderr", stream)
        monkeypatch.delitem(sys.modules, "ipykernel", raising=False)
        monkeypatch.setattr(sys.modules[compiling.__module__], "_PATIENCE", patience)
        timers = set(threading.enumerate())
        with compiling():
            timers = set(threading.enumerate()) - timers
            assert bool(timers) == (patience > 0.0)
        for timer in timers:
            timer.join(60)
        assert stream.getvalue() == ""
