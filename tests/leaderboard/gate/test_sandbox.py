"""The sandbox: what a model may do, and that nothing it does hurts the process that asks it."""

import contextlib
import itertools
import os
import re
import shutil
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from leaderboard.documents.submission import MAX_ARTEFACT_BYTES
from leaderboard.errors import BoardError, Rejection, ScoringFault
from leaderboard.gate import child, sandbox
from leaderboard.gate import isolation as isolations
from leaderboard.gate.networks import network_of
from leaderboard.gate.sandbox import ROWS, Sandbox, SandboxLimits, inspect_own
from sme_registry.errors import MissingDependencyError, StateError
from tests.leaderboard.gate import models
from tests.leaderboard.gate.models import (
    ACTION,
    OBSERVATION,
    linear,
    model,
    node,
    squashed,
    tensor,
    value,
    weights,
)
from tests.leaderboard.serving import alive
from tests.leaderboard.store.crashing import fork

LIMITS = SandboxLimits()


@pytest.fixture(params=["bwrap", "process"])
def isolation(request, monkeypatch):
    """Each test that takes it runs under bwrap, where that is installed, and without."""
    if request.param == "bwrap" and shutil.which("bwrap") is None:
        pytest.skip("bubblewrap is not installed")
    monkeypatch.setattr(sandbox, "available_isolation", lambda: request.param)
    return request.param


@pytest.fixture
def unconfined(monkeypatch):
    """Without bwrap, so that the process started is the child itself."""
    monkeypatch.setattr(sandbox, "available_isolation", lambda: "process")


@pytest.fixture
def ungated(monkeypatch, tmp_path):
    """A gate with a hole as wide as itself: the sandbox stands alone."""
    shutil.copy(child.__file__, tmp_path / "child.py")
    hole = "class Refused(Exception): pass\nread = lambda *arguments: None"
    (tmp_path / "gate.py").write_text(hole)
    monkeypatch.setattr(child, "__file__", str(tmp_path / "child.py"))
    isolations._bwrap.cache_clear()
    yield
    isolations._bwrap.cache_clear()


def opened(found, limits=LIMITS, dims=(OBSERVATION, ACTION)):
    data = found if isinstance(found, bytes) else found.SerializeToString()
    return Sandbox(data, *dims, limits)


def observations(rows, width=OBSERVATION):
    return np.random.default_rng(0).random((rows, width), np.float32)


def run(found, limits, rows):
    with opened(found, limits) as policy:
        policy(observations(rows))
        policy.check_rows(observations(rows))


def code_of(found, limits=LIMITS, rows=8):
    """The code with which a model is rejected when it is loaded, run and checked."""
    with pytest.raises(Rejection) as caught:
        run(found, limits, rows)
    assert caught.value.message.endswith(".")
    return caught.value.code


def test_batches_of_every_size_are_answered_in_order_and_others_refused():
    with opened(squashed([node("Identity", "y", "a")])) as policy:
        assert policy(observations(0)).shape == (0, ACTION)
        for rows in (1, ROWS, ROWS + 1, 3 * ROWS):
            o = observations(rows)
            a = policy(o)
            assert a.shape == (rows, ACTION)
            np.testing.assert_allclose(a[-1:], policy(o[-1:]), atol=1e-6)
        for shape in ((3, 5), (4,), (1, 3, 4)):
            with pytest.raises(StateError, match=r"must be \[B, 4\]"):
                policy(np.zeros(shape, np.float32))
        assert policy(observations(2)).shape == (2, ACTION)
    policy.close()
    with pytest.raises(BoardError, match="closed"):
        policy(observations(3))


def test_what_onnxruntime_cannot_load_is_refused():
    assert code_of(model([node("MatMul", "o W", "a")], [weights(rows=5)])) == "onnx_refused"


FAILING = {
    "a failing run": (
        squashed(
            [node("Reshape", "y shape", "a")],
            [tensor("shape", np.int64([7, 2]))],
            outputs=[value("a", "batch", "width")],
        ),
        "run_failed",
    ),
    "the mean over the batch": (
        squashed([node("ReduceMean", "y", "m", axes=[0]), node("Sub", "y m", "a")]),
        "run_batch_dependent",
    ),
    "a memory bomb of operators that are allowed": (models.doubling(40), "run_memory"),
}


