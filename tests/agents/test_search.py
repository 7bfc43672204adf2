import dataclasses
import json
import math
import shutil

import gymnasium as gym
import pytest
from optuna.distributions import CategoricalDistribution, FloatDistribution

from agents.executors import this_process
from agents.play import Cell
from agents.search.space import (
    DEMAND_START,
    EXTRAS,
    SPACE,
    at_bound,
    evenly,
    holds,
    nested,
    search_space,
    values_of,
)
from agents.search.tuning import BATCH, Search, chosen, n_finished, tune, write_set
from agents.seeds import TUNING
from dptse_env.estimators import ESTIMATORS, EstimatorSettings
from dptse_env.estimators.tuned import available_settings, load_settings, read_settings
from dptse_env.evaluation import evaluate
from dptse_env.utils.validation import from_mapping
from tests.helpers import SHORT, save_untrained

KEYWORDS = {
    "estimator": "ekf",
    "parameters": "w99-3lane",
    "epsilon": 1.0,
    "delta": 0.05,
    "bandwidth": 2,
}
JOURNAL = "trials.journal"
CELL = Cell(SHORT, "shift-ahead", KEYWORDS, noise_seed=TUNING.start, seeds=(0, 1))
SEARCH = Search(CELL)


# The space ----------------------------------------------------------------------------------------


def test_every_estimator_that_has_settings_can_be_tuned():
    assert {*SPACE, "open_loop", "recurrent"} == set(ESTIMATORS)


@pytest.mark.parametrize("estimator", SPACE)
def test_the_search_holds_the_defaults_and_the_shipped_sets(estimator):
    names = [
        name
        for name in available_settings()
        if name.startswith(f"{estimator}-") and not name.endswith("-published")  # the paper's own
    ]
    starts = [DEMAND_START] if estimator not in ("random_walk", "asm") else []
    for settings in (EstimatorSettings(), *map(load_settings, names), *starts):
        extras = ("noise-scale", "demand") if settings.demand else ()
        extras = extras or (("vehicles",) if settings.flicker else ())
        space = search_space(estimator, (*extras, "speed-cap"))
        assert set(space) >= set(EXTRAS["speed-cap"]) | set(SPACE[estimator])
        values = values_of(settings, space)
        assert all(holds(knob, values[path]) for path, knob in space.items())
        assert from_mapping(EstimatorSettings, nested(values), "settings").process_noise == (
            settings.process_noise
        )
        if settings != DEMAND_START:
            assert from_mapping(EstimatorSettings, nested(values), "settings") == settings


def test_bounds_of_the_search_are_seen():
    knob, options = evenly(1e-3, 1e-1), CategoricalDistribution((1, 2))
    values = (1e-3, 1.09e-3, 1.2e-3, 8e-2, 9.2e-2, 1e-1)
    assert [at_bound(knob, value) for value in values] == [True, True, False, False, True, True]
    assert at_bound(FloatDistribution(1.0, 1.1), 1.001)
    assert not at_bound(FloatDistribution(1.0, 1.1), 1.05)
    assert [holds(knob, value) for value in (9e-4, 1e-2, 0.2)] == [False, True, False]
    assert [holds(options, value) for value in (1, 3)] == [True, False]
    assert not at_bound(options, 1)


# The trials ---------------------------------------------------------------------------------------


class MadeUp(Search):
    """Scores that are best at a process noise of (0.02, 0.005)."""

    def play(self, settings, seeds):
        pairs = zip(settings.process_noise, (0.02, 0.005), strict=True)
        far = sum(math.log(value / best) ** 2 for value, best in pairs)
        errors = {"rmse_density": 10 + far, "rmse_speed": 5 + far}
        return [{**errors, "reward": -0.1 * far - seed} for seed in seeds]


class Broken(MadeUp):
    """Its rewards are not finite where density's process noise is above the default."""

    def play(self, settings, seeds):
        is_bad = settings.process_noise[0] > self.cell.keywords["epsilon"]
        first, *rest = super().play(settings, seeds)
        return [{**first, "reward": math.nan if is_bad else first["reward"]}, *rest]


def made_up(kind=MadeUp, seed=0, **changes):
    cell = dataclasses.replace(CELL, **{"seeds": tuple(range(3 * BATCH)), **changes})
    return kind(cell, seed=seed)


