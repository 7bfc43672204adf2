"""Trainings of a few seconds, and a watcher that stops them."""

from agents.training.plan import TrainingPlan
from agents.training.recipes import RECIPES, PlackettLuceRecipe, RegressionRounds, SwapRounds

SMALL = {"n_envs": 4, "replicas": 2}
SMALL_PPO = {**SMALL, "n_steps": 10, "batch_size": 20, "n_epochs": 2, "hidden": (8,)}
REGRESSION = RegressionRounds(rounds=1, seconds=9, batches=3)
# Steps and rates are large, so that every round acts otherwise than the one before.
FEW_SWAPS = SwapRounds(
    rounds=2, episodes=3, seconds=5, trials=2, batches=20, batch_size=16, rate=0.05
)


def make_recipe(learner):
    if learner == "plackett-luce":
        return PlackettLuceRecipe(**SMALL, regression=REGRESSION, swaps=FEW_SWAPS, width=8)
    return RECIPES[learner](**SMALL_PPO)


def make_plan(learner="plackett-luce", **changes):
    values = {
        "env": "dptse_env:dptse/ShortHighway-v0",
        "recipe": make_recipe(learner),
        "seed": 1,
        "steps": 0 if learner == "plackett-luce" else 240,
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
