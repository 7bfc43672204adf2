"""Trainings of a few seconds, and what stops them."""

from agents.training.plan import TrainingPlan
from agents.training.recipes import RECIPES, SwapRounds

SMALL = {"n_envs": 4, "twins": 2, "n_steps": 10, "batch_size": 20, "n_epochs": 2}
PRETRAINING = {"pretraining_rounds": 1, "pretraining_seconds": 9, "pretraining_batches": 3}
NO_SWAPS = SwapRounds(rounds=0)


def make_plan(learner="plackett-luce", steps=240, **changes):
    extra = (
        {**PRETRAINING, "swaps": NO_SWAPS, "width": 8}
        if learner == "plackett-luce"
        else {"hidden": (8,)}
    )
    values = {
        "env": "dptse_env:dptse/ShortHighway-v0",
        "recipe": RECIPES[learner](**{**SMALL, **extra}),
        "seed": 1,
        "steps": steps,
        "traffic_seeds": (0, 1, 2),
        "validation_seeds": (1000, 1001),
        "keywords": {"horizon": 80, "privacy": "capped"},
        "validate_every": 3,
        "checkpoint_every": 2,
    }
    return TrainingPlan(**{**values, **changes})


def without_time(rows):
    return [{k: v for k, v in row.items() if k != "seconds"} for row in rows]


class StopError(Exception):
    pass


def stop_at(update):
    def watcher(row):
        if row["update"] == update:
            raise StopError

    return watcher
