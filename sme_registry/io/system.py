"""This process and its machine: installed packages, spare memory, and interrupts."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib.machinery
import importlib.util
import ipaddress
import math
import multiprocessing
import operator
import os
import platform
import re
import signal
import sys
import threading
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np

from sme_registry.errors import MissingDependencyError, OptionError, SMEError, did_you_mean
from sme_registry.version import __version__

_NAME = "sme-registry"
_EXTRA = re.compile(r"""([\w.-]+).*\bextra\s*==\s*['"]([\w-]+)['"]""")


def versions(packages: Iterable[str], *, if_imported: Iterable[str] = ()) -> dict[str, str]:
    """Versions of this package, of Python, and of the named packages that are installed."""
    installed = {"sme_registry": __version__, "python": platform.python_version()}
    for name in (*packages, *(name for name in if_imported if name in sys.modules)):
        if version := _version(name):
            installed[name] = version
    return installed


@functools.cache  # it searches the whole path, and a study asks of every cell
def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except (metadata.PackageNotFoundError, ValueError):  # ValueError: an empty name
        return None


def is_installed(package: str) -> bool:
    """Whether a package can be imported; does not import it."""
    return importlib.util.find_spec(package) is not None


def require_packages(
    purpose: str, packages: Mapping[str, str], extra: str, *, otherwise: str = ""
) -> None:
    """Raise if optional packages (name to import → full name) are not installed."""
    missing = [name for package, name in packages.items() if not is_installed(package)]
    if missing:
        raise _missing(missing, extra, f"{purpose}: ", otherwise)


def missing_dependency(
    error: ModuleNotFoundError, extra: str = ""
) -> MissingDependencyError | None:
    """The error to report instead of a failed import: which extra has the module."""
    module = (error.name or "").partition(".")[0]
    package = module.lower().replace("_", "-")
    extras = {name: has for name, has in _extras().items() if package in has and name != "dev"}
    if not extras:
        return None
    smallest = min(extras, key=lambda name: len(extras[name]))
    return _missing([module], extra if extra in extras else smallest)


def install_command(extra: str) -> str:
    return f"pip install '{_NAME}[{extra}]'"


def _missing(
    packages: Sequence[str], extra: str, purpose: str = "", otherwise: str = ""
) -> MissingDependencyError:
    verb = "is" if len(packages) == 1 else "are"
    return MissingDependencyError(
        f"{purpose}{' and '.join(packages)} {verb} not installed. "
        f"Run `{install_command(extra)}`{', or ' + otherwise if otherwise else ''}."
    )


def _extras() -> dict[str, set[str]]:
    """The packages of each extra; those of an extra that it contains are included."""
    try:
        requirements = metadata.requires(_NAME) or []
    except metadata.PackageNotFoundError:
        return {}
    extras: dict[str, set[str]] = {}
    for match in filter(None, map(_EXTRA.match, requirements)):
        package, extra = match.groups()
        extras.setdefault(extra, set()).add(package.lower().replace("_", "-"))
    return extras


def import_object(name: str, field: str, error: type[SMEError]) -> Any:
    """Import an object by the name `module:attribute`. The working directory is searched first."""
    module_name, _, attribute = name.partition(":")
    near = ""
    try:
        with working_directory_importable():
            module = importlib.import_module(module_name)
            near = did_you_mean(attribute, dir(module))
            return getattr(module, attribute)
    except SMEError:
        raise
    except Exception as reason:
        raise error(
            f"{field}={name!r}: cannot be imported: {type(reason).__name__}: {reason}.{near} It "
            "must be module:function, with the module in the working directory or installed."
        ) from reason


@contextlib.contextmanager
def working_directory_importable() -> Iterator[None]:
    """Modules in the working directory can be imported inside the block."""
    folder = os.getcwd()
    sys.path.insert(0, folder)
    try:
        yield
    finally:
        sys.path.remove(folder)


