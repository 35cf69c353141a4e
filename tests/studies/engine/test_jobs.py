"""Which cells are runs of one program, and how a run claims them beside others."""

import contextlib

import pytest

from sme_registry.errors import OptionError
from sme_registry.studies.executors import InProcess
from sme_registry.studies.ledger import Ledger, write_state
from sme_registry.studies.result import failed
from sme_registry.studies.runner import run_study
from tests.studies.cells import file_of, quick

pytest.importorskip("jax")

from sme_registry.studies.programs import Programs


def plan_file(seeds=3, **fields):
    """Two classes of one group and a third that cannot share their program, and a reference."""
    small = {"state_dim": 2, "action_dim": 2}
    fields = {
        "classes": [
            {"name": "small", "setting": small, "seeds": [1, 2]},
            {"name": "gated", "setting": small | {"r_min": 0.5}, "seeds": [1, 2]},
            {"name": "delayed", "setting": small | {"k": 5}, "seeds": [1, 2]},
        ],
        "algorithms": [
            {"name": "PPO", "uses": "jax:PPO"},
            {"name": "linear", "uses": "reference:linear", "steps": 0},
        ],
        "seeds": seeds,
        "evaluations": 0,
    } | fields
    return file_of("lanes", **fields)


def cells(file, *classes):
    """Those that use JAX, in the plan's order."""
    return [
        planned.cell
        for planned in file.plan.cells
        if planned.algorithm == "PPO" and (not classes or planned.class_name in classes)
    ]


class Refusing(InProcess):
    """An executor that records jobs, and fails their cells."""

    def __init__(self, meanwhile=None, while_waiting=None):
        """Functions: one is called with the number of jobs so far, one where none is available."""
        super().__init__()
        self.jobs = []
        self.meanwhile, self.while_waiting = meanwhile, while_waiting

    def map(self, jobs, progress):
        for job in jobs:
            if job is None:
                self.while_waiting()
                continue
            self.jobs.append(job)
            if self.meanwhile is not None:
                self.meanwhile(len(self.jobs))
            yield from (failed(cell, "refused", "") for cell in job.cells)


def claimed(file, study, **options):
    """The jobs of a run, those of a program first."""
    hooks = {name: options.pop(name, None) for name in ("meanwhile", "while_waiting")}
    executor = Refusing(**hooks)
    quick(file, study, executor=executor, device="cpu", **options)
    return sorted(executor.jobs, key=lambda job: job.program is None)


def test_cells_of_one_shape_and_kind_of_reward_share_a_program_and_others_do_not():
    file = plan_file()
    programs = Programs(cells(file), "cpu")
    small, gated, delayed = (cells(file, name)[0] for name in ("small", "gated", "delayed"))
    assert programs.group(small) == programs.group(gated) == programs.group(cells(file, "small")[2])
    assert programs.group(small) != programs.group(delayed)
    for change in (
        {"steps": 10},
        {"uses": "jax:TD3"},
        {"hyperparameters": {"n_steps": 8}},
        {"action_range": "unit"},
        {"evaluations": 3},
        {"evaluation_episodes": 3},
        {"spec": small.spec.model_copy(update={"state_dim": 3})},
        {"spec": small.spec.model_copy(update={"complexity": 2})},
        {"spec": small.spec.derive(safety={"tightness": 0.2})},
        {"spec": small.spec.derive(observation={"mixing": "orthogonal"})},
    ):
        assert programs.group(small.model_copy(update=change)) != programs.group(small), change
    for change in ({"seed": 9}, {"spec": small.spec.model_copy(update={"horizon": 7})}):
        assert programs.group(small.model_copy(update=change)) == programs.group(small), change


@pytest.mark.parametrize(("seeds", "most", "runs"), [(5, 10, 10), (13, 10, 9)])
def test_the_programs_of_a_group_have_equally_many_runs_at_most_the_limit(seeds, most, runs):
    file = plan_file(seeds)
    programs = Programs(cells(file), "cpu", most)
    assert {programs.runs(cell) for cell in cells(file, "small", "gated")} == {runs}


