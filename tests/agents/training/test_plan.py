"""Settings of algorithms, plans, and what is refused of either before anything runs."""

import json

import pytest

pytest.importorskip("sb3_contrib")

from agents.training.plan import ALGORITHMS, parse_algorithm
from tests.agents.training.plans import ENV, OTHER, make_algorithm, make_plan
from tests.helpers import SHORT, SumRelease


@pytest.mark.parametrize("name", ALGORITHMS)
def test_tuned_settings_make_whole_minibatches(name):
    plan = make_plan(algorithm=ALGORITHMS[name])
    plan.check()
    if name != "plackett-luce":
        ppo = plan.algorithm
        assert ppo.n_envs * ppo.n_steps * plan.actions_per_step % ppo.batch_size == 0


def test_settings_that_are_given_replace_single_ones():
    given = parse_algorithm('plackett-luce {"swaps": {"step": 9.0, "final_step": 1, "rounds": 5}}')
    assert [given.swaps.step_of(k) for k in (0, 1, 4)] == [9.0, 7.0, 1.0]
    assert given.regression == ALGORITHMS["plackett-luce"].regression
    assert parse_algorithm("ppo") == ALGORITHMS["ppo"]
    assert parse_algorithm('ppo {"steps": 8193}').n_updates == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("dqn", "algorithm must be one of plackett-luce, ppo, maskable-ppo, got 'dqn'"),
        ("ppo {", "algorithm must be JSON"),
        ('ppo {"gama": 0.9}', "algorithm.gama is unknown"),
        ('ppo {"gamma": 1.0}', r"algorithm.gamma must be .*\(0, 1\), got 1.0"),
        ('ppo {"replicas": 3}', "algorithm.n_envs must be a multiple of replicas 3, got 128"),
        ('plackett-luce {"swaps": {"step": 0}}', "algorithm.swaps.step must be .*> 0, got 0"),
        (
            'plackett-luce {"swaps": {"rounds": 0}, "regression": {"rounds": 0}}',
            "algorithm.swaps.rounds must be .*, got 0",
        ),
    ],
)
def test_bad_settings_are_named(text, message):
    with pytest.raises(ValueError, match=message):
        parse_algorithm(text)


def env(**keywords):
    return (f"{SHORT} {json.dumps({'horizon': 80, **keywords})}",)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": -1}, r"seed must be an integer in 0\.\.999, got -1"),
        ({"traffic_seeds": (0, 2000)}, r"traffic must be traffic seeds in 0\.\.999, got 2000"),
        ({"validation_seeds": (0,)}, r"validation must be .* 1000\.\.1999, got 0"),
        ({"envs": ()}, r"env must be one or more environments, got \(\)"),
        ({"envs": env(action="mask")}, "env: action is chosen by the training"),
        ({"envs": (f"{SHORT} 3",)}, "env must be an id and a JSON object, got"),
        ({"envs": env(estimatr="ukf")}, "estimatr is unknown"),
        ({"envs": env(horizon=60)}, "horizon must be above 60 s, .*, got 60"),
        ({"envs": (ENV, *env(privacy="paced"))}, "env: .*paced.*: .* the same channels"),
        (
            {"envs": (ENV, OTHER), "algorithm": make_algorithm("ppo")},
            "env must be one environment for ppo, got .*PrivateHighway",
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


def test_longer_roads_get_fewer_episodes():
    first, second = make_plan(envs=(ENV, OTHER)).worlds
    assert (first.part(100), second.part(100)) == (100, 40)
    assert second.part(4, 2) == 2
    assert second.part(1) == 1
