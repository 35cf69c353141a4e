"""`import sme_registry` is cheap: nothing heavy is loaded, and little time is taken."""

import json
import os
import subprocess
import sys

HEAVY = {
    "torch", "jax", "ray", "matplotlib", "numba", "scipy.stats", "stable_baselines3", "pygame",
    "pandas", "h5py", "minari", "d3rlpy", "onnxruntime", "typer", "filelock", "jinja2",
}  # fmt: skip
CPU_SECONDS = 0.5


def run(script):
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=120,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_importing_the_package_loads_nothing_heavy():
    loaded = set(run("import json, sys, sme_registry; print(json.dumps(list(sys.modules)))"))
    assert "sme_registry" in loaded
    assert not loaded & HEAVY


def test_making_and_stepping_with_numpy_loads_nothing_heavy():
    script = (
        "import os; os.environ['SME_BACKEND'] = 'numpy'\n"
        "import json, sys, gymnasium, sme_registry\n"
        "env = gymnasium.make('SME/Default-v1'); env.reset(seed=0)\n"
        "env.step(env.action_space.sample())\n"
        "print(json.dumps(list(sys.modules)))"
    )
    assert not set(run(script)) & HEAVY


def test_importing_the_package_costs_little_beyond_numpy_and_gymnasium():
    script = (
        "import json, time, numpy, gymnasium\n"
        "begun = time.process_time()\n"
        "import sme_registry\n"
        "print(json.dumps(time.process_time() - begun))"
    )
    assert min(run(script) for _ in range(3)) < CPU_SECONDS
