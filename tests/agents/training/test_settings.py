"""Settings of algorithms, plans, and what is refused of either before anything runs."""

import json

import pytest

pytest.importorskip("sb3_contrib")

from agents.training.plan import fitting
from agents.training.settings import ALGORITHMS, TABLE, parse_algorithm
from dptse_env.config import resolve
from dptse_env.utils.validation import read_toml
from tests.agents.training.plans import ENV, ONE, OTHER, make_algorithm, make_plan
from tests.helpers import SHORT, SumRelease


def test_the_table_has_every_algorithm_and_says_what_each_value_is():
    assert [*read_toml(TABLE, "table")] == [*ALGORITHMS]
    lines = TABLE.read_text(encoding="utf-8").splitlines()
    known = {line.split()[0] for line in lines if " = " in line and "  # " in line}
    assert {line.split()[0] for line in lines if " = " in line} - known == {"like", "segments"}


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
        ("a2c", "algorithm must be one of ppo, maskable-ppo, .*, plackett-luce, got 'a2c'"),
        ("ppo {", "algorithm must be JSON"),
        ('ppo {"gama": 0.9}', "algorithm.gama is unknown"),
        ('dqn {"gamma": 1.0}', r"algorithm.gamma must be .*\(0, 1\), got 1.0"),
        ('ppo {"replicas": 3}', "algorithm.n_envs must be a multiple of 3 replicas, got 128"),
        ('recurrent-ppo {"policy": "road"}', "algorithm.policy must be mlp, got 'road'"),
        ('plackett-luce {"swaps": {"step": 0}}', "algorithm.swaps.step must be .*> 0, got 0"),
        (
            'plackett-luce {"swaps": {"rounds": 0}, "regression": {"rounds": 0}}',
            "algorithm.swaps.rounds must be .*, got 0",
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


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": -1}, r"seed must be an integer in 0\.\.999, got -1"),
        ({"traffic_seeds": (0, 2000)}, r"train_seeds must be traffic seeds in 0\.\.999, got 2000"),
        ({"validation_seeds": (0,)}, r"validation_seeds must be .* 1000\.\.1999, got 0"),
        ({"envs": ()}, r"env must be one or more environments, got \(\)"),
        ({"envs": env(action="mask")}, "env: action is chosen by the training"),
        ({"envs": env(records="mine")}, "env: records is chosen by the training"),
        ({"envs": (f"{SHORT} 3",)}, "env must be an id and a JSON object, got"),
        ({"envs": env(estimatr="ukf")}, "estimatr is unknown"),
        ({"envs": env(horizon=60)}, "horizon or the road's duration must be above the 60 s"),
        ({"envs": (ENV, *env(privacy="paced"))}, "env: .*paced.*: .* the same channels"),
        (
            {"envs": (ENV, OTHER), "algorithm": make_algorithm("ppo"), "steps": 9},
            "env must be one environment for ppo, got .*PrivateHighway",
        ),
        (
            {"envs": (ENV,), "algorithm": make_algorithm("dqn"), "steps": 9},
            "algorithm must be one of ppo, .*, plackett-luce where bandwidth is 2 .*, got dqn",
        ),
        (
            {"algorithm": make_algorithm("ppo"), "envs": env(**PAIRS), "steps": 9},
            'algorithm must be one of ppo {"policy": "mlp"}, maskable-ppo, .*, got ppo',
        ),
        (
            {
                "algorithm": make_algorithm("ppo"),
                "envs": env(privacy={"noise": "secure"}),
                "steps": 9,
            },
            "algorithm.replicas must be 1 where privacy.noise is 'secure', .*, got 2",
        ),
        (
            {"envs": env(privacy=f"{SumRelease.__module__}:SumRelease")},
            "privacy.preset must be one whose noise can be set where .*, got '.*SumRelease'",
        ),
        ({"envs": env(bandwidth=6)}, "bandwidth must be below 6 where .*, got 6"),
        (
            {
                "envs": env(horizon=61),
                "algorithm": make_algorithm(swaps={"seconds": 24, "rounds": 1}),
            },
            "horizon must be 62 s or more where .*, got 61",
        ),
    ],
)
def test_plans_that_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        make_plan(**changes).check()


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        (
            "ppo",
            {"steps": None},
            r"minutes and steps must be one of .* got \[None, None\]",
        ),
        (
            "ppo",
            {"minutes": 1.0, "steps": 9},
            "minutes and steps must be one of the two for ppo",
        ),
        (
            "ppo",
            {"minutes": 0.0, "steps": None},
            "minutes must be a finite number > 0 or None",
        ),
        ("ppo", {"steps": 0}, "steps must be an integer >= 1 or None, got 0"),
        (
            "plackett-luce",
            {"steps": 3},
            "steps must be left out for .*, which trains in rounds",
        ),
        (
            "dqn",
            {"initial": "short-highway"},
            "initial must be left out .*, got 'short-highway'",
        ),
    ],
)
def test_lengths_and_beginnings_that_are_refused(name, changes, message):
    with pytest.raises(ValueError, match=message):
        make_plan(name, **changes)


def test_longer_roads_get_fewer_episodes():
    first, second = make_plan(envs=(ENV, OTHER)).worlds
    assert (first.part(100), second.part(100)) == (100, 40)
    assert second.part(4, 2) == 2
    assert second.part(1) == 1
