import dataclasses
import json

import numpy as np
import pytest

from agents.environments import make_config, parse_env
from agents.filters.roads import ROADS
from agents.filters.scenarios import MECHANISMS, SCHEDULES, ScenarioRanges

from .plans import RANGES


def drawn(ranges=RANGES, n=60, seed=0):
    rng = np.random.default_rng(seed)
    return [ranges.draw(rng, range(20), 4) for _ in range(n)]


def test_scenarios_cover_their_ranges():
    scenarios = drawn(n=200)
    privacy = [each.keywords["privacy"] for each in scenarios]
    assert {each["preset"] for each in privacy} == set(MECHANISMS)
    assert {each.schedule for each in scenarios} == set(SCHEDULES)
    epsilons = [each["epsilon"] for each in privacy]
    assert min(epsilons) < 0.7
    assert max(epsilons) > 14.0
    assert 0.3 < np.mean(np.array(epsilons) < np.sqrt(0.5 * 20.0)) < 0.7  # even in the logarithm
    assert {each.keywords["bandwidth"] for each in scenarios} == set(range(1, 7))
    assert any("query_spans" in each.keywords for each in scenarios)
    for each in scenarios:
        assert len(set(each.traffic_seeds)) == 4
        assert set(each.traffic_seeds) <= set(range(20))


@pytest.mark.parametrize("scenario", drawn(n=12), ids=str)
def test_every_scenario_is_an_environment(scenario):
    config = make_config(scenario.env, scenario.keywords)
    assert config.privacy.preset == scenario.keywords["privacy"]["preset"]


def test_the_same_generator_draws_the_same_scenarios():
    assert drawn(n=5) == drawn(n=5) != drawn(n=5, seed=1)


def test_bandwidths_can_be_held_to_a_share_of_the_road():
    few = dataclasses.replace(RANGES, largest_share=0.35)
    assert {scenario.keywords["bandwidth"] for scenario in drawn(few)} == {1, 2}
    for share in (0.0, 1.1):
        with pytest.raises(ValueError, match=r"ranges\.largest_share must be in \(0, 1\], got"):
            dataclasses.replace(RANGES, largest_share=share)


def test_mechanisms_can_be_left_out():
    scenarios = drawn(ScenarioRanges(envs=RANGES.envs, mechanisms=("capped",)), n=5)
    assert {each.keywords["privacy"]["preset"] for each in scenarios} == {"capped"}


def test_environments_are_ids_with_keywords():
    assert parse_env("dptse_env:dptse/LongHighway-v0") == ("dptse_env:dptse/LongHighway-v0", {})
    keywords = {"bandwidth": 3}
    given = f"dptse_env:dptse/LongHighway-v0 {json.dumps(keywords)}"
    assert parse_env(given) == ("dptse_env:dptse/LongHighway-v0", keywords)
    for text in ("[3]", "{"):
        with pytest.raises(ValueError, match=r"^env must be an id and a JSON object, got"):
            parse_env(f"dptse_env:dptse/LongHighway-v0 {text}")


@pytest.mark.filterwarnings("ignore:.*values measured or tuned on")
@pytest.mark.parametrize("env", ROADS)
def test_every_road_of_a_training_is_an_environment(env):
    """With scenarios of its own; none has the incident or the demand of another."""
    ranges = dataclasses.replace(RANGES, envs=(env,))
    for scenario in drawn(ranges, n=4):
        config = make_config(scenario.env, scenario.keywords)
        assert config.bandwidth <= config.corridor.n_mainline
    digests = {make_config(*parse_env(each)).corridor.digest for each in ROADS}
    assert len(digests) == len(ROADS)
