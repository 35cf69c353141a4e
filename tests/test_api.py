"""The public names of the package, and what those that handle documents promise."""

import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import pytest

import sme_registry
from sme_registry import errors
from sme_registry.errors import NameTakenError, OptionError, SMEError, SpecError
from sme_registry.spec import SMESpec

ROOT_SOURCE = Path(sme_registry.__file__).read_text(encoding="utf-8")
CONTRACT = {
    "SMESpec", "StreamSpec", "EvaluationProtocol", "Task", "load", "save", "register",
    "materialize", "make", "make_vec", "make_parallel", "make_aec", "env_spec", "evaluate",
    "EvaluationReport", "StreamReport", "train", "train_offline", "make_dataset", "export_onnx",
    "diagnose", "run_study", "load_study", "compare", "SMEError", "values",
    "Profile", "profile",
}  # fmt: skip


def test_the_public_names_are_sorted_and_hold_the_contract():
    assert sme_registry.__all__ == sorted(set(sme_registry.__all__))
    assert set(sme_registry.__all__) == CONTRACT


def test_a_public_name_can_be_imported_and_is_documented():
    for name in sme_registry.__all__:
        assert getattr(sme_registry, name).__doc__, name  # its own, not its base's
        assert name in dir(sme_registry)


SUBMODULES = [
    "datasets", "diagnosis", "envs", "errors", "evaluation", "plots", "sb3", "seasons", "spec",
    "statistics", "studies", "task", "teams", "testing", "training",
]  # fmt: skip


def test_submodules_are_attributes_after_one_import():
    script = (
        "import sys, sme_registry\n"
        "assert 'sme_registry.datasets' not in sys.modules\n"
        f"for name in {SUBMODULES}:\n"
        "    assert name in dir(sme_registry), name\n"
        "    assert getattr(sme_registry, name) is sys.modules[f'sme_registry.{name}'], name\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_type_checker_sees_every_name_that_is_loaded_on_first_use():
    imported = ROOT_SOURCE[ROOT_SOURCE.index("if TYPE_CHECKING") : ROOT_SOURCE.index("__all__")]
    for name in SUBMODULES:
        assert f"from sme_registry import {name} as {name}\n" in imported
    for name, path in sme_registry._LAZY.items():
        module, _, attribute = path.rpartition(".")
        assert re.search(rf"from {module} import .*\b{attribute}\b", imported), name


@pytest.mark.parametrize("name", [name for name in SUBMODULES if name != "errors"])
def test_a_public_module_lists_its_names_in_order(name):
    module = importlib.import_module(f"sme_registry.{name}")
    capitals_first = sorted(module.__all__, key=lambda text: (not text.isupper(), text))
    assert module.__all__ == capitals_first
    for public in module.__all__:
        assert hasattr(module, public)


def test_an_unknown_attribute_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'maek'"):
        sme_registry.maek  # noqa: B018


def test_every_error_is_ours_documented_and_drawn_in_the_tree():
    kinds = [
        kind
        for kind in vars(errors).values()
        if inspect.isclass(kind) and kind.__module__ == errors.__name__
    ]
    assert len(kinds) > 10
    for kind in kinds:
        assert issubclass(kind, SMEError)
        assert kind.__doc__
        assert kind.__name__ in errors.__doc__


class TestRegister:
    def test_a_spec_of_your_own_is_made_by_its_name(self):
        spec = SMESpec(state_dim=3, action_dim=2, seed=101)
        assert sme_registry.register(spec, "Api-Own_1") == "SME/Api-Own_1-v1"
        env = gymnasium.make("SME/Api-Own_1-v1")
        assert env.unwrapped.sme_spec == spec
        assert env.spec.id == "SME/Api-Own_1-v1"
        for name in ("SME/Api-Own_1-v1", "Api-Own_1-v1", "Api-Own_1"):
            assert sme_registry.load(name) == spec
            assert sme_registry.make(name).unwrapped.sme_spec == spec
        assert sme_registry.load(spec.digest) == spec

    def test_the_same_spec_again_changes_nothing(self):
        spec = SMESpec(seed=102)
        first = sme_registry.register(spec, "ApiAgain")
        count = len(gymnasium.registry)
        for name in ("ApiAgain", "ApiAgain-v1", "SME/ApiAgain-v1"):
            assert sme_registry.register(spec.to_dict(), name) == first
        assert sme_registry.register(SMESpec(), "Default") == "SME/Default-v1"
        assert len(gymnasium.registry) == count

    def test_another_spec_cannot_take_a_name(self):
        sme_registry.register(SMESpec(seed=103), "ApiTaken")
        with pytest.raises(NameTakenError, match="a released id never changes its numbers"):
            sme_registry.register(SMESpec(seed=104), "ApiTaken")
        with pytest.raises(NameTakenError, match="'SME/Default-v1' stands for another spec"):
            sme_registry.register(SMESpec(seed=104), "Default")
        assert sme_registry.load("ApiTaken") == SMESpec(seed=103)
        assert sme_registry.load("Default") == SMESpec()

    @pytest.mark.parametrize(
        "name",
        ["", "a b", "a/b", "SME/a/b", "a:b", "a@1", "ä", "a\n", "x" * 65, "a-v2", "-v1", 5.5],
    )
    def test_a_name_that_no_registry_takes_is_refused(self, name):
        count = len(gymnasium.registry)
        with pytest.raises(OptionError, match="must be 1 to 64 letters, digits, '_' and '-'"):
            sme_registry.register(SMESpec(seed=105), name)
        assert len(gymnasium.registry) == count

    def test_what_is_no_spec_is_refused(self):
        with pytest.raises(SpecError, match="k=0: must be"):
            sme_registry.register({"k": 0}, "ApiBad")
        with pytest.raises(SpecError, match="must be an SMESpec or a mapping"):
            sme_registry.register("Default", "ApiBad")
        assert "SME/ApiBad-v1" not in gymnasium.registry
