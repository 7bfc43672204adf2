"""Scenarios, what is collected of them, the network with gradients, and its training."""

import dataclasses
import hashlib
import json
from itertools import product

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from agents.environments import make_config, make_vector  # noqa: E402
from agents.filters.collecting import Batch, collect, draw_batch  # noqa: E402
from agents.filters.highways import KINDS, draw_highway  # noqa: E402
from agents.filters.network import RecurrentNetwork, second_loss, teacher_loss  # noqa: E402
from agents.filters.plan import OWN, FilterPlan, Round, played_by  # noqa: E402
from agents.filters.scenarios import (  # noqa: E402
    CONNECTED,
    MECHANISMS,
    ROADS,
    SCHEDULES,
    ScenarioRanges,
)
from agents.filters.sections import DEVIATIONS, Section  # noqa: E402
from agents.filters.training import WEIGHTS, FilterTraining  # noqa: E402
from agents.fitting.parameters import traffic_of  # noqa: E402
from dptse_env.estimators.recurrent import read_weights, write_weights  # noqa: E402
from dptse_env.estimators.recurrent_kernels import LONGEST_AGE  # noqa: E402
from dptse_env.evaluation import evaluate  # noqa: E402
from dptse_env.traffic import RecordLibrary, read_corridor  # noqa: E402
from tests.estimators.helpers import card, random_weights  # noqa: E402
from tests.helpers import SHORT  # noqa: E402

RANGES = ScenarioRanges(envs=(SHORT,), sections=0.0, connected=0.0, spans=((1,), (1, 2)))
PLAN = FilterPlan(
    kind="flows",
    seed=3,
    traffic_seeds=(0, 1, 2),
    validation_seeds=(1000, 1001),
    validation_envs=(SHORT,),
    validation_highways=(1000, 1000),
    ranges=RANGES,
    rounds=(Round("ekf", 1, 1), Round(OWN, 2, 3)),
    width=4,
    windows=2,
    episodes=2,
    seconds=240,
    checkpoint_every=2,
)
WALK = {"estimator": "random_walk"}


@pytest.fixture(autouse=True)
def _one_thread():
    torch.set_num_threads(1)


# Scenarios ----------------------------------------------------------------------------------------


def drawn(ranges=RANGES, n=60, seed=0, kind="flows", on_section=False):
    rng = np.random.default_rng(seed)
    return [ranges.draw(rng, kind, range(20), 4, 240, on_section) for _ in range(n)]


def test_scenarios_cover_their_ranges():
    scenarios = drawn(n=200)
    assert {each.policy for each in scenarios} == set(SCHEDULES)
    epsilons = np.array([each.keywords["privacy"]["epsilon"] for each in scenarios])
    assert 0.5 <= epsilons.min() < 0.7
    usual = epsilons[epsilons <= 20.0]
    assert usual.max() > 14.0
    assert 0.3 < np.mean(usual < np.sqrt(0.5 * 20.0)) < 0.7  # even in the logarithm
    assert 0.6 < len(usual) / len(epsilons) < 0.9
    assert 100.0 < sorted({*epsilons})[-2] <= 1000.0 < epsilons.max() == 1e4
    assert all(each.is_taught == (e <= 20.0) for each, e in zip(scenarios, epsilons, strict=True))
    bandwidths = [each.keywords["bandwidth"] for each in scenarios]
    assert set(bandwidths) == set(range(1, 7))
    assert bandwidths.count(1) > 2 * bandwidths.count(6)
    assert any("query_spans" in each.keywords for each in scenarios)
    assert all(len({*each.seeds} & {*range(20)}) == 4 for each in scenarios)
    few = drawn(dataclasses.replace(RANGES, connected=0.5))
    shares = [s for each in few if (s := each.keywords.get("penetration")) is not None]
    assert 15 < len(shares) < 45
    assert CONNECTED[0] <= min(shares) < max(shares) <= CONNECTED[1]
    on_sections = [each.section for each in drawn(n=40, on_section=True)]
    assert 0 < sum(each.misjudged != 1.0 for each in on_sections) < 40
    assert 0 < sum(each.calibrated for each in on_sections) < 40
    assert drawn(n=5) == drawn(n=5) != drawn(n=5, seed=1)
    for kind, mechanisms in MECHANISMS.items():
        presets = {each.keywords["privacy"]["preset"] for each in drawn(kind=kind)}
        assert presets == set(mechanisms)