def module_file(module: str) -> str | None:
    """The file of a module, also in the working directory; imports nothing."""
    # `importlib.util.find_spec` would import the packages that it is in.
    places: Any = None
    spec: Any = None
    with working_directory_importable():
        for end in (i for i, letter in enumerate(f"{module}.") if letter == "."):
            spec = importlib.machinery.PathFinder.find_spec(module[:end], places)
            if spec is None:
                return None
            places = spec.submodule_search_locations
    path: str | None = spec.origin
    return path


_PROC = Path("/proc")
_CGROUPS = Path("/sys/fs/cgroup")


def available_memory() -> int | None:
    """Bytes that a process can use before the system ends one; outside Linux all of the memory."""
    try:
        lines = (_PROC / "meminfo").read_text().splitlines()
    except OSError:
        if not hasattr(os, "sysconf"):
            return None
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    kibibytes = {line.partition(":")[0]: int(line.split()[1]) for line in lines}
    spare = [limit - used for limit, used in _cgroup_memory()]
    return max(0, min([kibibytes["MemAvailable"] * 1024, *spare]))


def _cgroup_memory() -> Iterator[tuple[int, int]]:
    """Limit and use, in bytes, of each control group with a limit that this process is in."""
    try:
        membership = (_PROC / "self" / "cgroup").read_text()
    except OSError:  # a kernel without control groups
        return
    for line in membership.splitlines():
        _, controllers, path = line.split(":", 2)
        if not controllers:  # version 2
            root, names = _CGROUPS, ("memory.max", "memory.current", "inactive_file")
        elif "memory" in controllers.split(","):
            root = _CGROUPS / "memory"
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        else:
            continue
        group = root / path.lstrip("/")
        for folder in (group, *group.parents):
            if folder.is_relative_to(root):
                yield from _limit_and_use(folder, *names)


def _limit_and_use(
    folder: Path, limit_name: str, use_name: str, cache_name: str
) -> Iterator[tuple[int, int]]:
    try:
        limit = (folder / limit_name).read_text().strip()
        use = int((folder / use_name).read_text())
        statistics = dict(map(str.split, (folder / "memory.stat").read_text().splitlines()))
    except OSError:  # the root has no limit, and in a container the outer folders are not visible
        return
    if limit != "max":
        yield int(limit), use - int(statistics.get(cache_name, "0"))


def available_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextlib.contextmanager
def children_without_main() -> Iterator[None]:
    """Processes that are spawned inside the block do not import the script that runs.

    So it needs no `__main__` guard, without which it would run again in each of them.
    """
    main = vars(sys.modules["__main__"])
    hidden: dict[str, Any] = {name: main[name] for name in ("__file__", "__spec__") if name in main}
    main.pop("__file__", None)
    main["__spec__"] = None
    try:
        yield
    finally:
        main.update(hidden)


@contextlib.contextmanager
def child_environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Environment variables of the processes that are started inside the block."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def defer_interrupts() -> Iterator[None]:
    """Deliver an interrupt only after the block, so that the files it writes agree."""
    received: list[int] = []
    in_main_thread = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, lambda *_: received.append(1)) if in_main_thread else None
    try:
        yield
    finally:
        if before is not None:
            signal.signal(signal.SIGINT, before)
    if received:
        signal.raise_signal(signal.SIGINT)


@contextlib.contextmanager
def block_interrupts() -> Iterator[None]:
    """Processes started inside the block begin with interrupts blocked: none prints a traceback."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # starting it later would unblock the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def unblock_interrupts() -> None:
    """Accept interrupts in a process that began with them blocked, including one already sent."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def end_with_parent() -> None:
    """End this process when its parent ends, for any reason."""
    if sys.platform == "linux":
        set_parent_death_signal = 1  # PR_SET_PDEATHSIG
        ctypes.CDLL(None).prctl(set_parent_death_signal, signal.SIGKILL)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait_for_parent() -> None:
        parent.join()  # returns at the end of a pipe that only the parent holds
        os._exit(1)

    threading.Thread(target=wait_for_parent, daemon=True).start()


