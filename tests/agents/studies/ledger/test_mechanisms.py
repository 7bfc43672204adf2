import math

import gymnasium as gym
import numpy as np
import pytest

from agents.environments import make_config
from agents.studies.ledger.cell import EXACT, PACED
from agents.studies.ledger.pacing import EqualRates
from dptse_env.parts import privacy_report
from dptse_env.release import PublicStep
from dptse_env.release.pacing import PacingSetup, TracerPacing
from dptse_env.schedules import make_schedule
from tests.agents.studies.ledger.made_up import DESIGN, N_MAINLINE, SHORT


def play(cell, n_steps=120):
    """Return queries, released values and true densities of every second, and the last info."""
    keywords = {**cell.keywords, "traffic_seeds": [2000], "truth_in_info": True}
    env = gym.make(SHORT, disable_env_checker=True, **keywords)
    schedule = make_schedule(cell.schedule, env)
    observation, info = env.reset(seed=2000, options={"traffic_seed": 2000})
    state, seconds = None, []
    for _ in range(n_steps):
        action, state = schedule.predict(observation, state)
        observation, _, _, _, info = env.step(action)
        process = env.unwrapped.process
        released = process.released[0, :N_MAINLINE, 0].copy()
        seconds.append((info["queried"], released, info["truth"]["density"][:N_MAINLINE]))
    return *(np.array(part) for part in zip(*seconds, strict=True)), info


def test_exact_releases_the_true_densities_of_what_is_queried():
    queried, released, truth, info = play(DESIGN.cell(EXACT))
    assert queried.any(axis=0).all()
    assert truth[queried].max() > 10.0
    np.testing.assert_allclose(released[queried], truth[queried], atol=0.1)
    assert math.isinf(info["epsilon"])


def test_paced_releases_the_same_with_noise():
    queried, released, truth, _ = play(DESIGN.cell(PACED))
    error = released[queried] - truth[queried]
    assert np.std(error) > 5.0
    assert abs(error.mean()) < 3.0 * np.std(error) / math.sqrt(error.size)


def test_exact_claims_nothing():
    report = privacy_report(make_config(SHORT, DESIGN.cell(EXACT).keywords))
    assert report.guarantee == "none"
    assert report.void_reasons == ("not_stated",)


@pytest.fixture
def pacings():
    corridor = make_config(SHORT, DESIGN.cell().keywords).corridor
    n = corridor.n_segments
    setup = PacingSetup(
        corridor=corridor,
        budget=2.0,
        pace=0.8,
        ratio=1.0,
        first=np.arange(n),
        span=np.ones(n, dtype=np.int64),
        level=np.ones(n),
        always=np.zeros(0, dtype=np.int64),
        coverage=1 / 3,
        n_places=n,
        n_episodes=2,
    )
    return TracerPacing(setup), EqualRates(setup)


def test_equal_rates_do_not_follow_the_queries(pacings):
    """The last segment's price depends on its rate of querying alone, where nothing moves."""
    n = pacings[0].setup.n_places
    observed = np.zeros((2, n), dtype=bool)
    observed[0, 0], observed[1, N_MAINLINE - 1] = True, False
    step = PublicStep(np.arange(2), observed, np.full((2, n), 20.0), np.zeros((2, n)))
    prices = [[pacing.prices(step) for _ in range(60)] for pacing in pacings]
    (first, *_, followed), (equal_first, *_, equal) = prices
    np.testing.assert_array_equal(first, equal_first)
    assert followed[0, N_MAINLINE - 1] > 1.3 * first[0, N_MAINLINE - 1]
    assert equal[0, N_MAINLINE - 1] == first[0, N_MAINLINE - 1]
