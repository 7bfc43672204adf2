import dataclasses

import numpy as np
import pytest

from agents.engines.local import LocalProcesses
from agents.environments import make_vector
from agents.evaluation.episodes import WARM_UP
from agents.search.plan_scores import PlanScorer, PlanTask
from agents.search.plans import PlanSearch, even_plan, plan_masks, validation_scores
from dptse_env.schedules.plans import PlanContext
from tests.release.sums import SumRelease

SHORT = "dptse_env:dptse/ShortHighway-v0"
TASK = PlanTask(
    SHORT, "optimised-plan", 3, estimator="random_walk", seeds="0:4", neighbours=7, bandwidth=2
)


@pytest.fixture(scope="module")
def scorer():
    return PlanScorer(TASK, TASK.traffic_seeds, TASK.batch)


def test_scores_are_the_mean_rewards_after_the_warm_up(scorer):
    plans = np.zeros((2, 2, 6), dtype=bool)
    plans[0, :, :2] = True
    plans[1, 0, [0, 3]], plans[1, 1, [1, 4]] = True, True
    scores = scorer.scores(plans, np.array([2, 0]), noise=50)
    env = TASK.make(1, TASK.traffic_seeds)
    for i, plan in enumerate(plans):
        for j, seed in enumerate([2, 0]):
            env.reset(seed=50 + seed, options={"traffic_seed": seed})
            rewards = [
                env.step(plan[step % 2][None].astype(np.int8))[1][0]
                for step in range(env.unwrapped.config.horizon_steps)
            ]
            assert scores[i, j] == pytest.approx(np.mean(rewards[WARM_UP:]), rel=1e-12)


def test_scores_do_not_depend_on_the_blocks(scorer):
    plans = np.stack([even_plan(scorer, 3), ~even_plan(scorer, 3)])
    plans[1] = np.roll(plans[0], 1, axis=1)
    seeds = np.arange(4)
    wide = scorer.scores(plans, seeds, 0)
    narrow = PlanScorer(TASK, TASK.traffic_seeds, 4).scores(plans, seeds, 0)
    np.testing.assert_array_equal(wide, narrow)


def test_scores_do_not_depend_on_who_plays(scorer):
    plans = np.stack([np.roll(even_plan(scorer, 3), k, axis=1) for k in range(5)])
    seeds = np.arange(4)
    with LocalProcesses(2).open() as workers:
        there = PlanScorer(TASK, TASK.traffic_seeds, TASK.batch, workers=workers)
        shared = there.scores(plans, seeds, 7)
    np.testing.assert_array_equal(shared, scorer.scores(plans, seeds, 7))


class Fake(PlanScorer):
    """Scores that a test makes up, and the plans that were tried."""

    def __init__(self, score, task=TASK):
        super().__init__(task, task.traffic_seeds, task.batch)
        self.score, self.tried = score, []

    def scores(self, plans, seeds, noise):
        self.tried.append(plans)
        return self.score(plans, seeds, noise)


def luck_of(noise, seeds):
    return np.random.default_rng(noise).normal(0, 0.2, len(seeds))


def test_every_plan_that_is_tried_is_full_and_spares_fixed_sensors():
    fake = Fake(lambda plans, seeds, noise: np.random.default_rng(noise).normal(
        size=(len(plans), len(seeds))))  # fmt: skip
    search = PlanSearch(TASK, fake)
    search.begin()
    n_begin = len(fake.tried)
    search.go_on(10, lambda: None)
    for plans in fake.tried:
        assert plans.shape[1:] == (3, 6)
        assert (plans.sum(axis=2) == 2).all()
    # Random plans follow the even one; they query all segments without a sensor equally often.
    random = fake.tried[0][1:]
    assert not random[:, :, 5].any()
    totals = random.sum(axis=1)[:, :5]
    assert (totals.max(axis=1) - totals.min(axis=1) <= 1).all()
    # Neighbours differ from the best plan, the first of a round, in an exchange or two.
    for best, *neighbours in fake.tried[n_begin:]:
        for plan in neighbours:
            assert (plan != best).sum() in (2, 4)
            assert not (plan & ~best)[:, 5].any() or best[:, 5].any()