@pytest.mark.filterwarnings("ignore:.*values measured or tuned on")
@pytest.mark.filterwarnings("ignore:.* yet no privacy is guaranteed")
def test_every_scenario_is_an_environment_and_every_road_another_one():
    digests = set()
    for env, kind in product(ROADS, MECHANISMS):
        for scenario in drawn(dataclasses.replace(RANGES, envs=(env,)), n=2, kind=kind):
            config = make_config(scenario.env, scenario.keywords)
            assert config.bandwidth <= config.corridor.geometry.n_mainline
            assert config.horizon == 240
            digests.add(config.corridor.digest)
    assert len(digests) == len(ROADS)


# Sections -----------------------------------------------------------------------------------------


def test_highways_are_those_that_weights_were_trained_on_and_rows_were_played_on():
    digest = hashlib.sha256()
    for kind, number in product(KINDS, range(40)):
        highway = draw_highway(number, kind)
        digest.update(f"{highway.corridor.digest} {highway.limit}".encode())
    assert digest.hexdigest()[:16] == "4d1556bbe5d24708"


@pytest.fixture(scope="module")
def night():
    """A highway that is quick to simulate, with both kinds of ramps."""
    return next(
        number
        for number in range(1000)
        if draw_highway(number).corridor.geometry.on_ramps
        and draw_highway(number).corridor.geometry.off_ramps
        and draw_highway(number).corridor.conditions.published_demand.mainline[0][1] < 1000.0
    )


def test_speeds_settle_where_those_of_a_highway_are(night):
    library, highway = RecordLibrary(), draw_highway(night).corridor
    density, speed = traffic_of(highway, [0], library)
    off = []
    for seed in range(12):
        fitted = Section(night, 5, 2, 100, seed=seed, calibrated=True).parameters(library)
        per_lane = fitted.jam_density / fitted.lanes
        settled = fitted.free_flow_speed * (1.0 - (density / per_lane) ** fitted.gamma)
        inside = (density > 0.0) & (density < 0.5 * per_lane)
        off.append(np.log(np.median(settled[inside]) / np.median(speed[inside])))
    mean, usual, largest = DEVIATIONS
    assert abs(np.mean(off) - mean) < usual
    assert np.max(np.abs(off)) < 3.0 * largest


@pytest.mark.parametrize("averaged", [0, 5])
def test_a_section_has_the_vehicles_of_its_highway(night, averaged, tmp_path):
    library, highway = RecordLibrary(), draw_highway(night).corridor
    section = Section(night, highway.geometry.n_mainline - 2, 2, 100, averaged=averaged, seed=1)
    road = read_corridor(section.write(tmp_path, library))
    assert road.geometry.on_ramps == tuple(face - 1 for face in highway.geometry.on_ramps)
    assert road.conditions.published_demand.mainline[0][1] > 0.0
    start = json.loads((tmp_path / "manifest.json").read_text())["sources"][1]["start"]
    whole, cut = library.get(highway, 0), library.get(road, 1)
    n, times = road.geometry.n_mainline, slice(start, start + 101)
    counts = np.concatenate(
        [
            whole.counts[times, 1 : n + 1],
            whole.counts[times, highway.geometry.n_mainline : highway.geometry.n_segments],
            whole.counts[times, [0, n + 1]],
            whole.counts[times, highway.geometry.n_segments + 2 :],
        ],
        axis=1,
    )
    if not averaged:
        np.testing.assert_array_equal(cut.counts, counts)
        return
    lengths = road.road.lengths
    around = np.stack([counts[k - 2 : k + 3].mean(axis=0) for k in range(2, 99)])
    np.testing.assert_allclose(cut.field[2:-2, :, 0], around / lengths, atol=1e-9)


# Episodes -----------------------------------------------------------------------------------------


class Seen:
    """A watcher that keeps estimate and truth of every second, the reset first."""

    def __init__(self):
        self.estimates, self.truth = [], []

    def begin(self, process):
        self.process = process
        return self

    def __call__(self):
        self.estimates.append(self.process.estimate)
        self.truth.append(self.process.truth(np.arange(self.process.n_episodes)))

    def rows(self):
        return [{}] * self.process.n_episodes


def steps(network, batch, n):
    """Yield hidden states and the estimates of the second, for `n` seconds."""
    age, predicted = np.full(len(batch.start), LONGEST_AGE), batch.start
    hidden = torch.zeros(len(age), network.width)
    for t in range(n):
        with torch.no_grad():
            hidden = network(batch.roads, batch.features(t, predicted, age), hidden)
            present, ahead = network.read(batch.roads, hidden)
        predicted = ahead.numpy().astype(float)
        yield hidden.numpy(), present.numpy()


