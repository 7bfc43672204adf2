import dataclasses

import pytest

from agents.experiments.cells import DENSITY
from agents.studies.policies.plan import (
    Entry,
)
from agents.studies.policies.results import ERROR
from agents.studies.policies.rules import POLICY_TARGETS, judge
from tests.agents.studies.policies.worlds import made_up


def verdicts(results):
    return [judge(results, results.primary, target) for target in POLICY_TARGETS]


def test_targets_are_met_where_all_is_so():
    best, paper = verdicts(made_up(spread=0.05))
    assert best.is_met
    assert paper.is_met
    assert (best.reference, paper.reference) == ("oldest-first", "paper")
    assert best.overall.mean == pytest.approx(10.0, abs=0.5)
    assert paper.overall.mean == pytest.approx(25.0, abs=0.5)


@pytest.mark.parametrize(
    ("changes", "wanting"),
    [
        ({"runs_below": (7.5,) * 5}, ["mean at least 8 %", "worst training seed at least 8 %"]),
        ({"runs_below": (10.0, 10.0, 7.0, 10.0, 10.0)}, ["worst training seed at least 8 %"]),
        ({"runs_below": (10.0,) * 4}, ["5 training seeds and 64 test seeds"]),
        ({"n_seeds": 63}, ["5 training seeds and 64 test seeds"]),
        ({"runs_below": (30.0, 20.0, -5.0, 20.0, 20.0)},
         ["worst training seed at least 8 %", "its interval above zero too"]),
        ({"runs_below": (60.0, -10.0, -10.0, 30.0, -10.0)},
         ["its interval above zero", "worst training seed at least 8 %",
          "its interval above zero too"]),
    ],
)  # fmt: skip
def test_a_target_is_missed_where_one_thing_is_wanting(changes, wanting):
    best, _ = verdicts(made_up(**changes))
    assert not best.is_met
    assert [part for part, holds in best.parts.items() if not holds] == wanting


def test_the_worst_training_seed_is_that_of_largest_error():
    best, _ = verdicts(made_up(runs_below=(10.0, 10.0, 7.0, 10.0, 12.0)))
    assert best.worst_seed == 2
    assert best.worst.mean == pytest.approx(7.0)


def test_the_reference_is_what_validation_chose_whatever_test_traffic_says():
    results = made_up()
    worse = dataclasses.replace(results.choice("primary"), baseline="paper")
    choices = {**results.manifest.choices, "primary": worse}
    other = dataclasses.replace(
        results, manifest=dataclasses.replace(results.manifest, choices=choices)
    )
    assert verdicts(other)[0].reference == "paper"
    assert other.best_on_test("primary") == "oldest-first"


def test_half_of_the_way_to_the_oracle():
    results = made_up()
    assert results.progress(results.primary).mean == pytest.approx(50.0)


def test_secondary_cells_are_judged_together():
    trained, moved = made_up(spread=0.05).comparisons
    assert (trained.learner.cell, moved.learner.cell) == ("other", "moved")
    assert moved.learner.trained_in == "primary"
    assert trained.verdict == moved.verdict == "better"
    assert trained.below.mean == pytest.approx(12.0, abs=0.5)
    unsure = made_up(elsewhere=2.0, spread=0.3).comparisons
    low, high = sorted(each.p_value for each in unsure)
    assert 0.05 < low < 0.5
    assert sorted(each.adjusted for each in unsure) == pytest.approx([2 * low, max(2 * low, high)])
    assert {each.verdict for each in made_up(elsewhere=-5.0, spread=0.01).comparisons} == {"worse"}
    same = made_up(elsewhere=0.0, spread=0.1).comparisons
    assert {each.verdict for each in same} == {"not significant"}


def test_errors_are_minus_rewards_and_times_a_thousand():
    results = made_up()
    error = results.schedule("primary", "paper")
    assert error.shape == (1, 64)
    first = results.scores[Entry("primary", "baseline", "paper"), 2000]
    assert error[0, 0] == -1000.0 * first.reward
    assert results.schedule("primary", "paper", DENSITY)[0, 0] == first.rmse_density
    assert results.learned(results.primary, ERROR).shape == (5, 64)
