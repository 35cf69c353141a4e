"""Run commands in this process as if some modules were missing, and print what happened as JSON.

`test_extras.py` runs this in an empty folder, and says on standard input which modules are missing,
and which commands to run: none is every `--help` and all of ARGUMENTS.
"""

from __future__ import annotations

import contextlib
import importlib.machinery
import io
import json
import sys
import traceback
from importlib.metadata import distribution

# Arguments that reach the optional packages of a command, and are quick where these are installed.
ARGUMENTS = {
    "sme": [
        "list",
        "show Default",
        "new task.json",
        "check task.json",
        "evaluate linear task.json --protocol quick-v1 --out evaluation",
        "evaluate task.onnx task.json",
        "train task.json --steps 0",
        "diagnose constant --task task.json --states 64 --episodes 2 --out diagnosis",
        "diagnose constant --task task.json --states 64 --episodes 2 --probe-capacity",
        "explore constant --task task.json --episodes 2",
        "demo --steps 0",
        "study new plan.json --task task.json -a PPO -n 1",
        "study plan smoke",
        "study run smoke --folder study --only class=none",
        "study run smoke --folder study --only class=none --ray local",
        "study status study",
        "study report study",
        "data make task.json --transitions 200 --protocol quick-v1 --out data",
        "data list --out data",
        "data show sme/none-v0 --out data",
        "data check sme/none-v0 --out data",
        "train --data sme/none-v0",
    ],
    "sme-leaderboard": [
        "init board --protocol quick-v1",
        "submit task.json board --method M --submitter S --key key",
        "withdraw http://127.0.0.1:9 none --key key",
        "rank board",
        "show board 0000",
        "verify board",
        "site board",
        "serve none",
        "admin key --key key",
        "admin reindex board",
        "admin clock board",
        "admin gc board",
        "demo",
    ],
}


def leaves(command, path=()):
    """The names of a command and of all commands in it."""
    for name in getattr(command, "modules", ()):
        command.load(name)
    yield path
    for name, child in getattr(command, "commands", {}).items():
        yield from leaves(child, (*path, name))


def run(main, program, arguments):
    """Call an entry point as its script does."""
    sys.argv = [program, *arguments]
    out, err = io.StringIO(), io.StringIO()
    code = None
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main()
        except SystemExit as end:
            code = end.code
        except BaseException:
            code = traceback.format_exc()
    return {
        "command": " ".join(sys.argv),
        "code": code,
        "out": out.getvalue(),
        "err": err.getvalue(),
    }


class Without(importlib.machinery.PathFinder):
    """Finds what lies on the path but for some modules, as if their packages were not installed."""

    missing: frozenset[str] = frozenset()

    @classmethod
    def find_spec(cls, fullname, path=None, target=None):
        if fullname.partition(".")[0] in cls.missing:
            return None
        return super().find_spec(fullname, path, target)


def everything(chosen):
    import typer

    package = distribution("sme-registry")
    for script in package.entry_points.select(group="console_scripts"):
        main = script.load()
        if chosen:
            # A task first: most commands read it.
            names = [f"{script.name} new task.json", *chosen] if script.name == "sme" else chosen
            for command in names:
                program, *arguments = command.split()
                if program == script.name:
                    yield run(main, program, tuple(arguments))
            continue
        for path in leaves(typer.main.get_command(main.__globals__["app"])):
            yield run(main, script.name, (*path, "--help"))
        for arguments in ARGUMENTS[script.name]:
            yield run(main, script.name, tuple(arguments.split()))


if __name__ == "__main__":
    request = json.load(sys.stdin)
    Without.missing = frozenset(request["missing"])
    sys.meta_path = [
        Without if finder is importlib.machinery.PathFinder else finder for finder in sys.meta_path
    ]
    print(json.dumps(list(everything(request["commands"]))))