def integer_in(
    name: str,
    value: Any,
    low: int,
    high: int | None = None,
    *,
    advice: str = "",
) -> int:
    """Check an integer argument. NumPy's integers count, booleans and floats do not."""
    try:
        number = None if type(value).__name__ in ("bool", "bool_") else operator.index(value)
    except TypeError:
        number = None
    if number is None or number < low or (high is not None and number > high):
        allowed = f"of at least {low:,}" if high is None else f"in [{low:,}, {high:,}]"
        advice = advice and f" {advice}"
        raise OptionError(f"{name}={_shown(value)}: must be an integer {allowed}.{advice}")
    return number


def number_in(name: str, value: Any, low: float, high: float = math.inf) -> float:
    """Check a finite number, as `integer_in` checks an integer; booleans do not count."""
    is_number = isinstance(value, int | float | np.number) and type(value).__name__ != "bool"
    if not is_number or not (math.isfinite(value) and low <= value <= high):
        allowed = f"of at least {low:g}" if high == math.inf else f"in [{low:g}, {high:g}]"
        raise OptionError(f"{name}={_shown(value)}: must be a finite number {allowed}.")
    return float(value)


def _shown(value: Any) -> str:
    """A value as a user would type it: `1.7`, not `np.float64(1.7)`."""
    return repr(value.item() if isinstance(value, np.generic) else value)[:60]


def choice(
    name: str, value: Any, allowed: Collection[str], *, error: type[SMEError] = OptionError
) -> str:
    """Check that an argument is one of a few allowed names, and return it."""
    if isinstance(value, str) and value in allowed:
        return value
    *others, last = map(repr, allowed)
    names = f"{', '.join(others)} or {last}" if others else last
    near = did_you_mean(value, allowed) if isinstance(value, str) else ""
    raise error(f"{name}={value!r:.60}: must be {names}.{near}")


class Address(NamedTuple):
    """Where a server is reached; `path` ends in no slash."""

    url: str  # the same text for each way to write the address
    is_https: bool
    host: str  # without brackets
    port: int | None  # None is the usual one
    path: str

    @property
    def is_local(self) -> bool:
        """Whether it is on this machine, which is reached without a proxy or encryption."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"


def server_address(url: str, *, insecure: bool = False) -> Address:
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        parts, port = urlsplit(""), None
    others = parts.username, parts.password, parts.query, parts.fragment
    is_plain = not any(others) and url.isprintable() and " " not in url
    if parts.scheme not in ("http", "https") or not parts.hostname or not is_plain:
        raise OptionError(
            f"url={url!r:.80}: must be http(s)://host[:port][/path]. Copy it from the board's page."
        )
    host, path = parts.hostname, parts.path.rstrip("/")
    name = "127.0.0.1" if host == "localhost" else f"[{host}]" if ":" in host else host
    usual = {"http": 80, "https": 443}[parts.scheme]
    place = name if port in (None, usual) else f"{name}:{port}"
    address = Address(f"{parts.scheme}://{place}{path}", parts.scheme == "https", host, port, path)
    if not (address.is_https or address.is_local or insecure):
        raise OptionError(
            f"url={url!r:.80}: must be https for another machine. "
            "Use https, or a tunnel to the board."
        )
    return address


# Letters that take no ink or no width, and which Python calls printable.
_INVISIBLE = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u2800\u3164\ufe00-\ufe0f\uffa0"
    "\U0001d173-\U0001d17a\U000e0100-\U000e01ef]"
)


def hidden_in(text: str) -> set[str]:
    """The characters of a text that a terminal obeys or does not show, but for line breaks."""
    if text.isascii() and text.isprintable():
        return set()
    hidden = {letter for letter in text if not letter.isprintable()} - {"\n"}
    return hidden.union(_INVISIBLE.findall(text))


def visible(text: str) -> str:
    """A text with hidden characters as escapes, such as `\\x1b` and `\\u202e`."""
    escapes = {ord(each): each.encode("unicode_escape").decode() for each in hidden_in(text)}
    return text.translate(escapes)