def mixed(mechanism, env=SHORT):
    """Return a scenario with a release model."""
    kind = next(kind for kind, known in MECHANISMS.items() if mechanism in known)
    # One that does not draw at random: two evaluations draw other numbers.
    ranges = dataclasses.replace(
        PLAN.ranges, envs=(env,), spans=((1, 2),), schedules=("oldest-first",)
    )
    plan = dataclasses.replace(PLAN, kind=kind, ranges=ranges, rounds=(Round("ekf", 20, 1),))
    return next(
        each
        for each in plan.scenarios(0)
        if each.keywords["privacy"]["epsilon"] <= 20.0
        and each.keywords["privacy"]["preset"] == mechanism
    )


@pytest.mark.parametrize("mechanism", ["printed", "paced"])
def test_the_network_with_gradients_is_the_estimator(mechanism, tmp_path):
    """Torch makes of collected releases the estimates that the environment reported."""
    torch.manual_seed(0)
    network = RecurrentNetwork(5)
    with torch.no_grad():
        network.heads.normal_(0.0, 0.5)
    write_weights(tmp_path / "weights.safetensors", network.weights(), card())
    own, scenario = played_by(tmp_path / "weights.safetensors"), mixed(mechanism)
    collected = collect(scenario, own, None)
    keywords = {**scenario.keywords, **own, "traffic_seeds": list(scenario.seeds)}
    env, seen = make_vector(SHORT, 2, {**keywords, "action": "scores"}), Seen()
    seeds, noise = scenario.seeds, scenario.noise_seed
    evaluate(env, scenario.policy, seeds, noise, watchers=[seen.begin])
    batch, T = Batch([collected.pick(np.arange(2))]), collected.corridor.conditions.duration
    for (_, present), estimate in zip(steps(network, batch, T), seen.estimates[1:], strict=True):
        said = present.reshape(*estimate.density.shape, 4)
        np.testing.assert_allclose(said[..., 0], estimate.density, rtol=2e-4, atol=2e-3)
        np.testing.assert_allclose(said[..., 3], estimate.speed_std, rtol=2e-3)
    np.testing.assert_allclose(collected.truth, np.array(seen.truth[1:]), rtol=1e-6)


LONGER = f'{SHORT} {{"corridor": {{"n_mainline": 9}}}}'


@pytest.mark.filterwarnings("ignore:.*values measured or tuned on")
def test_a_batch_mixes_scenarios_of_any_roads():
    """Releases of speeds and of flows, of single cells and of sums, on two roads."""
    singles, sums = (
        collect(mixed("printed"), WALK, None),
        collect(mixed("paced", LONGER), WALK, None),
    )
    assert len(singles.cells.fixed) + 3 == len(sums.cells.fixed)
    batch = Batch([singles.pick(np.array([1])), sums.pick(np.array([0, 1]))])
    n = len(singles.cells.fixed)
    np.testing.assert_array_equal(batch.truth[:, :n], singles.truth[:, 1])
    network = RecurrentNetwork(4)
    alone = [
        steps(network, Batch([each.pick(chosen)]), 20)
        for each, chosen in ((singles, np.array([1])), (sums, np.arange(2)))
    ]
    for (together, _), (one, _), (two, _) in zip(steps(network, batch, 20), *alone, strict=True):
        np.testing.assert_allclose(together, np.concatenate([one, two]), atol=1e-5)


def test_the_loss_is_the_environments_error():
    """The mean over episodes, however many cells they have."""
    collected = collect(mixed("paced"), WALK, None)
    batch, corridor = Batch([collected.pick(np.arange(2))]), collected.corridor
    roads, truth = batch.roads, batch.truth
    estimated = torch.cat([truth, torch.ones_like(truth)], -1)
    assert float(second_loss(roads, estimated, truth, 0.0)) == pytest.approx(1e-4)
    off = estimated + torch.tensor([corridor.scales.density_scale * 0.1, 0.0, 0.0, 0.0])
    by_episode = truth.reshape(len(truth), 2, -1, 2)
    occupied = (by_episode[:, :, : corridor.geometry.n_mainline, 0] > 0).float()
    share = corridor.geometry.n_mainline / (corridor.geometry.n_mainline + occupied.sum(-1))
    expected = float((0.1 * share.sqrt()).mean())
    assert float(second_loss(roads, off, truth, 0.0)) == pytest.approx(expected, 1e-3)
    wide = estimated * torch.tensor([1.0, 1.0, 50.0, 50.0])
    assert second_loss(roads, wide, truth, 1.0) > second_loss(roads, estimated, truth, 1.0)


