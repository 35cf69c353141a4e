"""Policies: every form in which a user may give one, as one checked function of observations.

callable · model of Stable-Baselines3, sb3-contrib or sbx, or its .zip · .onnx file · .npz file of
an offline policy · `module:function` · name of a reference policy · for teams also a dict by agent.
"""

from sme_registry.evaluation.policies.forms import as_policy, interface_of
from sme_registry.evaluation.policies.npz import OfflinePolicy
from sme_registry.evaluation.policies.perceptron import Perceptron
from sme_registry.evaluation.policies.policy import Member, Policy, TeamPolicy
from sme_registry.evaluation.policies.sb3_files import load_sb3, saved_sb3

__all__ = [
    "Member",
    "OfflinePolicy",
    "Perceptron",
    "Policy",
    "TeamPolicy",
    "as_policy",
    "interface_of",
    "load_sb3",
    "saved_sb3",
]
