"""`import sme_registry` is cheap: nothing heavy is loaded."""

import json
import os
import subprocess
import sys

HEAVY = {
    "torch", "jax", "ray", "matplotlib", "numba", "scipy.stats", "stable_baselines3", "pygame",
    "pandas", "h5py", "minari", "d3rlpy", "onnxruntime", "typer", "filelock", "jinja2",
}  # fmt: skip


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
