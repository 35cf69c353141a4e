"""Does the installed wheel work, away from its source tree? `.ci/run` runs this; pytest does not.

python smoke.py numba        where the extra `fast` is installed
python smoke.py numpy        where only the core is
"""

import json
import subprocess
import sys
import sysconfig
from pathlib import Path

import gymnasium
import numpy as np

import sme_registry
from sme_registry.spec import EnvFile
from sme_registry.spec.catalogue import entries, spec_folder
from sme_registry.task.engine import chosen_backend


def expect(holds, what):
    """Say what holds, or end with what does not."""
    if not holds:
        raise SystemExit(f"FAILED: {what}")
    print(f"ok: {what}")


def sme(*arguments):
    """Run the installed command."""
    command = Path(sysconfig.get_path("scripts")) / "sme"
    return subprocess.run(
        [command, *arguments], capture_output=True, text=True, stdin=subprocess.DEVNULL
    )


def main(backend):
    """Use the installed package as a reader of the README would."""
    package = Path(sme_registry.__file__).parent
    site = Path(sysconfig.get_path("purelib"))
    expect(package.parent == site, f"the package is the installed one, in {site}")
    expect((package / "py.typed").is_file(), "py.typed is in the wheel")
    expect(spec_folder() == package / "specs", "the catalogue is found inside the package")
    expect(chosen_backend() == backend, f"the step is run by {backend}")

    names = [file.versioned_name for file in entries(EnvFile)]
    expect("Default-v1" in names, f"the catalogue has {len(names)} environments")
    for name in names:
        sme_registry.materialize(sme_registry.load(name))
    expect(True, "each is drawn here with its published fingerprint")

    env = gymnasium.make("SME/Default-v1")
    env.reset(seed=0)
    task, earned, regret = env.unwrapped.task, 0.0, 0.0
    ended = False
    while not ended:
        action = task.optimal_action(env.unwrapped.state)
        _, reward, terminated, truncated, info = env.step(action)
        earned, regret = earned + reward, regret + info["regret"]
        ended = terminated or truncated
    expect(abs(earned - 100.0) < 1e-9 and regret < 1e-9, "the optimum earns the maximal return")

    vector = sme_registry.make_vec("SME/Complexity10-v1", 32)
    vector.reset(seed=0)
    _, rewards, *_ = vector.step(np.full((32, 4), 0.5))
    expect(rewards.shape == (32,), "a native batch steps")

    def constant(observations):
        return np.full((len(observations), 4), 0.5)

    report = sme_registry.evaluate(constant, "SME/Default-v1", protocol="quick-v1")
    data = json.loads(report.model_dump_json())
    expect(len(data["regions"]) == 6, "an evaluation has six regions")
    expect(
        abs(data["regions"][0]["normalised_regret"] - 1.0) < 1e-9,
        "the constant policy has a normalised regret of 1",
    )

    listed = sme("list", "--json")
    expect(listed.returncode == 0 and "Default-v1" in listed.stdout, "`sme list --json`")
    json.loads(listed.stdout)
    shown = sme("show", "SME/Default-v1")
    expect(shown.returncode == 0 and "sha256:66e9b7a9a266" in shown.stdout, "`sme show`")
    options = ("--task", "Default", "--states", "64", "--episodes", "8")
    diagnosed = sme("diagnose", "constant", *options)
    expect(diagnosed.returncode == 0, "`sme diagnose` finds its templates")
    unknown = sme("show", "SME/Defualt-v1")
    expect(
        unknown.returncode == 2 and "Traceback" not in unknown.stderr + unknown.stdout,
        "an unknown name is an error without a traceback",
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