def test_a_teacher_is_heard_where_it_knows_roads_and_noise_alone(night):
    ranges = dataclasses.replace(RANGES, highways=(night, night + 1), free=0.0)
    (on_section,) = drawn(ranges, n=1, on_section=True)
    parts = [collect(on_section, WALK, None), collect(mixed("paced"), WALK, None)]
    batch = draw_batch(np.random.default_rng(1), parts, 6)
    ordinary, n = batch.taught, int(batch.roads.taught.sum())
    assert 0 < n == ordinary.roads.n_episodes < 6
    assert batch.roads.taught.tolist() == [1.0] * n + [0.0] * (6 - n)
    np.testing.assert_array_equal(batch.truth[:, : len(ordinary.start)], ordinary.truth)
    assert Batch([parts[0].pick(np.arange(2))]).taught is None
    assert all(each.truth.shape[0] == 240 for each in parts)
    said = torch.cat([ordinary.truth, torch.ones_like(ordinary.truth)], -1)
    assert float(teacher_loss(ordinary.roads, said, said)) == 0.0
    wide = said * torch.tensor([1.0, 1.0, np.e**2, 1.0])
    assert float(teacher_loss(ordinary.roads, wide, said)) == pytest.approx(0.12)
    scales = torch.cat([ordinary.roads.scales, torch.zeros_like(ordinary.roads.scales)], -1)
    assert float(teacher_loss(ordinary.roads, said + 0.1 * scales, said)) == pytest.approx(0.2)


@pytest.mark.parametrize(("n_mainline", "knows"), [([6, 15], True), ([15, 15], False)])
def test_a_teacher_is_heard_on_roads_of_its_card(n_mainline, knows, tmp_path):
    source = tmp_path / "teacher.safetensors"
    write_weights(source, random_weights(8), card(n_mainline=n_mainline, flows=[1, 1]))
    rounds = (Round("random_walk", 4, 1),)
    plan = dataclasses.replace(PLAN, teacher=0.5, teacher_weights=str(source), rounds=rounds)
    training = FilterTraining(plan, tmp_path / "a")
    assert any(each.is_taught for each in training.collect(0)) == knows
    training.run()  # with a teacher of another width


# Training -----------------------------------------------------------------------------------------


def test_a_training_may_begin_with_other_weights_and_says_so_on_the_card(tmp_path):
    path = tmp_path / "a" / "weights.safetensors"
    first = FilterTraining(dataclasses.replace(PLAN, rounds=(Round("ekf", 1, 1),)), path.parent)
    first.run()
    given = read_weights(str(path))
    ranges = given.card["ranges"]
    found = [ranges[name] for name in ("span", "flows", "n_mainline")]
    assert found == [[1.0, 2.0], [1.0, 1.0], [6, 6]]
    plan = dataclasses.replace(
        PLAN, initial=str(path), teacher=0.5, rounds=(Round(OWN, 1, 1),), seed=5
    )
    second = FilterTraining(plan, tmp_path / "b")
    for taken, own in zip(second.network.weights(), given.weights, strict=True):
        np.testing.assert_array_equal(taken, own)
    second.run()
    last, kept = second.network.weights(), read_weights(str(second.folder / WEIGHTS))
    # A moving average, which lags behind.
    near, far = (np.abs(kept.weights.hidden - e.hidden).max() for e in (given.weights, last))
    assert 0.0 < near < far
    about = kept.card["training"]
    assert (about["plan"]["seed"], about["passes"]) == (5, 1)
    assert about["plan"]["initial_sha256"] == given.card["sha256"]
    with pytest.raises(ValueError, match="width must be that of the initial weights, 4, got 8"):
        dataclasses.replace(plan, width=8)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rounds": (Round(OWN, 1, 1),)}, "rounds must begin with one of another estimator"),
        ({"rounds": ()}, "rounds must begin"),
        ({"rounds": (Round("kalman", 1, 1),)}, "kalman"),
        ({"windows": 4}, r"windows must be .* 1\.\.3, got 4"),
        ({"teacher": 0.5}, "teacher must be 0 without .* 0.5"),
        ({"validation_seeds": (5,)}, r"validation_seeds must be .* 1000\.\.1999, got 5"),
        ({"validation_highways": (5, 9)}, r"validation_highways must be .* outside of \(0, 64\)"),
        ({"validation_envs": (f'{SHORT} {{"bandwidth": 99}}',)}, "bandwidth"),
        ({"ranges": dataclasses.replace(RANGES, schedules=("best",))}, "best"),
    ],
)
def test_bad_plans_are_named_before_the_first_episode(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(PLAN, **changes).check()
