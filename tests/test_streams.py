"""An episode follows its seed alone, whatever was before it, and its score the record's second."""

import copy

import numpy as np
import pytest

from dptse_env.config import resolve
from dptse_env.process import QueryProcess, draw_traffic
from dptse_env.release.noise import grid_of
from dptse_env.traffic import RecordLibrary
from tests.helpers import SumRelease, assert_same, make_batch, make_env, play

TWO = np.arange(2)
EVERYWHERE = {"traffic_seed": 0, "start": 0}


def begin(seeds, options, **keywords):
    """Return a process with two episodes."""
    every = {"bandwidth": 6, "traffic_seeds": "0:2", "horizon": 80, "random_start": True}
    process = QueryProcess(resolve("short-plain", {**every, **keywords}), 2)
    process.reset(TWO, [np.random.default_rng(seed) for seed in seeds], options)
    return process


def noise(process, queried=range(6)):
    """Return the noise of some segments over 80 steps, (80, 2, queried, 2)."""
    actions = np.tile(np.isin(np.arange(6), queried).astype(np.int8), (2, 1))
    found = []
    for _ in range(80):
        process.step(TWO, actions)
        found.append((process.released - process.truth(TWO))[:, queried])
    return np.array(found)


def grid(process):
    """Spacing of the grid of both released quantities."""
    return np.array([grid_of(sigma) for sigma in process.release.sigma.tolist()])


def test_two_seeds_share_no_noise_on_one_record():
    process = begin((1, 2), EVERYWHERE)
    first, second = np.moveaxis(noise(process), 1, 0)
    assert (np.abs(first - second) > grid(process)).mean() > 0.99
    for component in (0, 1):
        pair = first[..., component].ravel(), second[..., component].ravel()
        assert abs(np.corrcoef(*pair)[0, 1]) < 0.2


def test_the_next_episode_of_a_sequence_shares_no_noise_with_the_last_on_one_record():
    process, generators = begin((0, 0), EVERYWHERE), [np.random.default_rng(k) for k in (1, 2)]
    played = []
    for _ in range(2):
        process.reset(TWO, generators, EVERYWHERE)
        played.append(noise(process))
    assert (np.abs(played[0] - played[1]) > grid(process)).mean() > 0.99


@pytest.mark.parametrize(
    "options", [{"traffic_seed": [0, 1], "start": 0}, {"traffic_seed": 0, "start": [0, 100]}]
)
def test_one_seed_has_one_noise_on_any_traffic(options):
    process = begin((1, 1), options)
    first, second = np.moveaxis(noise(process), 1, 0)
    assert not np.array_equal(first, second)
    # Sums are rounded to the grid, so their noise agrees to half its spacing on either side.
    assert (np.abs(first - second) <= 1.001 * grid(process)).all()


@pytest.mark.parametrize("estimator", ["enkf", "random_walk"])
def test_the_noise_depends_neither_on_the_estimator_nor_on_what_is_queried(estimator):
    expected = noise(begin((1, 2), EVERYWHERE, estimator="ekf"))
    found = noise(begin((1, 2), EVERYWHERE, estimator=estimator), queried=[1, 4])
    np.testing.assert_array_equal(found, expected[:, :, [1, 4]])


PARTLY = {"penetration": 0.3, "sensor_settings": {"dropout": 0.2, "absolute": 0.5}}


@pytest.mark.parametrize(
    ("estimator", "privacy", "keywords"),
    [
        ("ekf", {"preset": "paced", "boundary_inputs": "private"}, {}),
        ("mhe", {"preset": "capped", "cap": 5, "boundary_inputs": "private"}, {}),
        ("recurrent", "paced", PARTLY),
        ("blend", "printed", PARTLY),
    ],
)
def test_an_episode_is_as_in_a_fresh_environment(estimator, privacy, keywords):
    """No ledger, stream, release, innovation or price of an episode outlasts a reset."""
    keywords = {"estimator": estimator, "privacy": privacy, "horizon": 40, **keywords}
    fresh, used = (make_env(random_start=True, truth_in_info=True, **keywords) for _ in range(2))
    for seed in (8, 9):
        play(used, 25, seed)
    assert_same(play(used, 40), play(fresh, 40))