def run(folder, n_trials, search=None, executor=this_process):
    return tune(search or made_up(), folder / JOURNAL, n_trials, executor)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A study of 60 trials of one worker; leave it alone."""
    return run(tmp_path_factory.mktemp("whole"), 60)


def test_it_finds_the_best_settings(whole, tmp_path):
    path = tmp_path / "x.json"
    write_set(made_up(), whole, path)
    assert read_settings(path).process_noise == pytest.approx((0.02, 0.005), rel=0.5)
    assert whole.best_value > chosen(whole)["defaults"].value
    provenance = json.loads(path.read_text())[made_up().name]["provenance"]
    assert provenance["n_trials"] == n_finished(whole) == 60
    assert (provenance["bandwidth"], provenance["at_bounds"]) == (2, [])
    assert len({tuple(t.params.values()) for t in whole.get_trials()}) == 60


def test_the_defaults_and_the_present_set_come_first_and_bad_trials_stop_early(whole):
    first, second, *others = whole.get_trials()
    present = load_settings("ekf-w99-3lane-printed")
    for trial, settings in ((first, EstimatorSettings()), (second, present)):
        assert nested(trial.params)["process_noise"] == list(settings.process_noise)
        assert len(trial.intermediate_values) == 3
    stopped = [t for t in others if t.state.name == "PRUNED"]
    assert stopped
    assert all(len(t.intermediate_values) < 3 for t in stopped)
    assert not any("label" in t.user_attrs for t in others)


def test_a_score_that_is_not_finite_is_never_the_best(tmp_path):
    study = run(tmp_path, 20, made_up(Broken, keywords={**KEYWORDS, "epsilon": 0.01}))
    assert study.best_params["process_noise.0"] <= 0.01
    search = made_up(Broken, keywords={**KEYWORDS, "epsilon": 1e-4})
    study = run(tmp_path, 3, search)
    with pytest.raises(ValueError, match=r"ekf-w99-3lane-printed .*: no trial ran to its end"):
        write_set(search, study, tmp_path / "x.json")


@pytest.mark.parametrize(
    "changes", [{"seeds": (0, 1, 2)}, {"seed": 1}, {"keywords": {**KEYWORDS, "bandwidth": 3}}]
)
def test_another_search_has_trials_of_its_own_in_the_journal(changes, tmp_path):
    journal, other = tmp_path / JOURNAL, made_up(**changes)
    assert not made_up().is_begun(journal)
    run(tmp_path, 1)
    assert made_up().is_begun(journal)
    assert not other.is_begun(journal)
    assert n_finished(run(tmp_path, 2, other)) == 2
    assert n_finished(run(tmp_path, 1)) == 1


# What a trial plays -------------------------------------------------------------------------------


def make(search, settings):
    given = {"traffic_seeds": "0:3", "estimator_settings": dataclasses.asdict(settings)}
    return gym.make(search.cell.env, **search.cell.all_keywords, **given)


def test_trials_are_scored_as_an_evaluation_with_other_noise_seeds(tmp_path):
    settings = EstimatorSettings(process_noise=(0.02, 0.03))
    expected = evaluate(make(SEARCH, settings), "shift-ahead", (0, 1), 1_000_000)
    assert SEARCH.play(settings, (0, 1)) == expected
    first = run(tmp_path, 1, SEARCH).get_trials()[0]
    rows = SEARCH.play(EstimatorSettings(), (0, 1))
    assert rows != expected
    for key, value in {**first.user_attrs, "reward": first.value}.items():
        if key != "label":
            assert value == pytest.approx(sum(row[key] for row in rows) / 2, rel=1e-12)


def test_settings_can_be_tuned_for_a_saved_policy(tmp_path):
    pytest.importorskip("torch")
    files = [save_untrained(tmp_path / f"{seed}.safetensors", seed=seed) for seed in (1, 2)]
    one, other = (Search(dataclasses.replace(CELL, policy=str(path))) for path in files)
    settings = EstimatorSettings(process_noise=(0.02, 0.03))
    env = make(one, settings)
    expected = evaluate(env, one.cell.load_policy(env), (1,), 1_000_000)
    assert one.play(settings, (1,)) == expected != SEARCH.play(settings, (1,))
    assert one.study_name != other.study_name
    shutil.copy(files[0], files[1])
    assert one.study_name == other.study_name  # by content, not by name
