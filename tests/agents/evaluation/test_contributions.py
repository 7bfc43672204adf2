import gymnasium as gym
import numpy as np
import pytest

from agents.environments import make_config
from agents.evaluation.contributions import (
    LENGTHS,
    NEARLY_SPENT,
    QUANTILES,
    LedgerWatcher,
    vehicle_table,
)
from agents.evaluation.episodes import run_episode, run_episodes
from agents.experiments.runner import make_batch
from dptse_env.parts import make_release
from dptse_env.schedules import make_schedule
from dptse_env.traffic import RecordLibrary
from tests.agents.studies.ledger.made_up import N_MAINLINE, SHORT

SEEDS = (2000, 2001)
PACED = {"preset": "paced", "epsilon": 5.0, "pace": 1.0, "clip": 20.0}
CAPPED = {"preset": "capped", "epsilon": 5.0, "cap": 8}


def watch(privacy, **keywords):
    """Return watcher, scores and payments by place and length of two episodes."""
    env = make_batch(SHORT, {"estimator": "ekf", "privacy": privacy, **keywords}, SEEDS)
    watcher = LedgerWatcher(env.process, SEEDS)
    schedule = make_schedule("round-robin", env)
    scores = run_episodes(env, schedule, traffic_seeds=SEEDS, seeds=SEEDS, on_second=watcher)
    return scores, watcher.scores(scores), watcher.trips(scores)


def truth_of(privacy, seed):
    """Return the sum of refused contributions and the last ``truth`` of an episode."""
    keywords = {"estimator": "ekf", "privacy": privacy, "traffic_seeds": [seed]}
    env = gym.make(SHORT, disable_env_checker=True, truth_in_info=True, **keywords)
    process, refused = env.unwrapped.process, []

    def on_second():
        refused.append(process.info(0)["truth"].get("n_refused", 0))

    schedule = make_schedule("round-robin", env)
    run_episode(env, schedule, traffic_seed=seed, seed=seed, on_second=on_second)
    return sum(refused), process.info(0)["truth"]


@pytest.fixture(scope="module")
def paced():
    return watch(PACED)


def test_scores_are_those_of_the_episodes(paced):
    plain, scores, _ = paced
    for score, watched in zip(plain, scores, strict=True):
        assert vars(score).items() <= vars(watched).items()


def test_refusals_and_ledgers_are_those_of_the_truth(paced):
    _, scores, trips = paced
    for score, trip, seed in zip(scores, trips, SEEDS, strict=True):
        refused, truth = truth_of(PACED, seed)
        assert score.n_refused == refused > 0
        spent = np.array(truth["ledgers"])
        assert score.n_exhausted == (spent > NEARLY_SPENT).sum() > 0
        record = RecordLibrary().get(make_config(SHORT, {}).corridor, seed)
        on_road = np.unique(record.vehicle[record.segment < N_MAINLINE])
        assert score.n_vehicles == on_road.size
        expected = np.quantile(spent[on_road], QUANTILES)
        np.testing.assert_allclose(trip.numbers("quantiles"), expected, rtol=1e-5)


def test_places_and_lengths_add_up(paced):
    _, scores, trips = paced
    for score, trip in zip(scores, trips, strict=True):
        assert trip.numbers("vehicles").sum() == score.n_vehicles
        assert trip.numbers("refused").shape == (N_MAINLINE,)
        # Ramps have fixed sensors, too: what is met there has no place on the mainline.
        assert 0 < trip.numbers("met").sum() < score.n_met
        assert trip.numbers("refused_of").sum() == score.n_refused
        assert (trip.numbers("refused") <= trip.numbers("met")).all()
        assert (trip.numbers("spent") <= trip.numbers("vehicles")).all()


def test_lengths_are_seconds_on_the_mainline(paced):
    _, _, trips = paced
    record = RecordLibrary().get(make_config(SHORT, {}).corridor, SEEDS[0])
    counted = (record.segment < N_MAINLINE) & (record.step > 0)
    seconds = np.bincount(record.vehicle[counted])
    by_hand = np.histogram(seconds[seconds > 0], [*LENGTHS, np.inf])[0]
    np.testing.assert_array_equal(trips[0].numbers("vehicles"), by_hand)


def test_a_cap_refuses_what_comes_after_it():
    _, scores, _ = watch(CAPPED)
    for score, seed in zip(scores, SEEDS, strict=True):
        _, truth = truth_of(CAPPED, seed)
        counted = np.array(truth["exposures"])
        assert score.n_met - score.n_refused == counted.sum()
        assert score.n_refused > 0
        assert score.n_exhausted == (counted == CAPPED["cap"]).sum() > 0


@pytest.mark.parametrize("preset", ["capped", "paced"])
def test_where_every_second_has_a_budget_nobody_runs_out(preset):
    _, scores, _ = watch({"preset": preset, "epsilon": 5.0, "unit": "event"})
    for score in scores:
        assert score.n_met > 100
        assert (score.n_refused, score.n_exhausted) == (0, 0)


def test_released_boundary_segments_are_met_too(paced):
    _, scores, _ = watch({**PACED, "boundary_inputs": "private"})
    for score, nominal in zip(scores, paced[1], strict=True):
        assert score.n_met > nominal.n_met


def test_a_release_model_without_accounts_is_refused():
    release = make_release(make_config(SHORT, {"privacy": {"preset": "corrected"}}))
    with pytest.raises(ValueError, match=r"privacy\.preset must keep account .* got 'corrected'"):
        vehicle_table(release)
