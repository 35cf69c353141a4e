"""Cells as tasks of Ray. Nearly all of the time here is Ray's own: 15 to 30 s for each start."""

import pytest

from sme_registry.errors import OptionError
from sme_registry.studies.ledger import Ledger
from sme_registry.studies.runner import run_study
from tests.studies import cells
from tests.studies.cells import python, small_file

pytest.importorskip("ray")

# In a process of its own: Ray leaves handles to the garbage collector, and threads to whoever is
# next. Two nodes on this machine; the larger one is removed as soon as cells fill both.
LOST_NODE = """
import sys, threading
from functools import partial
from pathlib import Path
from sme_registry.studies.runner import run_study
from tests.studies import cells

study, notes = map(Path, sys.argv[1:])
from ray.cluster_utils import Cluster

cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
lost = cluster.add_node(num_cpus=2)

def lose():
    cells.wait_for(lambda: len(cells.pids(notes)) == 3, seconds=200)
    workers = cells.pids(notes)
    cluster.remove_node(lost, allow_graceful=False)
    # A worker outlives its node for a moment, in which it could still end its cell.
    cells.wait_for(lambda: sum(map(cells.alive, workers)) == 1, seconds=100)
    (notes / cells.GATE).touch()

losing = threading.Thread(target=lose)
losing.start()
run_study(
    cells.small_file(seeds=6), study, executor="ray", ray=cluster.address,
    run=partial(cells.gated, notes),
)
losing.join()
cluster.shutdown()
"""


def test_when_a_node_is_lost_its_cells_run_again_and_every_cell_has_one_result(tmp_path):
    study, notes = tmp_path / "study", tmp_path / "notes"
    notes.mkdir()
    process = python(LOST_NODE, study, notes)
    assert process.returncode == 0, process.stderr
    keys = {planned.cell.digest for planned in small_file(seeds=6).plan.cells}
    assert set(Ledger(study).results()) == keys
    assert not Ledger(study).failures()
    began = cells.starts(notes)
    assert set(began) == keys
    # Three ran when the node was lost. The two that ran there began once more; no other did.
    assert sorted(began.values()) == [1, 1, 1, 1, 2, 2]


def test_a_local_cluster_is_started_quietly_and_ends_with_the_command(tmp_path):
    plan, study = tmp_path / "plan.json", tmp_path / "study"
    file = small_file(seeds=2, algorithms=["constant", {"name": "bad", "uses": "math:sqrt"}])
    file.write(plan)
    command = ("study", "run", plan, "-f", study, "--ray", "local", "--jobs", "1")
    process = python("from sme_registry.cli import main; main()", *command)
    assert process.returncode == 1, process.stderr
    assert len(Ledger(study).results()) == 2
    assert len(Ledger(study).failures()) == 2
    lines = process.stderr.splitlines()
    ours = (
        "This plan runs the code of math.",
        "study small-v1: ",
        "failed: bad on small",
        "2 of 4 cells failed",
    )
    assert [line for line in lines if not line.startswith(ours)] == []


def test_an_address_that_nobody_answers_at_is_refused_and_nothing_is_written(tmp_path):
    with pytest.raises(OptionError, match=r"cannot be reached: .* Give 'local'"):
        run_study(small_file(), tmp_path / "study", executor="ray", ray="127.0.0.1:1")
    assert not (tmp_path / "study").exists()
