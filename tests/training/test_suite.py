import pytest

from sme_registry.cli.train_suite import equal_runs
from sme_registry.spec import Suite


@pytest.mark.parametrize(("seeds", "runs"), [([1], 10), ([1, 2, 3], 12), (list(range(15)), 15)])
def test_by_default_all_instances_of_a_class_have_equally_many_runs(seeds, runs):
    suite = Suite.from_dict({"classes": [{"name": "one", "setting": {"k": 2}, "seeds": seeds}]})
    assert equal_runs(suite) == runs
