import dataclasses

import numpy as np
import pytest

from agents.evaluation.episodes import WARM_UP
from agents.search.plans import Arena, PlanSearch, PlanTask, even_plan, held_out, masks_of
from dptse_env.schedules.plans import Place

SHORT = "dptse_env:dptse/ShortHighway-v0"
TASK = PlanTask(
    SHORT, "offline", 3, estimator="random_walk", seeds="0:4", neighbours=7, bandwidth=2
)


@pytest.fixture(scope="module")
def arena():
    return Arena(TASK, TASK.traffic_seeds, TASK.batch)


def test_scores_are_the_mean_rewards_after_the_warm_up(arena):
    plans = np.zeros((2, 2, 6), dtype=bool)
    plans[0, :, :2] = True
    plans[1, 0, [0, 3]], plans[1, 1, [1, 4]] = True, True
    scores = arena.scores(plans, np.array([2, 0]), noise=50)
    env = TASK.make(1, TASK.traffic_seeds)
    for i, plan in enumerate(plans):
        for j, seed in enumerate([2, 0]):
            env.reset(seed=50 + seed, options={"traffic_seed": seed})
            rewards = [
                env.step(plan[step % 2][None].astype(np.int8))[1][0]
                for step in range(env.unwrapped.config.horizon_steps)
            ]
            assert scores[i, j] == pytest.approx(np.mean(rewards[WARM_UP:]), rel=1e-12)


def test_scores_do_not_depend_on_the_blocks(arena):
    plans = np.stack([even_plan(arena, 3), ~even_plan(arena, 3)])
    plans[1] = np.roll(plans[0], 1, axis=1)
    seeds = np.arange(4)
    whole = arena.scores(plans, seeds, 0)
    narrow = Arena(TASK, TASK.traffic_seeds, 4).scores(plans, seeds, 0)
    np.testing.assert_array_equal(whole, narrow)


def test_every_plan_that_is_tried_is_full_and_spares_fixed_sensors():
    search, generator = PlanSearch(TASK), np.random.default_rng(0)
    for _ in range(50):
        plan = search._random(generator)
        assert plan.shape == (3, 6)
        assert (plan.sum(axis=1) == 2).all()
        assert not plan[:, 5].any()
        assert plan.sum(axis=0)[:5].max() - plan.sum(axis=0)[:5].min() <= 1
        search.best = plan
        near = search._neighbour(generator)
        assert (near.sum(axis=1) == 2).all()
        assert not near[:, 5].any()
        assert (near != plan).sum() in (2, 4)


def test_the_search_finds_a_planted_plan(monkeypatch):
    """Scores that count how much of a known plan is hit: the search climbs to it."""
    search = PlanSearch(TASK)
    goal = np.zeros((3, 6), dtype=bool)
    goal[[0, 0, 1, 1, 2, 2], [0, 1, 1, 4, 2, 3]] = True

    def hits(plans, seeds, noise):
        luck = np.random.default_rng(noise).normal(0, 0.2, len(seeds))
        return (plans & goal).sum(axis=(1, 2))[:, None] + luck

    monkeypatch.setattr(search._arena, "scores", hits)
    search.begin()
    search.go_on(40, lambda: None)
    np.testing.assert_array_equal(search.best, goal)
    assert 0 < search.n_adopted < 40


def test_luck_alone_is_seldom_adopted(monkeypatch):
    search = PlanSearch(TASK)
    generator = np.random.default_rng(0)
    monkeypatch.setattr(
        search._arena, "scores", lambda plans, seeds, _: generator.normal(size=(len(plans), 16))
    )
    search.go_on(100, lambda: None)
    # One standard error above zero happens to one in six.
    assert search.n_adopted < 30


def test_a_search_goes_on_to_the_same_end(monkeypatch):
    worth = np.random.default_rng(1).normal(size=(12, 6))

    def hits(arena, plans, seeds, noise):
        luck = np.random.default_rng(noise).normal(0, 0.2, len(seeds))
        return (plans * worth).sum(axis=(1, 2))[:, None] + luck

    monkeypatch.setattr(Arena, "scores", hits)
    monkeypatch.setattr(PlanSearch, "begin", lambda _: None)
    task = dataclasses.replace(TASK, period=12)
    whole = PlanSearch(task)
    whole.begin()
    whole.go_on(3, lambda: None)
    first, second = PlanSearch(task), PlanSearch(task)
    first.begin()
    first.go_on(1, lambda: None)
    second.resume(first.plan())
    second.go_on(3, lambda: None)
    np.testing.assert_array_equal(second.best, whole.best)
    assert whole.n_adopted > 0
    assert second.plan() == whole.plan()
    assert whole.plan().place == Place.of(whole._arena.env.config)


def test_held_out_scores_are_of_validation_traffic():
    search = PlanSearch(TASK)
    scores = held_out(TASK, search.plan(), n_seeds=2)
    assert set(scores) == {"plan", "round-robin"}
    assert -1.0 < scores["plan"] < 0.0
    own = masks_of(search.plan(), 6)
    direct = Arena(TASK, (1000, 1001), 2).scores(own[None], np.array([1000, 1001]), 0).mean()
    assert scores["plan"] == pytest.approx(direct, rel=1e-12)


@pytest.mark.parametrize(("changes", "message"), [
    ({"kind": "best"}, "kind must be one of best-static, offline"),
    ({"period": 0}, "period must be"),
    ({"kind": "best-static"}, "period must be 1 for a static set, got 3"),
    ({"seeds": "0:1001"}, "seeds must be training seeds"),
    ({"seeds": "0:3"}, "seeds must be 4 or more"),
    ({"neighbours": 2}, "neighbours must be"),
], ids=str)  # fmt: skip
def test_bad_tasks_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(TASK, **changes)


def test_a_bandwidth_without_a_choice_is_refused():
    with pytest.raises(ValueError, match="bandwidth 6 leaves nothing to choose among the 5"):
        PlanSearch(dataclasses.replace(TASK, bandwidth=6))