def test_the_search_finds_a_planted_plan():
    """Scores that count the hits of a known plan: the search climbs to it."""
    goal = np.zeros((3, 6), dtype=bool)
    goal[[0, 0, 1, 1, 2, 2], [0, 1, 1, 4, 2, 3]] = True

    def hits(plans, seeds, noise):
        return (plans & goal).sum(axis=(1, 2))[:, None] + luck_of(noise, seeds)

    search = PlanSearch(TASK, Fake(hits))
    search.begin()
    search.go_on(40, lambda: None)
    np.testing.assert_array_equal(search.best, goal)
    assert 0 < search.n_adopted < 40


def test_luck_alone_is_seldom_adopted():
    generator = np.random.default_rng(0)
    fake = Fake(lambda plans, seeds, _: generator.normal(size=(len(plans), 16)))
    search = PlanSearch(TASK, fake)
    search.go_on(100, lambda: None)
    # One standard error above zero happens to one in six.
    assert search.n_adopted < 30


def test_a_search_goes_on_to_the_same_end():
    worth = np.random.default_rng(1).normal(size=(12, 6))
    task = dataclasses.replace(TASK, period=12)

    def make_search():
        return PlanSearch(task, Fake(hits, task))

    def hits(plans, seeds, noise):
        return (plans * worth).sum(axis=(1, 2))[:, None] + luck_of(noise, seeds)

    complete, first, second = make_search(), make_search(), make_search()
    complete.go_on(3, lambda: None)
    first.go_on(1, lambda: None)
    second.resume(first.plan())
    second.go_on(3, lambda: None)
    np.testing.assert_array_equal(second.best, complete.best)
    assert complete.n_adopted > 0
    assert second.plan() == complete.plan()
    config = task.make(1, task.traffic_seeds).config
    assert complete.plan().context == PlanContext.from_config(config)


def test_held_out_scores_are_of_validation_traffic():
    search = PlanSearch(TASK)
    scores = validation_scores(TASK, search.plan(), n_seeds=2)
    assert set(scores) == {"plan", "round-robin"}
    assert -1.0 < scores["plan"] < 0.0
    masks = plan_masks(search.plan(), 6)
    direct = PlanScorer(TASK, (1000, 1001), 2).scores(masks[None], np.array([1000, 1001]), 0).mean()
    assert scores["plan"] == pytest.approx(direct, rel=1e-12)


@pytest.mark.parametrize(("changes", "message"), [
    ({"kind": "best"}, "kind must be one of best-static, optimised-plan"),
    ({"period": 0}, "period must be"),
    ({"kind": "best-static"}, "period must be 1 for a static set, got 3"),
    ({"seeds": "0:1001"}, "seeds must be training seeds"),
    ({"seeds": "0:3"}, "seeds must be 4 or more"),
    ({"neighbours": 2}, "neighbours must be"),
], ids=str)  # fmt: skip
def test_bad_tasks_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(TASK, **changes).check()


def test_a_bandwidth_without_a_choice_is_refused():
    with pytest.raises(ValueError, match="bandwidth 6 leaves nothing to choose among the 5"):
        PlanSearch(dataclasses.replace(TASK, bandwidth=6))


@pytest.mark.filterwarnings("ignore:.*values measured or tuned on")
def test_a_plan_is_searched_on_a_road_of_one_s_own():
    task = dataclasses.replace(TASK, corridor='{"name": "wide", "lanes": 4}')
    plan = PlanSearch(task).plan()
    assert plan.context.corridor == "wide"
    assert plan.provenance["task"]["corridor"] == task.corridor


def test_plans_are_of_single_segments():
    class Sums(PlanTask):
        def make(self, n_episodes, seeds, records=None):
            keywords = {"privacy": SumRelease, "query_spans": (1, 2), "traffic_seeds": seeds}
            return make_vector(self.env, n_episodes, keywords)

    with pytest.raises(
        ValueError, match=r"^plans are of single segments: .* got query_spans \(1, 2"
    ):
        PlanScorer(Sums(SHORT), (0, 1), 2)
