"""Lives in streams whose faults are known, and the folders that training leaves of them."""

import numpy as np

from sme_registry import SMESpec, StreamSpec
from sme_registry.diagnosis import StreamSubject, diagnose
from sme_registry.evaluation import dynamic_regret, evaluate_stream
from sme_registry.evaluation.evaluate import resolve_protocol
from sme_registry.evaluation.models import saved_sb3
from sme_registry.evaluation.networks import Perceptron
from sme_registry.evaluation.references import reference_policy
from sme_registry.io import write_atomically
from sme_registry.training.models import new_sb3_model
from sme_registry.training.record import SNAPSHOTS, RunRecord, Snapshots

SPEC = SMESpec(state_dim=3, action_dim=2, hidden_width=8, horizon=10, complexity=2)
PROTOCOL = {"states_per_region": 64, "epsilons": [0.5]}
STEPS = 100  # of each phase


def stream_of(phases, cycles=1, **fields):
    """Unrelated tasks of equal difficulty."""
    specs = [{"spec": SPEC.derive(seed=seed), "steps": STEPS} for seed in range(phases)]
    return StreamSpec(phases=specs, cycles=cycles, **fields)


def optima(stream):
    """π* of each phase."""
    return [reference_policy("optimal", phase.spec) for phase in stream.phases]


def report_of(policies, stream, regret=None, fresh_regret=None, **options):
    """The report of a life, whose visits have these online regrets."""
    options = {"protocol": PROTOCOL, "initial": "random", "name": "agent", **options}
    report = evaluate_stream(policies, stream, **options)
    if regret is None:
        return report
    step = STEPS * np.arange(1, len(regret) + 1)
    log = dynamic_regret(stream, step, np.array(regret), STEPS)
    if fresh_regret is not None:
        log = log.with_fresh(stream, fresh_regret)
    return report.with_dynamic_regret(log)


def diagnosis_of(report, networks=None, **options):
    subject = StreamSubject("life", report, {"algorithm": "PPO"}, networks, **options)
    return diagnose(subject, states=128)


def network(dead=0, stuck=0, scale=1.0, same=False):
    """20 units of ReLU, some dead, and 20 of tanh, some stuck at a bound or all the same."""
    generator = np.random.default_rng(0)
    W = [generator.normal(size=shape) * scale for shape in ((5, 20), (20, 20), (20, 2))]
    W[0] = np.abs(W[0])  # units of ReLU that are on
    W[1] *= 0.05
    if same:
        W[1] = np.repeat(W[1][:, :1], 20, axis=1)
    b = np.where(np.arange(20) < dead, -1e3, 0.0), np.where(np.arange(20) < stuck, 1e3, 0.0)
    return Perceptron([(W[0], b[0], "relu"), (W[1], b[1], "tanh"), (W[2], np.zeros(2), "identity")])


def model_of(uses, document, seed=0):
    """An untrained model of Stable-Baselines3."""
    settings = {"policy_kwargs": {"net_arch": [12, 8]}}
    return new_sb3_model(
        uses, document, seed=seed, action_range="symmetric", hyperparameters=settings, steps=STEPS
    )


def write_run(folder, stream, uses):
    """A finished run of `sme train` whose models did not learn; returns these, by visit."""
    visits = stream.cycles * len(stream.phases)
    models = [model_of(uses, stream, seed) for seed in range(visits + 1)]
    kept = Snapshots(folder / SNAPSHOTS, stream)
    write_atomically(kept.initial, saved_sb3(models[visits]))
    for visit in range(visits):
        write_atomically(kept.visits[visit], saved_sb3(models[visit]))
    report = report_of(
        models[:visits], stream, [0.5] * visits, initial=models[visits], action_range="symmetric"
    )
    report.write(folder / "stream.json")
    protocol = resolve_protocol(PROTOCOL)
    RunRecord(
        status="finished",
        spec=stream.phases[0].spec,
        spec_digest=stream.phases[0].spec.digest,
        stream=stream,
        stream_digest=stream.digest,
        task="Mine",
        algorithm=uses.removeprefix("jax:"),
        seed=0,
        action_range="symmetric",
        num_envs=1,
        steps=stream.steps,
        steps_done=stream.steps,
        checkpoint_every=1000,
        protocol=protocol,
        protocol_digest=protocol.digest,
        versions={},
    ).write(folder)
    return models
