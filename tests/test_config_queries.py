"""The keywords of queries: query_spans, price_levels and bandwidth_unit."""

import dataclasses
import json

import gymnasium as gym
import pytest

from dptse_env.config import resolve
from dptse_env.release import MOST_OPTIONS

from .release.sums import MeanRelease, SumRelease

SUMS = "tests.release.sums:SumRelease"
KEYWORDS = {"privacy": SUMS, "query_spans": [1, 2, 4], "price_levels": [0.5, 1, 2]}


def test_a_configuration_with_spans_survives_json_and_a_spec():
    config = resolve("short-highway", {**KEYWORDS, "bandwidth_unit": "sums"})
    assert config.query_spans == (1, 2, 4)
    assert config.price_levels == (0.5, 1.0, 2.0)
    plain = json.loads(json.dumps(dataclasses.asdict(config)))
    plain["privacy"]["preset"] = SUMS
    assert resolve("paper-highway", plain) == config
    env = gym.make("dptse_env:dptse/ShortHighway-v0", **KEYWORDS)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.config == env.unwrapped.config
    assert again.action_space == env.action_space


BAD = [
    ({"query_spans": []}, "query_spans must be ascending"),
    ({"query_spans": [2, 1]}, "query_spans must be ascending"),
    ({"query_spans": [1, 1]}, "query_spans must be ascending"),
    ({"query_spans": [1, 7]}, "query_spans must be ascending"),
    ({"query_spans": [0, 1]}, r"query_spans\[0\] must be"),
    ({"query_spans": [1.5]}, r"query_spans\[0\] must be"),
    ({"query_spans": 2}, "query_spans must be"),
    ({"price_levels": []}, "price_levels must be"),
    ({"price_levels": [1, 2, 1.0]}, "price_levels must be"),
    ({"price_levels": [0.01]}, r"price_levels\[0\] must be"),
    ({"price_levels": [1, 21]}, r"price_levels\[1\] must be"),
    ({"bandwidth_unit": "queries"}, "bandwidth_unit must be"),
    ({"query_spans": [3, 4]}, r"bandwidth must be in 3\.\.6"),
    ({"bandwidth": 7}, r"bandwidth must be in 1\.\.6"),
]


def test_bad_queries_are_named():
    for keywords, message in BAD:
        with pytest.raises(ValueError, match=f"^{message}"):
            resolve("short-highway", {"privacy": SumRelease, **keywords})


@pytest.mark.parametrize("key", ["query_spans", "price_levels"])
@pytest.mark.parametrize("preset", ["paper", "corrected", "capped"])
def test_release_models_of_single_segments_refuse_others(key, preset):
    message = rf"^{key} must be \(1,\) with the release model '{preset}', which releases no sums"
    with pytest.raises(ValueError, match=message):
        resolve("short-highway", {"privacy": preset, key: [1, 2]})
    assert resolve("short-highway", {"privacy": preset, key: [1]}).queries.are_plain


def test_mean_speeds_have_no_sums():
    keywords = {"privacy": MeanRelease, "query_spans": (1, 2)}
    with pytest.raises(ValueError, match=r"^query_spans must be \(1,\) where mean speeds are rel"):
        resolve("short-highway", keywords)
    levels = {"privacy": MeanRelease, "price_levels": (1.0, 2.0)}
    assert resolve("short-highway", levels).queries.n_options == 12


def test_too_many_options_are_refused():
    road = {"n_mainline": 200, "on_ramps": [], "off_ramps": [], "exit_shares": []}
    keywords = {
        "corridor": {**road, "demand": {"mainline": [[0, 1000]], "on_ramps": []}},
        "privacy": SumRelease, "incident": "none", "query_spans": list(range(1, 101)),
    }  # fmt: skip
    message = rf"^query_spans and price_levels must leave at most {MOST_OPTIONS} .*, got 15050$"
    with pytest.raises(ValueError, match=message):
        resolve("short-highway", keywords)
