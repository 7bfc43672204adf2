"""Recipes as YAML of rl-zoo3; `recipes/*.yml` are written by ``python -m agents.training.yaml``."""

from __future__ import annotations

from pathlib import Path

from agents.training.recipes import RECIPES, PlackettLuceRecipe, Recipe

FOLDER = Path(__file__).parent / "recipes"
ENV = "dptse/PrivateHighway-v0"
STEPS = 2_000_000
_PRESET = "private-highway"


def to_yaml(recipe: Recipe) -> str:
    """Return a recipe as rl-zoo3 reads hyperparameters.

    What rl-zoo3 has no word for stands in comments: the action encoding, the scale of rewards, and
    the comparison of twins, which it does not do.
    """
    root = 1.0 / recipe.picks
    policy, keywords = "MlpPolicy", dict(recipe.policy_keywords())
    if isinstance(recipe, PlackettLuceRecipe):
        policy, keywords = "dptse_env.sb3.PlackettLucePolicy", {"road": _PRESET, **keywords}
    inside = ", ".join(f"{name}={value!r}" for name, value in keywords.items())
    first, last = recipe.learning_rate, recipe.final_learning_rate
    values = {
        "n_envs": recipe.n_envs,
        "n_timesteps": STEPS,
        "policy": policy,
        "n_steps": recipe.n_steps,
        "batch_size": recipe.batch_size,
        "n_epochs": recipe.n_epochs,
        "learning_rate": f"lin_{first:g}",
        "gamma": round(recipe.gamma**root, 6),
        "gae_lambda": round(recipe.gae_lambda**root, 6),
        "clip_range": recipe.clip_range,
        "target_kl": recipe.target_kl,
        "ent_coef": recipe.ent_coef,
        "vf_coef": recipe.vf_coef,
        "max_grad_norm": recipe.max_grad_norm,
        "policy_kwargs": f'"dict({inside})"',
    }
    lines = [
        f"# {recipe.learner}: algorithm {recipe.algorithm}, "
        f"""--env-kwargs "action:'{recipe.action}'".""",
        f"# scripts/train.py also multiplies rewards by {recipe.reward_scale:g}, lets the learning "
        f"rate fall to {last:g},",
        f"# and compares {recipe.twins} episodes of equal traffic and noise with one another.",
        f"{ENV}:",
        *(f"  {name}: {value}" for name, value in values.items()),
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write every recipe."""
    FOLDER.mkdir(exist_ok=True)
    for name, recipe in RECIPES.items():
        (FOLDER / f"{name}.yml").write_text(to_yaml(recipe()), encoding="utf-8")


if __name__ == "__main__":
    main()