def test_a_run_claims_the_cells_of_one_program_at_a_time_and_references_alone(tmp_path):
    file = plan_file()
    jobs = claimed(file, tmp_path)
    *programs, first, _ = jobs[:2], *jobs[2:]
    together, delayed = programs[0]
    assert [cell.digest for cell in together.cells] == [
        cell.digest for cell in cells(file, "small", "gated")
    ]
    assert list(delayed.cells) == cells(file, "delayed")
    assert (together.program.runs, together.program.build_key["shape"]) == (6, [2, 2, 1, 0])
    assert first.program is None
    assert {len(job.cells) for job in jobs[2:]} == {1}


def test_the_number_of_runs_depends_neither_on_a_selection_nor_on_what_is_done(tmp_path):
    file = plan_file()
    (job,) = claimed(file, tmp_path, only=["class=gated", "algorithm=PPO"])
    assert list(job.cells) == cells(file, "gated")
    assert job.program.runs == 6
    jobs = claimed(file, tmp_path, only=["algorithm=PPO"])
    assert list(jobs[0].cells) == cells(file, "small")
    assert {job.program.runs for job in jobs if job.program} == {6, 3}


def test_cells_that_another_run_holds_are_left_to_it_and_the_rest_to_others(tmp_path):
    file = plan_file(seeds=4)
    of_group = cells(file, "small", "gated")
    ledger = Ledger(tmp_path)
    with contextlib.ExitStack() as held:
        theirs = [ledger.lock(cell.digest) for cell in of_group[1:3]]
        free = []

        def meanwhile(jobs):
            if jobs == 1:
                others = [ledger.is_running(cell.digest) for cell in of_group[6:]]
                free.extend(not running for running in others)
            for lock in theirs:
                if lock is not None:
                    lock.release()

        held.callback(lambda: [lock.release() for lock in theirs if lock])
        first, *_ = claimed(file, tmp_path, only=["algorithm=PPO"], lanes=4, meanwhile=meanwhile)
    assert list(first.cells) == [of_group[0], *of_group[3:6]]
    assert free == [True, True]


def test_while_another_run_claims_a_program_this_one_waits(tmp_path):
    claiming = Ledger(tmp_path).claim_lock()
    assert claiming is not None
    waited = []

    def release():
        waited.append(True)
        claiming.release()

    only = ["algorithm=PPO", "class=delayed"]
    (job,) = claimed(plan_file(), tmp_path, only=only, while_waiting=release)
    assert len(job.cells) == 3
    assert waited == [True]


def test_programs_on_ray_run_on_cpus_alone(tmp_path):
    with pytest.raises(
        OptionError, match=r"device='gpu': must be cpu on a cluster.*use --executor processes"
    ):
        run_study(plan_file(), tmp_path, executor="ray", device="gpu")


def test_a_saved_state_decides_which_cells_go_on_together(tmp_path):
    file = plan_file(seeds=4)
    of_group = cells(file, "small", "gated")
    ledger = Ledger(tmp_path)
    keys = [of_group[i].digest for i in (6, 0, 3)]
    build_key = Programs(cells(file), "cpu").program(of_group[0]).build_key
    saved = ledger.state_path(keys)
    assert saved != ledger.state_path(keys, build_key)  # others leave it as it is
    write_state(saved, {"cells": keys, **build_key}, {})
    write_state(ledger.state_path(keys[:2]), {"cells": keys[:2], **build_key, "lanes": 2}, {})
    (tmp_path / "states" / "broken.npz").write_bytes(b"PK")
    first, second, *_ = claimed(file, tmp_path, only=["algorithm=PPO"])
    assert {cell.digest for cell in first.cells} == set(keys)
    assert first.program.state == saved
    assert [cell.digest for cell in first.program.cells] == keys
    assert list(second.cells) == [of_group[i] for i in (1, 2, 4, 5, 7)]
    assert saved.exists()  # a retry goes on from it
