"""Collecting, the network with gradients, and a training that is interrupted."""

import dataclasses

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from agents.environments import make_vector  # noqa: E402
from agents.filters.batches import draw_batch, make_batch  # noqa: E402
from agents.filters.collecting import collect  # noqa: E402
from agents.filters.plan import OWN, Round  # noqa: E402
from agents.filters.torch_network import RecurrentNetwork, second_loss  # noqa: E402
from agents.filters.training import FilterTraining  # noqa: E402
from agents.training.run_files import read_progress  # noqa: E402
from dptse_env.estimators.recurrent import read_network, write_network  # noqa: E402
from dptse_env.evaluation import evaluate  # noqa: E402
from tests.agents.elsewhere import Elsewhere  # noqa: E402
from tests.estimators.helpers import card  # noqa: E402

from .plans import PLAN, SHORT  # noqa: E402


class Seen:
    """A watcher that keeps what a function finds in every second, the reset first."""

    def __init__(self, look):
        self.look, self.values = look, []

    def begin(self, process):
        self.process = process
        return self

    def __call__(self):
        self.values.append(self.look(self.process))

    def rows(self):
        return [{}] * self.process.n_episodes


@pytest.fixture(autouse=True)
def _one_thread():
    torch.set_num_threads(1)


def test_the_network_with_gradients_is_the_estimator(tmp_path):
    """Torch makes of collected releases the estimates that the environment reported."""
    torch.manual_seed(0)
    network = RecurrentNetwork(5)
    with torch.no_grad():
        network.heads.normal_(0.0, 0.5)
    path = tmp_path / "network.safetensors"
    write_network(path, network.weights(), card())
    recurrent = {"weights": str(path), "outside": True}
    own = {"estimator": "recurrent", "estimator_settings": {"recurrent": recurrent}}
    for scenario in PLAN.scenarios(0):
        batch = make_batch([(collect(scenario, own, None), np.arange(2))])
        keywords = {**scenario.keywords, **own, "traffic_seeds": list(scenario.traffic_seeds)}
        env = make_vector(SHORT, 2, {**keywords, "action": "scores"})
        seen = Seen(lambda process: process.estimate)
        seeds, noise = scenario.traffic_seeds, scenario.noise_seed
        evaluate(env, scenario.schedule, seeds, noise, watchers=[seen.begin])
        state = network.begin(batch.start)
        for t, estimate in enumerate(seen.values[1:]):
            state = network(batch.road, batch.second(t), batch.outside[t], state)
            present = network.read(batch.road, state.hidden)[0].detach().numpy()
            np.testing.assert_allclose(present[..., 0], estimate.density, rtol=2e-4, atol=2e-3)
            np.testing.assert_allclose(present[..., 3], estimate.speed_std, rtol=2e-3)


def test_the_collected_truth_is_that_of_the_environment():
    scenario = PLAN.scenarios(0)[0]
    collected = collect(scenario, {"estimator": "ekf"}, None)
    corridor = collected.corridor
    assert collected.outside.shape == (corridor.duration, 2, corridor.n_segments, 2)
    keywords = {**scenario.keywords, "traffic_seeds": list(scenario.traffic_seeds)}
    env = make_vector(SHORT, 2, {**keywords, "estimator": "ekf", "action": "scores"})
    seen = Seen(lambda process: process.truth(np.arange(2)))
    evaluate(env, scenario.schedule, scenario.traffic_seeds, watchers=[seen.begin])
    np.testing.assert_allclose(collected.truth, np.array(seen.values[1:]), rtol=1e-6)


def test_the_loss_is_the_environments_error():
    collected = collect(PLAN.scenarios(0)[1], {"estimator": "random_walk"}, None)
    batch = make_batch([(collected, np.arange(2))])
    corridor = collected.corridor
    estimated = torch.cat([batch.truth, torch.ones_like(batch.truth)], -1)
    assert float(second_loss(batch.road, estimated, batch.truth, 0.0)) == pytest.approx(1e-4)
    off = estimated + torch.tensor([corridor.density_scale * 0.1, 0.0, 0.0, 0.0])
    occupied = (batch.truth[:, :, : corridor.n_mainline, 0] > 0).float()
    share = corridor.n_mainline / (corridor.n_mainline + occupied.sum(-1))
    expected = float((0.1 * share.sqrt()).mean())
    assert float(second_loss(batch.road, off, batch.truth, 0.0)) == pytest.approx(expected, 1e-3)
    honest = second_loss(batch.road, estimated, batch.truth, 1.0)
    wide = estimated * torch.tensor([1.0, 1.0, 50.0, 50.0])
    assert second_loss(batch.road, wide, batch.truth, 1.0) > honest


