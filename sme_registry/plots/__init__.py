"""Figures: regret during training, decay outside the training cube, similarity over the plane.

Each function returns a Matplotlib `Figure`. It writes a file where it gets a `path`, PNG, PDF or
SVG by its ending, and draws in the caller's axes where it gets `ax`. `save_figure` writes any
figure.
"""

from sme_registry.plots.curves import learning_curve, training_curve
from sme_registry.plots.decay import decay_curve
from sme_registry.plots.maps import similarity_map
from sme_registry.plots.style import save_figure

__all__ = ["decay_curve", "learning_curve", "save_figure", "similarity_map", "training_curve"]
