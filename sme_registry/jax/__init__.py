"""SMEs and agents on the accelerator: environment, learner and evaluation in one XLA program.

    params = task_params("SME/Default-v1")
    observation, state = reset(key, params)
    observation, state, reward, done, info = step(key, state, action, params)   # gymnax's signature

Every module below imports JAX, which nothing outside this folder does. Importing the package turns
64-bit numbers on for the whole process: states are float64, as METHOD, section 1 defines them.

    device      the process's JAX: float64, precision, devices, compile cache
    task        a drawn task as a pytree; several of one group, padded to equal shapes
    pairs       float64 numbers as pairs of uint32, for devices without float64
    transition  next states, exact: in float64 or in pairs
    oracle      the optimal action, similarity, step reward and cost
    observing   distractors, and what the agent sees in place of the state
    env         reset and step of one environment; vmap them
    gymnax      the same as a class with gymnax's methods
    networks    perceptrons whose weights have Stable-Baselines3's names; Adam and clipping as Torch
    ppo td3 sac the algorithms: hyperparameters, updates, and a `Program` of many lanes
    off_policy  what TD3 and SAC share: when they act and update
    replay      their buffer
    critics     their twin critics and targets
    ranges      of hyperparameters, as types
    lives       which tasks the lanes of a program are on: one, or a stream's
    padding     weights of a lane in networks of wider observations and actions
    program     what all programs have: lanes, evaluation, saving, lanes that failed
    run         a program from its start to its end, evaluated where a study's cell is
"""

from sme_registry.jax import device as _device

_device.prepare()
