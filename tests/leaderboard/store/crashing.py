"""Kill a process, or fill a disk, at a chosen point."""

import contextlib
import os
import shutil
import subprocess
import sys
import warnings

CALLS = ("fsync", "link", "replace", "rename", "unlink", "fchmod")
_CRASHED = 77


def fork():
    """`os.fork`. JAX, if an earlier test has loaded it, warns of its threads; no child uses it."""
    with warnings.catch_warnings(action="ignore"):
        return os.fork()


def crashes_before(call, work):
    """Whether a fork that does some work ends before its n-th call that matters."""
    child = fork()
    if child == 0:
        status = 1
        try:
            _exit_before(call)
            work()
            status = 0
        except BaseException as error:
            sys.stderr.write(f"{error!r}\n")
        finally:
            os._exit(status)  # no exit handlers of pytest's
    _, status = os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(status)
    assert code in (0, _CRASHED), code
    return code == _CRASHED


def _exit_before(call):
    left = call

    def counted(real):
        def before(*arguments, **named):
            nonlocal left
            if left == 0:
                os._exit(_CRASHED)
            left -= 1
            return real(*arguments, **named)

        return before

    for name in CALLS:
        setattr(os, name, counted(getattr(os, name)))


@contextlib.contextmanager
def small_disk(path, size="1m"):
    """A file system of its own, in memory; None where none may be mounted."""
    path.mkdir()
    mount = shutil.which("mount")
    mounted = mount is not None and _succeeds(
        mount, "-t", "tmpfs", "-o", f"size={size}", "none", path
    )
    try:
        yield path if mounted else None
    finally:
        if mounted:
            subprocess.run(["umount", "-l", path], check=True)


def fill(path, free):
    """Fill a disk but for so many bytes."""
    with open(path, "wb", buffering=0) as stream:
        for size in (4096, 1):
            with contextlib.suppress(OSError):
                while True:
                    stream.write(bytes(size))
        stream.truncate(max(0, stream.tell() - free))


def make_read_only(path):
    """Remount a `small_disk` read-only, also for root."""
    subprocess.run(["mount", "-o", "remount,ro", path], check=True)


def _succeeds(*command):
    return subprocess.run(command, capture_output=True, check=False).returncode == 0
