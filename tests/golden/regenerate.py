"""Golden files: run `python -m tests.golden.regenerate` from the root of the repository.

`digests.json`: the digest of every released name. A name that is there already keeps its digest:
the command refuses to change or remove one, and only adds what is new.

`one_step.json`: one step from given states with given actions, as the NumPy definition takes it:
the next state as exact bits (hexadecimal floats), and π*, similarity and step reward. Numbers only
change with the dynamics, so a changed file is a new version of every task: the command says what
changed, and writes only with `--change-dynamics`.
"""

import json
import sys
from pathlib import Path

import numpy as np

from sme_registry.io import write_atomically
from sme_registry.spec import EnvFile, ProtocolFile, StreamFile, StudyFile, SuiteFile, catalogue
from sme_registry.task.loading import load_task

FOLDER = Path(__file__).parent
TASKS = (
    "Default-v1", "StateDim64-v1", "ActionDim16-v1", "Complexity10-v1", "Complexity50-v1",
    "MinReward50-v1", "Plane10-v1", "HardDeep-v1",
)  # fmt: skip


def digests():
    """The digest of every name in the catalogue, by kind."""
    return {
        kind.content: {file.versioned_name: file.digest for file in catalogue.entries(kind)}
        for kind in (EnvFile, SuiteFile, ProtocolFile, StudyFile, StreamFile)
    }


def one_step(name):
    """Steps of one task: inside the cube, at its corners, and outside; actions good and clipped."""
    task = load_task(name)
    S, A = task.spec.state_dim, task.spec.action_dim
    rng = np.random.default_rng(20261121)
    states = [rng.random(S), rng.random(S), np.zeros(S), np.ones(S), rng.uniform(-0.5, 1.5, S)]
    actions = [rng.random(A), None, np.full(A, 0.5), rng.uniform(-0.5, 1.5, A), rng.random(A)]
    cases = []
    for s, given in zip(states, actions, strict=True):
        # The second is near the optimum, so that rewards are not all nothing.
        a = np.clip(task.optimal_action(s) + 0.01, 0.0, 1.0) if given is None else given
        cases.append(
            {
                "state": [x.hex() for x in s.tolist()],
                "action": [x.hex() for x in a.tolist()],
                "next_state": [x.hex() for x in task.transition(s, a).tolist()],
                "optimal_action": task.optimal_action(s).tolist(),
                "similarity": float(task.similarity(s, a)),
                "step_reward": float(task.step_reward(s, a)),
            }
        )
    return cases


def main(arguments):
    """Write both files; 1 where that would change what is released."""
    path = FOLDER / "digests.json"
    present, found = (json.loads(path.read_text()) if path.exists() else {}), digests()
    for kind, names in present.items():
        for name, digest in names.items():
            if found[kind].get(name) != digest:
                print(f"{name}: released as {digest}, now {found[kind].get(name, 'missing')}.")
                print("A released name never changes. Restore its file or choose a new name.")
                return 1
    write_atomically(path, json.dumps(found, indent=1) + "\n")

    path = FOLDER / "one_step.json"
    steps = {name: one_step(name) for name in TASKS}
    changed = path.exists() and json.loads(path.read_text()) != steps
    if changed and "--change-dynamics" not in arguments:
        print(f"{path.name}: other numbers than those released; see this module's head.")
        return 1
    write_atomically(path, json.dumps(steps, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
