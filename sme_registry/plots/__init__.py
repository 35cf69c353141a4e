"""Figures: training, decay outside the cube, maps of the plane, safety, distraction, streams.

Each function returns a Matplotlib `Figure`. Given a `path`, it writes that file, PNG, PDF or SVG by
its ending. Given `ax`, one panel or several, it draws in the caller's axes, without title and
legend. `title` is above a new figure; None takes one from the data.
"""

from sme_registry.plots.curves import (
    cost_curve,
    dynamic_regret_curve,
    learning_curve,
    performance_curve,
    plasticity_curve,
    training_curve,
)
from sme_registry.plots.maps import retention_map, similarity_map
from sme_registry.plots.reports import (
    decay_curve,
    layer_probes,
    reward_against_cost,
    sensitivity_bars,
)
from sme_registry.plots.style import save_figure

__all__ = [
    "cost_curve",
    "decay_curve",
    "dynamic_regret_curve",
    "layer_probes",
    "learning_curve",
    "performance_curve",
    "plasticity_curve",
    "retention_map",
    "reward_against_cost",
    "save_figure",
    "sensitivity_bars",
    "similarity_map",
    "training_curve",
]
