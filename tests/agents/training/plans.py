"""Trainings of a few seconds, and what ends them."""

import contextlib
import json

from agents.training.plan import TrainingPlan
from agents.training.run_files import TrainingFolder
from agents.training.settings import PlackettLuceSettings, parse_algorithm
from tests.helpers import SHORT

ENV = f'{SHORT} {{"horizon": 80, "privacy": "capped"}}'
ONE = f'{SHORT} {{"horizon": 80, "privacy": "capped", "bandwidth": 1}}'
WIDE = f'{SHORT} {{"horizon": 80, "privacy": "capped", "bandwidth": 3}}'
OTHER = 'dptse_env:dptse/PrivateHighway-v1 {"horizon": 80, "privacy": "capped", "bandwidth": 3}'
"""A road of 15 segments beside one of 6; both have the same kinds of channels."""

# Steps and rates are large, so that every round acts otherwise than the one before.
SMALL = {
    "plackett-luce": {
        "n_envs": 4, "replicas": 2, "width": 8,
        "regression": {"rounds": 1, "seconds": 9, "batches": 3},
        "swaps": {
            "rounds": 2, "episodes": 3, "seconds": 5, "trials": 2, "batches": 20,
            "batch_size": 16, "rate": 0.05,
        },
    },
    "ppo": {
        "n_envs": 4, "replicas": 2, "n_steps": 10, "batch_size": 20, "n_epochs": 2, "hidden": [8],
        "validations": 3,
    },
    "dqn": {
        "n_envs": 4, "replicas": 2, "train_freq": 10, "batch_size": 20, "buffer_size": 400,
        "learning_starts": 20, "hidden": [8], "validations": 3,
    },
}  # fmt: skip
SMALL["maskable-ppo"] = SMALL["ppo"]
SMALL["recurrent-ppo"] = {**SMALL["ppo"], "lstm": 8}
SMALL["qr-dqn"] = {**SMALL["dqn"], "quantiles": 5}
STEPS = 240
"""Seconds of traffic of a small training but for plackett-luce: six updates."""


def make_algorithm(name="plackett-luce", **changes):
    return parse_algorithm(f"{name} {json.dumps({**SMALL[name], **changes})}", 6)


def make_plan(algorithm="plackett-luce", **changes):
    """A plan with an algorithm, or the small settings of one by its name."""
    algorithm = make_algorithm(algorithm) if isinstance(algorithm, str) else algorithm
    values = {
        "envs": (ONE if "dqn" in algorithm.name else ENV,),
        "algorithm": algorithm,
        "seed": 1,
        "traffic_seeds": (0, 1, 2),
        "validation_seeds": (1000, 1001),
        "steps": None if isinstance(algorithm, PlackettLuceSettings) else STEPS,
    }
    return TrainingPlan(**{**values, **changes})


def without_time(rows):
    return [{k: v for k, v in row.items() if k != "seconds"} for row in rows]


class StopError(Exception):
    pass


@contextlib.contextmanager
def ended_at(update, how):
    """Call a function as a row of a curve comes, ahead of its checkpoint."""
    append = TrainingFolder.append

    def appended(training, row):
        append(training, row)
        if row["update"] == update:
            how()

    TrainingFolder.append = appended
    try:
        yield
    finally:
        TrainingFolder.append = append


def stop():
    raise StopError
