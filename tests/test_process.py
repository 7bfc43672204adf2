import itertools

import numpy as np
import pytest
import qpsolvers
from scipy import stats

from dptse_env.config import resolve
from dptse_env.estimators import ESTIMATORS, REFERENCES
from dptse_env.parts import make_parts
from dptse_env.process import QueryProcess
from dptse_env.spaces.actions import ACTION_ENCODINGS
from tests.helpers import COUNTED, fast_and_slow

from .estimators.test_mhe import lying, missing, silent, unsolved

SEEDS = (11, 12, 13)
ALL = np.arange(3)


def make(n_episodes, preset="short-highway", **keywords):
    keywords = {"traffic_seeds": "0:3", "horizon": 60, "random_start": True, **keywords}
    config = resolve(preset, keywords)
    return QueryProcess(make_parts(config, n_episodes))


def generators(seeds):
    return [np.random.default_rng(seed) for seed in seeds]


def sampled(process, n_steps):
    """Return actions (n_steps, 3, *space) for a batch of three."""
    space = process.interface.actions.space
    space.seed(5)
    return [np.array([space.sample() for _ in SEEDS]) for _ in range(n_steps)]


PAID = {"preset": "paced", "boundary_inputs": "private"}


EVERY_WAY = [(e, a, "paper") for e in ESTIMATORS for a in ACTION_ENCODINGS]
EVERY_WAY += [(e, "mask", privacy) for e in ESTIMATORS for privacy in (COUNTED, PAID)]
WAYS = [
    ("ekf", "sequential", "paper"), ("ukf", "mask", COUNTED), ("enkf", "scores", "paper"),
    ("mhe", "mask", PAID), ("random_walk", "slots", "paper"), ("recurrent", "mask", PAID),
]  # fmt: skip


@pytest.mark.parametrize(("estimator", "action", "privacy"), fast_and_slow(EVERY_WAY, WAYS))
def test_a_batch_is_so_many_single_episodes(estimator, action, privacy):
    keywords = {"estimator": estimator, "action": action, "privacy": privacy}
    batch = make(3, truth_in_info=True, **keywords)
    singles = [make(1, truth_in_info=True, **keywords) for _ in SEEDS]
    together = [batch.reset(ALL, generators(SEEDS))]
    apart = [
        [one.reset(ALL[:1], generators([seed])) for one, seed in zip(singles, SEEDS, strict=True)]
    ]
    for actions in sampled(batch, 40):
        together.append(batch.step(ALL, actions))
        apart.append([one.step(ALL[:1], a[None]) for one, a in zip(singles, actions, strict=True)])
    for outcome, rows in zip(together, apart, strict=True):
        for field in ("observation", "reward", "truncated"):
            expected = np.concatenate([getattr(row, field) for row in rows])
            np.testing.assert_array_equal(getattr(outcome, field), expected)
    for e, one in enumerate(singles):
        np.testing.assert_equal(batch.info(e), one.info(0))


