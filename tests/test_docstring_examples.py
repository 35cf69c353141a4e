"""Every public function has an example in its docstring, and every example holds.

In examples, `np` is NumPy and `sme_registry` is imported. They run in a folder of their own, with a
run of PPO in `runs/ppo`, a life in a stream in `runs/life`, a data set in `data`, a finished study
in `study`, and a ticket of a sealed season in `ticket.json`.
"""

import dataclasses
import doctest
import importlib
import inspect
import shutil

import numpy as np
import pytest
from pydantic import BaseModel

import sme_registry
from sme_registry.datasets import make_dataset
from sme_registry.evaluation.evaluate import resolve_protocol
from sme_registry.seasons import Ticket
from sme_registry.seasons.transcript import Signer
from sme_registry.seasons.wire import TicketClass
from sme_registry.spec import Setting, StreamSpec, StudyAlgorithm, StudyFile, StudyPlan, SuiteClass
from sme_registry.studies import run_study
from sme_registry.training import train

FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
SHORT_PPO = {"n_steps": 128, "batch_size": 64, "n_epochs": 1}


def public_things():
    """The functions and classes that users import, by their names."""
    modules = ["sme_registry", *(f"sme_registry.{name}" for name in sme_registry._SUBMODULES)]
    found = {}
    for name in modules:
        module = importlib.import_module(name)
        for public in getattr(module, "__all__", ()):
            thing = getattr(module, public)
            ours = getattr(thing, "__module__", "").startswith("sme_registry")
            if ours and (inspect.isfunction(thing) or inspect.isclass(thing)):
                found.setdefault(thing, f"{name}.{public}")
    return {name: thing for thing, name in found.items()}


def is_record(thing):
    """Whether it only holds fields, which functions return and its docstring describes."""
    return inspect.isclass(thing) and (
        issubclass(thing, BaseModel | BaseException | tuple) or dataclasses.is_dataclass(thing)
    )


THINGS = public_things()
FINDER = doctest.DocTestFinder(recurse=False)


def example_of(name):
    return next((test for test in FINDER.find(THINGS[name], name) if test.examples), None)


WITH_EXAMPLE = [name for name in THINGS if example_of(name)]


@pytest.fixture(scope="session")
def prepared(tmp_path_factory):
    """What the examples find in their folder."""
    folder = tmp_path_factory.mktemp("examples")
    quick = {"protocol": "quick-v1", "progress": False}
    task = sme_registry.load("Default")
    phases = [{"spec": task, "steps": 128}, {"spec": task.derive(complexity=2), "steps": 128}]
    for name, document in (("ppo", task), ("life", StreamSpec(phases=phases))):
        train(
            document,
            algorithm="PPO",
            steps=128 if name == "ppo" else None,
            folder=folder / "runs" / name,
            hyperparameters=SHORT_PPO,
            **quick,
        )
    make_dataset("Default", 0.5, transitions=200, folder=folder / "data", protocol="quick-v1")
    plan = StudyPlan(
        classes=(SuiteClass(name="default", setting=Setting(), seeds=(1, 2)),),
        algorithms=(
            StudyAlgorithm(name="linear", uses="reference:linear"),
            StudyAlgorithm(name="constant", uses="reference:constant"),
            StudyAlgorithm(name="PPO", uses="PPO", hyperparameters=SHORT_PPO),
        ),
        seeds=2,
        steps=128,
        evaluations=1,
        evaluation_episodes=1,
        protocol=resolve_protocol("quick-v1"),
    )
    file = StudyFile(name="tiny", digest=plan.digest, plan=plan)
    run_study(file, folder / "study", executor="in-process", keep_models=True, progress=False)
    deep = TicketClass(name="deep", setting=Setting(complexity=10), instances=2, budget=1000)
    ticket = Ticket(
        season="winter",
        ticket=3,
        token="0" * 64,
        deadline="2099-12-31T00:00:00Z",
        lanes=8,
        classes=(deep,),
        signer=Signer(board="0" * 64, request="sha256:" + "0" * 64, key="1" * 64),
    )
    ticket.write(folder / "ticket.json")
    return folder


@pytest.fixture
def desk(prepared, tmp_path, monkeypatch):
    """A copy of it, so that no example needs another to have run."""
    shutil.copytree(prepared, tmp_path / "desk")
    monkeypatch.chdir(tmp_path / "desk")
    registered = dict(sme_registry.registration.gymnasium.registry)
    yield
    sme_registry.registration.gymnasium.registry.clear()
    sme_registry.registration.gymnasium.registry.update(registered)


def test_the_public_things_are_those_of_every_submodule():
    assert {"sme_registry.make", "sme_registry.plots.decay_curve"} <= THINGS.keys()
    assert 100 < len(THINGS) <= 150  # each is a promise


@pytest.mark.parametrize("name", [name for name in THINGS if not is_record(THINGS[name])])
def test_a_public_function_or_class_has_an_example(name):
    assert name in WITH_EXAMPLE


@pytest.mark.usefixtures("desk")
@pytest.mark.parametrize("name", WITH_EXAMPLE)
def test_the_example_holds(name):
    test = example_of(name)
    assert test is not None
    test.globs = {"np": np, "sme_registry": sme_registry}
    output = []
    result = doctest.DocTestRunner(optionflags=FLAGS).run(test, out=output.append)
    assert not result.failed, "".join(output)