@pytest.mark.parametrize("kind", FAILING)
def test_a_failing_run_has_its_code(kind, unconfined):
    found, expected = FAILING[kind]
    inspect_own(found.SerializeToString(), OBSERVATION, ACTION)  # the gate cannot see it
    limits = SandboxLimits(memory_bytes=2**28)
    assert code_of(found, limits) == expected


POSITIONS = [tensor("end", np.int64([2**31]))]
POSITIONS += [
    tensor(name, np.int64([at])) for at, name in enumerate(["last", "zero", "one", "two"], -1)
]


def test_an_action_that_depends_on_both_neighbours_is_rejected():
    # In reverse order both neighbours are the same; in random order they are not.
    nodes = [
        node("Slice", "y one end", "after"),
        node("Slice", "y zero last", "before"),
        node("Slice", "y zero one", "first"),
        node("Slice", "y last end", "final"),
        node("Concat", "after first", "next", axis=0),
        node("Concat", "final before", "previous", axis=0),
        node("Sum", "y next previous", "a"),
    ]
    with (
        opened(squashed(nodes, POSITIONS)) as policy,
        pytest.raises(Rejection, match="run_batch_dependent"),
    ):
        policy.check_rows(observations(100), rows=0)


def amplified(*nodes, **tensors):
    """½ + factor · `d`, where the nodes compute `d` from `y` = o W."""
    nodes = [*nodes, node("Mul", "d factor", "amplified"), node("Add", "amplified half", "a")]
    named = [tensor(name, np.asarray(each, np.float32)) for name, each in tensors.items()]
    return squashed(nodes, [*named, tensor("half", np.float32(0.5))], opsets=[("", 20)])


