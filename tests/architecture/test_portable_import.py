"""Every module of `sme_registry` can be imported where POSIX's own modules do not exist."""

import os
import subprocess
import sys

WITHOUT_POSIX = """
import importlib, os, pkgutil, signal, sys

# As on Windows. What other packages need of these they have loaded before.
import sme_registry, filelock, multiprocessing.resource_tracker, subprocess, tempfile
for name in ("stable_baselines3", "minari", "numba"):
    try:
        importlib.import_module(name)
    except ImportError:
        pass
for name in [name for name in sys.modules if name.split(".")[0] == "sme_registry"]:
    del sys.modules[name]
for name in ("fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty"):
    sys.modules[name] = None
for name in ("pthread_sigmask", "SIGKILL", "SIGHUP", "SIGALRM", "alarm", "setitimer"):
    delattr(signal, name)
for name in ("fork", "geteuid", "getuid", "fchmod", "killpg", "setsid", "O_DIRECTORY"):
    delattr(os, name)

import sme_registry
for module in pkgutil.walk_packages(sme_registry.__path__, "sme_registry."):
    importlib.import_module(module.name)
"""


def test_every_module_is_imported_without_posix():
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_POSIX],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert done.returncode == 0, done.stderr