WHOLE = dataclasses.replace(PLAN, rounds=(Round("ekf", 1, 1), Round(OWN, 2, 3)))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A training to the end of `WHOLE`; leave it alone."""
    training = FilterTraining(WHOLE, tmp_path_factory.mktemp("whole"))
    training.run()
    return training


@pytest.mark.slow
def test_a_network_comes_out_the_same_wherever_scenarios_are_played(whole, tmp_path):
    training = FilterTraining(WHOLE, tmp_path, executor=Elsewhere())
    training.run()
    there = training.network.state_dict()
    assert all(torch.equal(there[key], value) for key, value in whole.network.state_dict().items())


def test_a_batch_mixes_the_scenarios_of_a_road():
    """Its episodes are those of the scenarios, with rows of sums padded where there are none."""
    singles, sums = (
        collect(scenario, {"estimator": "random_walk"}, None)
        for scenario in (mixed(("paper",), 0), mixed(("paced",), 1))
    )
    assert singles.rows.share.size < sums.rows.share.size
    batch = make_batch([(singles, np.array([1])), (sums, np.array([0, 1]))])
    assert batch.road.flows[:, 0].tolist() == [0.0, 1.0, 1.0]
    np.testing.assert_array_equal(batch.truth[:, 0], singles.truth[:, 1])
    np.testing.assert_array_equal(batch.released.values[:, 2], sums.released.values[:, 1])
    network = RecurrentNetwork(4)
    together = network.begin(batch.start)
    alone = [network.begin(make_batch([(each, np.arange(2))]).start) for each in (singles, sums)]
    for t in range(20):
        together = network(batch.road, batch.second(t), batch.outside[t], together)
        for k, each in enumerate((singles, sums)):
            part = make_batch([(each, np.arange(2))])
            alone[k] = network(part.road, part.second(t), part.outside[t], alone[k])
    hidden = torch.stack([alone[0].hidden[1], *alone[1].hidden])
    np.testing.assert_allclose(together.hidden.detach(), hidden.detach(), atol=1e-5)


def mixed(mechanisms, index):
    ranges = dataclasses.replace(PLAN.ranges, mechanisms=mechanisms, spans=((1, 2),))
    return dataclasses.replace(PLAN, ranges=ranges).scenarios(0)[index]


def test_batches_are_drawn_from_all_scenarios_of_a_road():
    collected = [collect(each, {"estimator": "random_walk"}, None) for each in PLAN.scenarios(0)]
    rng, seen = np.random.default_rng(0), set()
    starts = np.concatenate([each.truth.sum(axis=(0, 2, 3)) for each in collected])
    for _ in range(30):
        batch = draw_batch(rng, collected, 2)
        assert len(batch.start) == 2
        seen |= {
            int(np.argmin(np.abs(starts - float(each)))) for each in batch.truth.sum((0, 2, 3))
        }
    assert len(seen) > 2


class KilledError(Exception):
    pass


def rows_of(training):
    timed = {"seconds"}
    return [{k: v for k, v in row.items() if k not in timed} for row in training.rows]


@pytest.mark.slow
def test_a_training_that_was_killed_comes_out_as_one_that_was_not(whole, tmp_path):
    assert whole.done == 4
    assert [row["round"] for row in whole.rows] == [1, 2, 2, 2]

    def kill(row):
        if row["update"] == 3:
            raise KilledError

    with pytest.raises(KilledError):
        FilterTraining(WHOLE, tmp_path, watchers=[kill]).run()
    resumed = FilterTraining(WHOLE, tmp_path)
    assert resumed.done == 2
    resumed.run()
    assert rows_of(resumed) == rows_of(whole)
    one, other = (
        read_network(str(each / "network.safetensors")) for each in (whole.folder, tmp_path)
    )
    for name, array in one.network._asdict().items():
        np.testing.assert_array_equal(array, getattr(other.network, name))
    assert len(read_progress(tmp_path)) == 4
    again = FilterTraining(WHOLE, tmp_path)
    again.run()
    assert rows_of(again) == rows_of(whole)


def test_the_card_says_what_it_was_trained_on(tmp_path):
    training = FilterTraining(dataclasses.replace(PLAN, rounds=(Round("ekf", 1, 1),)), tmp_path)
    training.run()
    saved = read_network(str(tmp_path / "network.safetensors"))
    assert saved.card["ranges"]["span"] == [1.0, 2.0]
    assert saved.card["ranges"]["flows"] == [0.0, 1.0]
    assert saved.card["ranges"]["n_mainline"] == [6, 6]
    assert saved.card["training"]["plan"]["seed"] == 3
    assert saved.card["training"]["passes"] == 1


def test_a_folder_of_another_plan_is_refused(tmp_path):
    FilterTraining(PLAN, tmp_path)
    with pytest.raises(ValueError, match="seed"):
        FilterTraining(dataclasses.replace(PLAN, seed=4), tmp_path)


def test_a_training_may_begin_with_another_network(tmp_path):
    first = FilterTraining(dataclasses.replace(PLAN, rounds=(Round("ekf", 1, 1),)), tmp_path / "a")
    first.run()
    initial = str(tmp_path / "a" / "network.safetensors")
    plan = dataclasses.replace(PLAN, initial=initial, rounds=(Round(OWN, 1, 1),), seed=5)
    second = FilterTraining(plan, tmp_path / "b")
    for taken, given in zip(second.network.weights(), first.network.weights(), strict=True):
        np.testing.assert_array_equal(taken, given)
    second.run()
    assert not np.array_equal(second.network.weights().hidden, first.network.weights().hidden)
    card = read_network(str(tmp_path / "b" / "network.safetensors")).card
    assert card["training"]["plan"]["initial_sha256"] == read_network(initial).card["sha256"]
    with pytest.raises(ValueError, match="width must be that of the initial network, 4, got 8"):
        dataclasses.replace(plan, width=8)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"traffic_seeds": (1000,)}, r"traffic must be traffic seeds in 0\.\.999, got 1000"),
        ({"validation_seeds": (5,)}, r"validation must be traffic seeds in 1000\.\.1999, got 5"),
        ({"rounds": (Round(OWN, 1, 1),)}, "rounds must begin with one of another estimator"),
        ({"rounds": ()}, "rounds must begin"),
        ({"episodes": 4}, r"episodes must be an integer in 1\.\.3, got 4"),
        ({"width": 0}, "width must be"),
        ({"initial": "nowhere"}, r"weights must be a file or one of highway, .*, got 'nowhere'"),
        ({"likelihood": -1.0}, "likelihood must be"),
    ],
)
def test_bad_plans_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(PLAN, **changes)
