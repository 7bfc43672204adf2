import dataclasses

import pytest

pytest.importorskip("sb3_contrib")
pytest.importorskip("tyro")

from agents.training.recipes import (
    RECIPES,
    PlackettLuceRecipe,
    RegressionRounds,
    ScoresRecipe,
    SwapRounds,
)
from agents.training.worlds import World
from dptse_env.config import EnvConfig
from dptse_env.spaces.actions import ACTION_ENCODINGS
from dptse_env.traffic import CORRIDORS


@pytest.mark.parametrize("recipe", RECIPES.values())
def test_recipes_are_sound(recipe):
    assert recipe.action in ACTION_ENCODINGS
    assert recipe().n_envs % recipe().replicas == 0
    recipe().check_steps(recipe.default_steps)


@pytest.mark.parametrize("name", ["maskable", "scores", "mask"])
def test_minibatches_divide_an_update(name):
    recipe = RECIPES[name]()
    assert recipe.steps_per_update % recipe.batch_size == 0


def test_the_learning_rate_falls_to_its_end():
    schedule = ScoresRecipe(learning_rate=3e-3, final_learning_rate=1e-3).schedule()
    assert [schedule(left) for left in (1.0, 0.5, 0.0)] == pytest.approx([3e-3, 2e-3, 1e-3])


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("n_envs", 0, r"recipe\.n_envs must be an integer >= 1, got 0"),
        ("n_epochs", 1.5, r"recipe\.n_epochs must be an integer"),
        ("gamma", 1.0, r"recipe\.gamma must be a number in \(0, 1\), got 1\.0"),
        ("learning_rate", 0.0, r"recipe\.learning_rate must be a finite number > 0"),
        ("ent_coef", -0.1, r"recipe\.ent_coef must be a finite number >= 0"),
        ("replicas", 3, r"recipe\.n_envs must be a multiple of replicas 3, got 128"),
    ],
)
def test_bad_values_are_named(name, value, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(ScoresRecipe(), **{name: value})


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("rounds", -1, r"recipe\.swaps\.rounds must be an integer in 0\.\.99, got -1"),
        ("episodes", 10_000, r"recipe\.swaps\.episodes must be an integer in 1\.\.9999"),
        ("trials", 0, r"recipe\.swaps\.trials must be an integer >= 1"),
        ("step", 0.0, r"recipe\.swaps\.step must be a finite number > 0"),
        ("final_step", -1.0, r"recipe\.swaps\.final_step must be a finite number > 0"),
        ("price", -0.1, r"recipe\.swaps\.price must be a finite number >= 0"),
    ],
)
def test_bad_values_of_swap_rounds_are_named(name, value, message):
    with pytest.raises(ValueError, match=message):
        SwapRounds(**{name: value})


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("rounds", -1, r"recipe\.regression\.rounds must be an integer >= 0, got -1"),
        ("interval", 0, r"recipe\.regression\.interval must be an integer >= 1"),
        ("rate", 0.0, r"recipe\.regression\.rate must be a finite number > 0"),
        ("age_bonus", -0.1, r"recipe\.regression\.age_bonus must be a finite number >= 0"),
    ],
)
def test_bad_values_of_regression_rounds_are_named(name, value, message):
    with pytest.raises(ValueError, match=message):
        RegressionRounds(**{name: value})


def test_a_recipe_without_any_round_is_refused():
    with pytest.raises(ValueError, match=r"recipe\.swaps\.rounds must be an integer in 1\.\.99"):
        PlackettLuceRecipe(regression=RegressionRounds(rounds=0), swaps=SwapRounds(rounds=0))


def test_seconds_of_a_round_include_those_of_its_forks():
    # The episodes themselves, and one unswapped and three swapped forks under either noise.
    world = World("x", {}, EnvConfig(CORRIDORS["paper-highway"]))
    assert SwapRounds(episodes=10, trials=3).steps(world) == 10 * 700 * 9
    longer = dataclasses.replace(world, share=0.3)
    assert SwapRounds(episodes=10, trials=3).steps(longer) == 3 * 700 * 9
