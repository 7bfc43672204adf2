"""Parts of a round of swaps, each with draws of its own, so that workers can share a round."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from agents.environments import make_vector
from agents.executors import AnyExecutor, run_in_order
from agents.play import record
from agents.training.policy_iteration import collect_swaps, first_seed
from agents.training.recipes import PlackettLuceRecipe
from agents.training.swaps import Swaps
from agents.training.worlds import World
from dptse_env.sb3 import PlackettLucePolicy


@dataclass(frozen=True)
class SwapPart:
    """Some episodes of a round in a world, with everything that a worker needs to play them.

    Attributes:
        keywords: Keywords of the environment beside those of the world.
        weights: Weights of the policy.
        seed: Training seed.
        index: Number of the round, counted from 0.
        episodes: Numbers of the episodes in the round.
    """

    world: World
    recipe: PlackettLuceRecipe
    keywords: Mapping[str, Any]
    weights: Mapping[str, Any]
    seed: int
    index: int
    episodes: range


def collect_part(part: SwapPart) -> Swaps:
    """Try the swaps of a part; its draws do not depend on the other parts."""
    env = make_vector(part.world.env, len(part.episodes), dict(part.keywords))
    record(env.config.corridor, env.config.traffic_seeds, part.keywords.get("records"))
    with torch.random.fork_rng(devices=[]):
        policy = untrained(part.world, part.recipe)
        policy.load_state_dict(part.weights)
        torch.manual_seed(first_seed(part.seed, part.index) + part.episodes.start)
        return collect_swaps(
            policy, env, part.recipe.swaps, part.index, part.seed, first=part.episodes.start
        )


def collect_parts(
    worlds: Sequence[World],
    policies: Sequence[PlackettLucePolicy],
    recipe: PlackettLuceRecipe,
    keywords: Mapping[str, Any],
    *,
    seed: int,
    index: int,
    executor: AnyExecutor,
    progress: Callable[[float], None],
) -> list[Swaps]:
    """Return the swaps of a round in each of the worlds, tried in parts on an executor.

    Args:
        worlds: The worlds.
        policies: The policy of each of them.
        recipe: Its settings of swaps say how many parts there are.
        keywords: Further keywords of all environments.
        seed: Training seed.
        index: Number of the round, counted from 0.
        executor: Runs the parts.
        progress: Called with the fraction of the parts that are done.
    """
    parts = [
        SwapPart(
            world,
            recipe,
            {**world.keywords, **keywords, "action": recipe.action},
            policy.state_dict(),
            seed,
            index,
            episodes,
        )
        for world, policy in zip(worlds, policies, strict=True)
        for episodes in split(world.part(recipe.swaps.episodes), recipe.swaps.parts)
    ]
    tried = run_in_order(executor, collect_part, parts, progress, progress=False)
    return [
        Swaps.from_parts(
            [swaps for part, swaps in zip(parts, tried, strict=True) if part.world is world]
        )
        for world in worlds
    ]


def split(count: int, parts: int) -> list[range]:
    """Return the numbers below ``count`` in at most ``parts`` ranges of nearly equal length."""
    n = min(parts, count)
    edges = [count * k // n for k in range(n + 1)]
    return [range(*pair) for pair in itertools.pairwise(edges)]


def untrained(world: World, recipe: PlackettLuceRecipe) -> PlackettLucePolicy:
    """Return a policy for a world with the initial weights that torch draws."""
    return PlackettLucePolicy.from_config(world.config, width=recipe.width, rule=recipe.rule)
