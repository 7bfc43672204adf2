import dataclasses

import pytest

pytest.importorskip("sb3_contrib")
pytest.importorskip("yaml")

import yaml

from agents.training.recipes import RECIPES, PlackettLuceRecipe, SwapRounds
from agents.training.yaml import ENV, FOLDER, to_yaml
from dptse_env.config import PRESETS
from dptse_env.spaces.actions import ACTION_ENCODINGS


@pytest.mark.parametrize("name", RECIPES)
def test_the_yaml_beside_is_the_recipe(name):
    recipe = RECIPES[name]()
    text = (FOLDER / f"{name}.yml").read_text()
    assert text == to_yaml(recipe), "run python -m agents.training.yaml"
    values = yaml.safe_load(text)[ENV]
    for key in ("n_envs", "n_steps", "batch_size", "n_epochs", "target_kl", "clip_range"):
        assert values[key] == getattr(recipe, key)
    assert values["gamma"] ** recipe.picks == pytest.approx(recipe.gamma, abs=1e-5)
    keywords = eval(values["policy_kwargs"])
    assert keywords.pop("road", "private-highway") == "private-highway"
    assert keywords == recipe.policy_keywords()


def test_there_is_no_other_yaml():
    assert {path.stem for path in FOLDER.glob("*.yml")} == set(RECIPES)


@pytest.mark.parametrize("recipe", RECIPES.values())
def test_recipes_are_sound(recipe):
    assert recipe.action in ACTION_ENCODINGS
    assert recipe().n_envs % recipe().twins == 0
    assert recipe().steps_per_update % recipe().batch_size == 0
    encoding = ACTION_ENCODINGS[recipe.action](15, PRESETS["private-highway"].bandwidth)
    assert recipe.picks == encoding.actions_per_step


def test_the_learning_rate_falls_to_its_end():
    schedule = PlackettLuceRecipe(learning_rate=3e-3, final_learning_rate=1e-3).schedule()
    assert [schedule(left) for left in (1.0, 0.5, 0.0)] == pytest.approx([3e-3, 2e-3, 1e-3])


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("n_envs", 0, r"recipe\.n_envs must be an integer >= 1, got 0"),
        ("n_epochs", 1.5, r"recipe\.n_epochs must be an integer"),
        ("gamma", 1.0, r"recipe\.gamma must be in \(0, 1\), got 1\.0"),
        ("learning_rate", 0.0, r"recipe\.learning_rate must be > 0"),
        ("ent_coef", -0.1, r"recipe\.ent_coef must be >= 0"),
        ("twins", 3, r"recipe\.n_envs must be a multiple of twins 3, got 128"),
    ],
)
def test_bad_values_are_named(name, value, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(PlackettLuceRecipe(), **{name: value})


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("rounds", -1, r"recipe\.swaps\.rounds must be an integer in 0\.\.99, got -1"),
        ("episodes", 10_000, r"recipe\.swaps\.episodes must be an integer in 1\.\.9999"),
        ("trials", 0, r"recipe\.swaps\.trials must be an integer >= 1"),
        ("step", 0.0, r"recipe\.swaps\.step must be > 0"),
        ("final_step", -1.0, r"recipe\.swaps\.final_step must be > 0"),
        ("price", -0.1, r"recipe\.swaps\.price must be >= 0"),
    ],
)
def test_bad_values_of_swap_rounds_are_named(name, value, message):
    with pytest.raises(ValueError, match=message):
        SwapRounds(**{name: value})


def test_a_rounds_seconds_are_those_of_all_twins():
    # The episodes themselves, and one unswapped and three swapped twins under either noise.
    assert SwapRounds(episodes=10, trials=3).steps(700) == 10 * 700 * 9
    assert RECIPES["mask"]().rounds.rounds == 0