FORKS = [
    ("ekf", PAID, "compiled"), ("ukf", COUNTED, "compiled"), ("enkf", "paper", "compiled"),
    ("mhe", PAID, "compiled"), ("ekf", COUNTED, "reference"), ("recurrent", "paper", "compiled"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("estimator", "privacy", "backend"),
    fast_and_slow(
        [
            (name, privacy, backend)
            for backend, names in (("compiled", ESTIMATORS), ("reference", REFERENCES))
            for name, privacy in itertools.product(names, ["paper", COUNTED, PAID])
        ],
        FORKS,
    ),
)
def test_a_fork_goes_on_as_its_origin_would_have(estimator, privacy, backend):
    keywords = {"estimator": estimator, "privacy": privacy, "backend": backend}
    origin = make(3, action="sequential", truth_in_info=True, **keywords)
    origin.reset(ALL, generators(SEEDS))
    actions = sampled(origin, 30)  # past the noise that is drawn at a time
    for action in actions[:5]:
        origin.step(ALL, action)
    first, second = origin.fork(), origin.fork()
    others = [origin.interface.actions.space.n - 1 - action for action in actions]
    for action in others[5:]:
        first.step(ALL, action)
    ahead = second.fork()
    for action in actions[5:]:
        here, there, further = (p.step(ALL, action) for p in (origin, second, ahead))
        for field in ("observation", "reward", "truncated"):
            np.testing.assert_array_equal(getattr(here, field), getattr(there, field))
            np.testing.assert_array_equal(getattr(here, field), getattr(further, field))
    np.testing.assert_equal(origin.infos(ALL), second.infos(ALL))
    assert not np.array_equal(first.released, origin.released)


def test_forks_share_traffic_and_begin_no_episodes():
    process = make(3, privacy=COUNTED)
    process.reset(ALL, generators(SEEDS))
    fork = process.fork()
    assert fork.traffic is process.traffic
    assert fork.release.traffic is process.traffic
    assert fork.release.task is process.release.task
    tables, shared = (p.boundary.shared for p in (process, fork))
    assert all(a is b for a, b in zip(tables, shared, strict=True))
    assert not np.shares_memory(fork.release.ledgers.paid, process.release.ledgers.paid)
    for forked in (fork, fork.fork()):
        with pytest.raises(RuntimeError, match="reset the process that it was made from"):
            forked.reset(ALL, generators(SEEDS))
    process.reset(ALL, generators(SEEDS))


def test_episodes_step_and_reset_on_their_own():
    mixed, whole = make(3), make(3)
    mixed.reset(ALL, generators(SEEDS))
    whole.reset(ALL, generators(SEEDS))
    actions = sampled(whole, 30)
    expected = [whole.step(ALL, step) for step in actions]
    # Episode 1 pauses for ten steps and catches up; episode 2 is begun again at step 20.
    for k, step in enumerate(actions[:20]):
        some = ALL if k < 10 else np.array([0, 2])
        mixed.step(some, step[some])
    for step in actions[10:20]:
        mixed.step(ALL[1:2], step[1:2])
    mixed.reset(ALL[2:], generators([99]))
    for k in range(20, 30):
        outcome = mixed.step(ALL, actions[k])
        np.testing.assert_array_equal(outcome.observation[:2], expected[k].observation[:2])
        np.testing.assert_array_equal(outcome.reward[:2], expected[k].reward[:2])
        assert (outcome.observation[2] != expected[k].observation[2]).any()


@pytest.mark.parametrize(
    "keywords",
    [
        {"preset": "short-highway", "horizon": 240},
        {
            "preset": "private-highway",
            "horizon": 120,
            "privacy": {"boundary_inputs": "private", "share": 0.3},
        },
    ],
    ids=["paper", "capped and private boundary"],
)
def test_residuals_are_the_noise_that_is_declared(keywords):
    """Released minus true over sigma: unit variance, uncorrelated over time and quantities."""
    process = make(1, estimator="random_walk", random_start=False, **keywords)
    residuals = []
    added = process.release.noise.added

    def spy(episodes, values, sigma, unit):
        released = added(episodes, values, sigma, unit)
        residuals.append((released - values)[0] / process.release.sigma)
        return released

    process.release.noise.added = spy
    for seed in range(4):
        process.reset(ALL[:1], generators([seed]))
        for action in sampled(process, process.config.horizon_steps):
            process.step(ALL[:1], action[:1])
    r = np.array(residuals)  # seconds, segments, quantities
    n = r.size
    assert n > 10_000
    for part in (r, r[..., 0], r[..., 1]):
        low, high = stats.chi2.interval(1 - 1e-4, part.size) / np.array(part.size)
        assert low < np.mean(part**2) < high
    bound = 4.0 / np.sqrt(n / 2)
    for lag in (1, 2, 5):
        assert abs(np.mean(r[lag:] * r[:-lag])) < bound
    assert abs(np.mean(r[..., 0] * r[..., 1])) < bound
    assert abs(np.mean(r[:, 1:] * r[:, :-1])) < bound


def test_released_values_are_kept_until_the_next_query():
    process = make(1)
    process.reset(ALL[:1], generators([4]))
    first = np.array([[1, 1, 0, 0, 0, 0]], dtype=np.int8)
    process.step(ALL[:1], first)
    kept = process.released[0].copy()
    assert (kept[:2] != 0).all()
    assert (kept[2:5] == 0).all()
    process.step(ALL[:1], np.roll(first, 2))
    np.testing.assert_array_equal(process.released[0, :2], kept[:2])
    assert process.age[0].tolist() == [1, 1, 0, 0, 62, 0]
    process.reset(ALL[:1], generators([4]))
    assert not process.released.any()


def test_a_step_from_t_predicts_with_t_and_measures_at_t_plus_one():
    process = make(1, random_start=False, horizon=240)
    process.reset(ALL[:1], generators([4]), {"traffic_seed": 1})
    seen = {}

    def predict(episodes, inputs):
        seen["inputs"] = inputs.copy()

    def added(episodes, values, *noise):
        seen["values"] = values.copy()
        return values

    process.estimator.predict = predict
    process.release.noise.added = added
    for t in range(100):
        process.step(ALL[:1], np.zeros((1, 6), dtype=np.int8))
        record = process.traffic.library.get(process.config.corridor, 1)
        expected = process.boundary.inputs(ALL[:1], np.array([1]), np.array([t]))
        np.testing.assert_array_equal(seen["inputs"], expected)
        np.testing.assert_allclose(seen["values"][0, :, 0], record.counts[t + 1, :8] / 0.1)


def test_a_diverging_filter_is_flagged_and_the_episode_goes_on():
    process = make(1)
    process.reset(ALL[:1], generators([4]))
    added = process.release.noise.added
    process.release.noise.added = lambda episodes, values, *noise: np.full_like(values, np.nan)
    outcome = process.step(ALL[:1], np.ones((1, 6), dtype=np.int8))
    assert process.info(0)["diverged"] == 1.0
    assert np.isfinite(process.estimate.density).all()
    process.release.noise.added = added
    outcome = process.step(ALL[:1], np.ones((1, 6), dtype=np.int8))
    assert process.info(0)["diverged"] == 0.0
    assert np.isfinite(outcome.reward).all()


@pytest.mark.parametrize(
    ("backend", "solver"),
    [("compiled", lying), ("compiled", silent), ("reference", lying), ("reference", missing)],
)
def test_a_step_that_is_not_solved_for_keeps_the_prediction_and_says_so(
    backend, solver, monkeypatch
):
    process, nobody = make(2, estimator="mhe", backend=backend), np.zeros((2, 6), dtype=np.int8)
    process.reset(ALL[:2], generators(SEEDS[:2]))
    for _ in range(12):
        process.step(ALL[:2], nobody)
    assert [process.info(e)["fallback"] for e in range(2)] == [0.0, 0.0]
    monkeypatch.setattr(qpsolvers, "solve_problem", solver)
    monkeypatch.setattr("dptse_env.estimators.mhe.update", unsolved)
    predicted, update = {}, process.estimator.update

    def spy(*given):
        predicted["density"] = process.estimator.estimate().density
        update(*given)

    process.estimator.update = spy
    for _ in range(3):
        outcome = process.step(ALL[:1], nobody[:1])
        np.testing.assert_array_equal(process.estimate.density[0], predicted["density"][0])
        assert [process.info(e)["fallback"] for e in range(2)] == [1.0, 0.0]
        assert process.info(0)["diverged"] == 0.0
        assert np.isfinite(outcome.reward).all()
    monkeypatch.undo()
    process.step(ALL[:1], nobody[:1])
    assert process.info(0)["fallback"] == 0.0
    assert (process.estimate.density[0] != predicted["density"][0]).any()
