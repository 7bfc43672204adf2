"""Settings of algorithms, plans, and what is refused of either before anything runs."""

import json

import pytest

pytest.importorskip("sb3_contrib")

from agents.training.plan import fitting
from agents.training.settings import ALGORITHMS, parse_algorithm
from dptse_env.config import resolve
from tests.agents.training.plans import ENV, ONE, OTHER, make_algorithm, make_plan
from tests.helpers import SHORT, SumRelease


@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.parametrize("n_segments", [6, 120])
def test_tuned_settings_fill_an_update(name, n_segments):
    algorithm = parse_algorithm(name, n_segments)
    make_plan(algorithm=algorithm, envs=(ONE,)).check()
    if "ppo" in name:
        assert algorithm.n_envs * algorithm.n_steps % algorithm.batch_size == 0
        assert algorithm.n_envs == (128 if n_segments == 6 else 64)


def test_settings_that_are_given_replace_single_ones():
    given = parse_algorithm(
        'plackett-luce {"swaps": {"step": 9.0, "final_step": 1, "rounds": 5}}', 6
    )
    assert (given.swaps.step, given.swaps.final_step, given.swaps.trials) == (9.0, 1.0, 3)
    assert given.regression == parse_algorithm("plackett-luce", 6).regression
    road, mlp = parse_algorithm("ppo", 6), parse_algorithm('ppo {"policy": "mlp"}', 6)
    assert (road.policy, road.learning_rate, road.gamma) == ("road", 1e-3, 0.95)
    assert (mlp.policy, mlp.learning_rate, mlp.gamma) == ("mlp", 5e-4, 0.9)
    assert parse_algorithm('ppo {"ent_coef": 0.5}', 6).ent_coef == 0.5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a2c", "algorithm must be one of .*'a2c'"),
        ("ppo {", "algorithm must be JSON"),
        ('ppo {"gama": 0.9}', "algorithm.gama is unknown"),
        ('dqn {"gamma": 1.0}', r"algorithm.gamma must be .*1.0"),
        ('ppo {"replicas": 3}', "algorithm.n_envs must be .*128"),
        ('recurrent-ppo {"policy": "road"}', "algorithm.policy must be mlp, got 'road'"),
        (
            'plackett-luce {"swaps": {"rounds": 0}, "regression": {"rounds": 0}}',
            "algorithm.swaps.rounds must be .*0",
        ),
    ],
)
def test_bad_settings_are_named(text, message):
    with pytest.raises(ValueError, match=message):
        parse_algorithm(text, 6)


PAIRS = {"bandwidth": 2, "query_spans": [1, 2], "privacy": "paced"}


@pytest.mark.parametrize(
    ("keywords", "expected"),
    [
        ({"bandwidth": 1}, [*list(ALGORITHMS)[:1], 'ppo {"policy": "mlp"}', *list(ALGORITHMS)[1:]]),
        (
            {"bandwidth": 2},
            ["ppo", 'ppo {"policy": "mlp"}', "maskable-ppo", "recurrent-ppo", "plackett-luce"],
        ),
        (PAIRS, ['ppo {"policy": "mlp"}', "maskable-ppo", "recurrent-ppo"]),
    ],
)
def test_algorithms_that_fit_a_space_of_actions(keywords, expected):
    assert fitting(resolve("short-plain", keywords)) == expected


def env(**keywords):
    return (f"{SHORT} {json.dumps({'horizon': 80, **keywords})}",)


FEW = make_algorithm(swaps={"seconds": 24, "rounds": 1})
SECURE = env(privacy={"noise": "secure"})
SUMS = f"{SumRelease.__module__}:SumRelease"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": -1}, r"seed must be .*0\.\.999, got -1"),
        ({"algorithm": "ppo", "steps": None}, r"minutes and steps must be .*\[None, None\]"),
        ({"algorithm": "ppo", "minutes": 1.0}, "minutes and steps must be"),
        ({"steps": 3}, "steps must be left out"),
        ({"algorithm": "dqn", "initial": "short-highway"}, "initial .*'short-highway'"),
        ({"envs": env(action="mask")}, "env: action is chosen"),
        ({"envs": env(records="mine")}, "env: records is chosen"),
        ({"envs": (f"{SHORT} 3",)}, "env must be an id and a JSON object, got"),
        ({"envs": env(estimatr="ukf")}, "estimatr is unknown"),
        ({"envs": env(horizon=60)}, "horizon .* above the 60 s"),
        ({"envs": env(horizon=61), "algorithm": FEW}, "horizon must be 62 s .* got 61"),
        ({"envs": env(bandwidth=6)}, "bandwidth must be below 6 .* got 6"),
        ({"envs": (ENV, *env(privacy="paced"))}, "env: .*paced.*: .* the same channels"),
        ({"envs": (ENV, OTHER), "algorithm": "ppo"}, "env must be one .*PrivateHighway"),
        ({"envs": env(**PAIRS), "algorithm": "ppo"}, "algorithm must be one of .*, got ppo"),
        ({"envs": SECURE, "algorithm": "ppo"}, "algorithm.replicas must be 1 .* got 2"),
        ({"envs": env(privacy=SUMS)}, "privacy.preset must be .*SumRelease"),
    ],
)
def test_plans_that_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        make_plan(**changes).check()


def test_longer_roads_get_fewer_episodes():
    first, second = make_plan(envs=(ENV, OTHER)).worlds
    assert (first.part(100), second.part(100)) == (100, 40)
    assert second.part(4, 2) == 2
    assert second.part(1) == 1