SENSITIVE = {
    "the tail of a sigmoid": amplified(
        node("Abs", "y", "x"), node("Sub", "at x", "z"), node("Sigmoid", "z", "d"),
        at=-17.0, factor=1e7,
    ),
    "the fraction of a large multiple": amplified(
        node("Mul", "y large", "m"), node("Floor", "m", "f"), node("Sub", "m f", "d"),
        large=1e6, factor=0.5,
    ),
    "a wave of a large multiple": amplified(
        node("Mul", "y large", "m"), node("Sin", "m", "d"), large=1e6, factor=0.5,
    ),
    "the difference of nearly equal numbers": amplified(
        node("Tanh", "y", "u"), node("Mul", "y near", "n"), node("Tanh", "n", "v"),
        node("Sub", "u v", "d"), near=1.000001, factor=1e6,
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", SENSITIVE)
def test_actions_that_depend_on_the_last_place_of_observations_are_rejected(kind):
    with opened(SENSITIVE[kind]) as policy, pytest.raises(Rejection, match="run_rounding"):
        policy.check_last_place(observations(500))


def test_honest_policies_and_trees_keep_their_actions_in_the_last_place():
    step = squashed(
        [node("Greater", "y at", "c"), node("Cast", "c", "a", to=1)],
        [tensor("at", np.float32(0.25))],
    )
    for found in (linear(), models.network(hidden=64), models.network(hidden=2000), step):
        with opened(found) as policy:
            for rows in (1, 2, 500):
                policy.check_last_place(observations(rows))
                policy.check_rows(observations(rows))


def test_random_actions_and_a_small_file_of_gigabytes_are_rejected_without_the_gate(
    isolation, ungated
):
    assert code_of(squashed([node("RandomUniformLike", "y", "a")])) == "run_batch_dependent"
    bomb = models.memory_bomb()
    assert len(bomb.SerializeToString()) < 250
    assert code_of(bomb) == "run_memory"


def test_a_machine_short_of_memory_judges_only_what_its_memory_allows(unconfined, monkeypatch):
    monkeypatch.setattr(sandbox, "spare_memory", lambda: 300 * 2**20)
    for found in (models.doubling(40), models.doubling(24)):
        with pytest.raises(ScoringFault, match="the machine had 300 MiB to spare"):
            run(found, LIMITS, 8)
    with opened(linear()) as policy:
        policy.check_rows(observations(100))
    assert code_of(models.doubling(40), SandboxLimits(memory_bytes=200 * 2**20)) == "run_memory"


def test_a_process_with_too_little_memory_reads_nothing_and_rejects_nothing(
    monkeypatch, unconfined
):
    for granted, then in (("2**20", "say(0, 0)"), ("2**30", "say(0, 0); os.abort()")):
        acting_as(STARTED.replace("2**31", granted) + then, monkeypatch)
        with pytest.raises(ScoringFault, match="MiB to spare"), opened(linear()) as policy:
            policy(observations(8))


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_the_system_ends_the_process_before_the_scorer(isolation):
    with opened(linear()) as policy:
        last = policy._process.pid
        while below := Path(f"/proc/{last}/task/{last}/children").read_text().split():
            (last,) = below
        assert Path(f"/proc/{last}/oom_score_adj").read_text() == "1000\n"
        policy(observations(1))  # it runs; what libraries print is not read as an answer
        assert {os.readlink(f"/proc/{last}/fd/{number}") for number in (1, 2)} == {os.devnull}


def test_an_endless_loop_is_stopped_without_the_gate(isolation, ungated):
    limits = SandboxLimits(cpu_seconds=1, call_seconds=300.0)
    assert code_of(models.looping(), limits) == "run_time"


def test_the_time_of_a_policy_follows_from_states_agents_and_file():
    small = SandboxLimits.for_policy(5_000, 300_000).cpu_seconds
    assert 30 <= small <= 60
    assert SandboxLimits.for_policy(5_000, 12_000).cpu_seconds <= 12
    assert 250 <= SandboxLimits.for_policy(2**23, 300_000).cpu_seconds <= 300
    assert SandboxLimits.for_policy(5_000, 300_000, agents=3).cpu_seconds > 2 * small


def test_an_answer_that_takes_too_long_is_rejected(ungated, monkeypatch):
    monkeypatch.setattr(sandbox, "_BUSY", 0.01)  # other processes may take the rest
    limits = SandboxLimits(cpu_seconds=60, call_seconds=0.5)
    assert code_of(models.looping(), limits) == "run_time"


def test_external_data_cannot_be_read_without_the_gate(isolation, ungated, tmp_path):
    secret = tmp_path / "secret"
    secret.write_bytes(np.ones((OBSERVATION, ACTION), np.float32).tobytes())
    assert code_of(models.external(os.path.relpath(secret, "/"))) == "onnx_refused"


def test_other_formats_and_invalid_bytes_are_refused_without_the_gate(ungated, tmp_path):
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.optimized_model_filepath = str(tmp_path / "model.ort")
    options.add_session_config_entry("session.save_model_format", "ORT")
    onnxruntime.InferenceSession(linear().SerializeToString(), options)
    assert code_of((tmp_path / "model.ort").read_bytes()) == "onnx_refused"
    for data in (b"", b"\x08\x08" * 1000):
        assert code_of(data) in ("onnx_refused", "run_failed")


def test_denormal_numbers_are_zero():
    factors = {"small": 1e-25, "tiny": 1e-20, "large": 1e25, "huge": 1e20}
    names = ["y", *(f"{name}_y" for name in factors)]
    nodes = [
        node("Mul", f"{before} {name}", after)
        for name, (before, after) in zip(factors, itertools.pairwise(names), strict=True)
    ]
    tensors = [tensor(name, np.float32(factor)) for name, factor in factors.items()]
    with opened(squashed([*nodes, node("Identity", names[-1], "a")], tensors)) as policy:
        assert (policy(observations(8)) == 0.0).all()


def test_a_file_that_is_too_large_starts_no_process(monkeypatch):
    monkeypatch.setattr(sandbox, "start", lambda *arguments: pytest.fail("a process was started"))
    with pytest.raises(Rejection, match="too_large"):
        opened(bytes(MAX_ARTEFACT_BYTES + 1))


def children():
    """Processes started by this one that are not waited for."""
    listed = Path(f"/proc/{os.getpid()}/task").glob("*/children")
    return {int(pid) for path in listed for pid in path.read_text().split()}


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_no_process_outlives_its_sandbox(isolation, ungated):
    before = children()
    for found in (linear(), models.looping()):
        with (
            contextlib.suppress(Rejection, ScoringFault),
            opened(found, SandboxLimits(call_seconds=0.3)) as policy,
        ):
            assert children() - before
            policy(observations(3))
        assert children() == before


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_the_child_has_no_environment_no_files_and_no_rights(monkeypatch, unconfined):
    monkeypatch.setenv("SECRET", "do not tell")
    with open(__file__) as kept_open, opened(linear()) as policy:
        os.set_inheritable(kept_open.fileno(), True)
        proc = Path(f"/proc/{policy._process.pid}")
        assert b"do not tell" not in (proc / "environ").read_bytes()
        files = {os.readlink(entry) for entry in (proc / "fd").iterdir()}
        assert all(re.match(r"pipe:|/dev/null", file) for file in files), files
        limits = {line[:26].strip(): line[26:].split()[0]
                  for line in (proc / "limits").read_text().splitlines()[1:]}  # fmt: skip
        for none in ("open files", "file size", "core file size", "processes"):
            assert limits[f"Max {none}"] == "0"
        assert int(limits["Max cpu time"]) <= SandboxLimits().cpu_seconds + 10
        assert 2**31 < int(limits["Max address space"]) < 2**31 + 2**30
        status = (proc / "status").read_text()
        assert re.search(r"^NoNewPrivs:\s1$", status, re.M)


def test_under_bwrap_there_is_neither_a_network_nor_a_home(isolation, monkeypatch, tmp_path):
    if isolation != "bwrap":
        pytest.skip("without bwrap there is a network")
    (tmp_path / "board.key").write_text("secret")
    script = (
        "import os, socket, struct\n"
        f"seen = os.path.exists({str(tmp_path)!r})\n"
        "seen += len(open('/proc/net/dev').readlines()) > 3\n"  # two lines of heading, and lo
        "seen += any(pid.isdigit() and int(pid) > 5 for pid in os.listdir('/proc'))\n"
        "if not seen: os.write(1, struct.pack('<BIQ32s', 0, 40, 2**31, b''))\n"
        "os.read(0, 1)\n"
    )
    acting_as(script, monkeypatch)
    with pytest.raises(Rejection, match="ended with status 0"):  # no model, but content
        opened(linear())


def acting_as(script, monkeypatch):
    """In place of the child that serves a model, another program: one that was taken over."""
    monkeypatch.setattr(isolations, "_script", lambda: [sys.executable, "-I", "-S", "-c", script])


STARTED = (
    "import os, signal, struct, time; say = lambda s, n: os.write(1, struct.pack('<BI', s, n))\n"
    "say(0, 40); os.write(1, struct.pack('<Q32s', 2**31, b'1.0')); "
)
LOADED = STARTED + "say(0, 0); "
LIES = {
    "answers with another length": ("say(0, 2**32 - 1); time.sleep(60)", "run_failed"),
    "tells a story without end": (
        "say(2, 2**31)\nwhile True: os.write(1, bytes(2**16))", "run_failed"
    ),
    "answers half and ends": ("say(0, 64); os.write(1, b'xx')", "run_failed"),
    "answers without end": ("\nwhile True: os.write(1, bytes(2**16))", "run_failed"),
    "makes up a verdict": ("os.write(1, struct.pack('<BI', 1, 9) + b'quota now')", "run_failed"),
    "closes its pipes and hangs": ("os.close(0); os.close(1); time.sleep(60)", "run_failed"),
    "crashes": ("os.kill(os.getpid(), signal.SIGSEGV)", "run_failed"),
    "answers NaN": ("say(0, 64); os.write(1, b'\\xff' * 64); time.sleep(60)", "run_not_finite"),
}  # fmt: skip


@pytest.mark.parametrize("kind", LIES)
def test_a_compromised_child_cannot_harm_its_parent(kind, monkeypatch, unconfined):
    script, expected = LIES[kind]
    acting_as(LOADED + script, monkeypatch)
    monkeypatch.setattr(sandbox, "_ENDING_SECONDS", 0.2 if "hangs" in kind else 60.0)
    assert code_of(linear()) == expected


TENSOR = '{"type": "|O", "shape": [1], "data": "AAAAAAAAAAA="}'
MADE_UP = {
    "no JSON": "[" * 1000,
    "too many lists": "[" + "[]," * 2**20 + "[]]",
    "another document": "[1, 2]",
    "no nodes": '{"constants": {}}',
    "objects": f'{{"constants": {{"o": {TENSOR}}}, "nodes": [], "input": "o", "output": "o"}}',
    "nothing computed": '{"constants": {}, "nodes": [7], "input": [], "output": {}}',
    "another output": '{"constants": {}, "nodes": [], "input": "o", "output": "a"}',
}


@pytest.mark.parametrize("kind", MADE_UP)
def test_a_network_that_a_compromised_child_makes_up_is_none(kind, monkeypatch, unconfined):
    size = len(MADE_UP[kind])
    text = MADE_UP[kind] if kind != "too many lists" else None
    made = repr(text) if text else "'[' + '[],' * 2**20 + '[]]'"
    script = f"say(0, {size}); os.write(1, ({made}).encode()); time.sleep(60)"
    acting_as(STARTED + script, monkeypatch)
    assert network_of(b"", OBSERVATION, ACTION) is None


HANGING = {
    "answers half and hangs": "say(0, 64); os.write(1, b'xx'); time.sleep(60)",
    "reads nothing": "time.sleep(60)",
    "stops itself": "os.kill(os.getpid(), signal.SIGSTOP)",
}


@pytest.mark.parametrize("kind", HANGING)
def test_a_child_without_processor_time_does_not_reject_the_model(kind, monkeypatch, unconfined):
    acting_as(LOADED + HANGING[kind], monkeypatch)
    rows = ROWS if kind == "reads nothing" else 8  # 128 KiB, more than a pipe holds
    policy = opened(linear(), SandboxLimits(call_seconds=0.2))
    with policy, pytest.raises(ScoringFault, match="processor time"):
        policy(observations(rows))


def test_a_child_that_cannot_start_does_not_reject_the_model(monkeypatch, unconfined):
    limits = SandboxLimits(start_seconds=0.5)
    for script in ("raise SystemExit(3)", "import time; time.sleep(60)"):
        acting_as(script, monkeypatch)
        with pytest.raises(BoardError, match=r"did not start|not caused by the model"):
            opened(linear(), limits)


def test_a_child_killed_from_outside_does_not_reject_the_model(isolation):
    with opened(linear()) as policy:
        os.killpg(policy._process.pid, signal.SIGKILL)
        with pytest.raises(BoardError, match="not caused by the model"):
            policy(observations(3))


@pytest.mark.skipif(sys.platform != "linux", reason="PR_SET_PDEATHSIG")
def test_a_killed_parent_leaves_no_child_behind(isolation, ungated):
    read, write = os.pipe()
    parent = fork()
    if parent == 0:
        try:
            policy = opened(models.looping())
            os.write(write, str(policy._process.pid).encode())
            policy(observations(4))
        finally:
            os._exit(1)
    os.close(write)
    child = int(os.read(read, 20))
    os.close(read)
    os.kill(parent, signal.SIGKILL)
    os.waitpid(parent, 0)
    deadline = time.monotonic() + 60.0
    while alive(child) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not alive(child)


def test_a_missing_onnxruntime_is_an_error_with_the_install_command(monkeypatch, unconfined):
    isolations._library_folders.cache_clear()
    monkeypatch.setattr(isolations.importlib.util, "find_spec", lambda name: None)
    try:
        with pytest.raises(MissingDependencyError, match=r"pip install .*\[leader"):
            opened(linear())
    finally:
        isolations._library_folders.cache_clear()


def test_other_systems_raise_an_error_that_names_linux(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    with pytest.raises(BoardError, match=r"sys.platform='darwin': .* needs Linux"):
        opened(linear())