@pytest.mark.parametrize("start", [0, 17])
def test_an_episode_is_scored_against_the_record_at_its_second(start):
    process = begin((5, 6), {"traffic_seed": 1, "start": start}, reward="density")
    corridor, n = process.config.corridor, 6
    record, reward = RecordLibrary().get(corridor, 1), None
    for k in range(60):
        density = record.counts[start + k, :n] / corridor.geometry.segment_length
        error = np.sqrt(np.mean((process.estimate.density[:, :n] - density) ** 2, axis=1))
        np.testing.assert_allclose(process.infos(TWO)["rmse_density"], error, rtol=1e-12)
        if reward is not None:
            np.testing.assert_allclose(reward, -error / corridor.scales.density_scale, rtol=1e-12)
        reward = process.step(TWO, np.ones((2, 6), dtype=np.int8)).reward


def test_traffic_noise_estimator_and_sensors_have_streams_of_their_own(monkeypatch):
    """Four children of one seed of 128 bits, which no other episode shares."""
    given = []

    def spied(reset):
        return lambda episodes, *rest: (given.append(rest[-1]), reset(episodes, *rest))[1]

    def spied_draw(fixed, config, generators):
        given.append(generators)
        return draw_traffic(fixed, config, generators)

    monkeypatch.setattr("dptse_env.process.draw_traffic", spied_draw)
    process = begin((0, 0), EVERYWHERE, sensor_settings={"dropout": 0.1}, estimator="enkf")
    for part in (process.sensor_errors, process.release, process.estimator):
        monkeypatch.setattr(part, "reset", spied(part.reset))
    given.clear()
    process.reset(TWO, [np.random.default_rng(seed) for seed in (1, 2)], EVERYWHERE)
    traffic, sensors, noise, estimator = given
    for episode in (0, 1):
        streams = [each[episode] for each in (traffic, noise, estimator, sensors)]
        seeds = [stream.bit_generator.seed_seq for stream in streams]
        assert [seed.spawn_key for seed in seeds] == [(k,) for k in range(4)]
        assert len({tuple(seed.entropy) for seed in seeds}) == 1
        assert len(seeds[0].entropy) == 4
        assert max(seeds[0].entropy) >= 2**30  # words of 32 bits
    entropies = [each.bit_generator.seed_seq.entropy for each in noise]
    assert entropies[0] != entropies[1]


@pytest.mark.parametrize("preset", ["paced", "capped"])
def test_secure_noise_takes_no_seed_and_has_no_forks(preset):
    privacy = {"preset": preset, "noise": "secure"}
    played = [noise(begin((1, 2), EVERYWHERE, privacy=privacy)) for _ in range(2)]
    assert (played[0] != played[1]).mean() > 0.99
    process = begin((1, 2), EVERYWHERE, privacy=privacy)
    assert process.privacy()["noise"] == "secure"
    assert "seed" not in process.privacy()["guarantee"]
    with pytest.raises(RuntimeError, match=r"privacy\.noise is 'secure'"):
        process.fork()
    with pytest.raises(ValueError, match=r"^privacy\.noise must be 'seeded' with"):
        begin((1, 2), EVERYWHERE, privacy={"preset": SumRelease, "noise": "secure"})


@pytest.mark.parametrize("preset", ["paced", "capped"])
def test_a_copy_with_secure_noise_must_begin_new_episodes(preset):
    """Otherwise its vehicles would pay once in the copy and once in its origin."""
    env = make_batch(privacy={"preset": preset, "noise": "secure"}, estimator="random_walk")
    actions, unused = np.ones((3, 6), dtype=np.int8), copy.deepcopy(env)
    for each in (env, unused):
        each.reset(seed=0)
        each.step(actions)
    twin, released = copy.deepcopy(env), []
    with pytest.raises(RuntimeError, match=r"^episode 0 must be reset"):
        twin.step(actions)
    twin.reset(options={"reset_mask": np.array([True, True, False])})
    with pytest.raises(RuntimeError, match=r"^episode 2 must be reset"):
        twin.step(actions)
    for each in (env, twin):
        each.reset(seed=0)
        each.step(actions)
        released.append(each.process.released[:, :2])
    assert (released[0] != released[1]).mean() > 0.99
