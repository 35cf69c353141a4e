"""Small data sets for these tests, without files."""

from sme_registry import SMESpec, materialize
from sme_registry.datasets import DatasetRecipe
from sme_registry.datasets.collect import collect
from sme_registry.datasets.documents import parse_behaviour

TINY = SMESpec(state_dim=2, action_dim=2, horizon=20, seed=5)


def transitions_of(spec=TINY, nu=0.5, count=600):
    recipe = DatasetRecipe(spec=spec, behaviours=(parse_behaviour(nu),), transitions=count, seed=3)
    return collect(recipe, materialize(spec))
