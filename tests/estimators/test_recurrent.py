"""The recurrent network beside the one that is trained, and what it gives."""

import dataclasses
import warnings

import numpy as np
import pytest

from dptse_env.config import resolve
from dptse_env.estimators import Measurement
from dptse_env.estimators.recurrent import (
    member_for,
    read_weights,
    write_weights,
)
from dptse_env.estimators.recurrent_kernels import (
    LARGEST_CORRECTION,
    LARGEST_INNOVATION,
    LONGEST_AGE,
    LOWEST_SPREAD,
    make_cells,
)
from dptse_env.model import ARZModel, load_parameters
from dptse_env.traffic import PAPER_HIGHWAY
from tests.hostile import check_hostile, edited

from .helpers import card, random_weights, run, simulate, started, step, weights_settings

torch = pytest.importorskip("torch")

from agents.filters import network as trained  # noqa: E402


def of_weights(episodes, folder, weights=None, **ranges):
    """The estimator of weights that are written into a folder."""
    settings = weights_settings(folder, weights, **ranges)
    return started("recurrent", "compiled", episodes, settings)


# Beside the network that is trained ---------------------------------------------------------------


def features(model, measured, inputs, prior, age):
    """The features and innovations of one episode, as the module's docstring has them.

    All rows and cells are treated at once.

    Args:
        model: The model of the road.
        measured: Its measurement, of one episode.
        inputs: The model's inputs, shape (n_u,).
        prior: Predictions and deviations, shape (S, 4).
        age: Seconds since the last measurement of each cell, shape (S,).
    """
    cells, flows = make_cells(model), float(model.centre is not None)
    observed, values, sigma, centre = (part[0] for part in measured)
    H = model.averaging[observed]  # of densities; a channel averages over its cells
    covers, values, sigma = H > 0.0, values[observed], sigma[observed]
    rho, v, P_rho, P_v = *prior.T[:2], *prior.T[2:] ** 2
    slip = v - centre if flows else np.zeros(len(v))
    by_speed = rho if flows else np.ones(len(v))
    y = rho * slip if flows else v
    V_rho = H**2 @ P_rho + sigma[:, 0] ** 2
    V_y = H**2 @ (by_speed**2 * P_v + slip**2 * P_rho) + sigma[:, 1] ** 2
    e_rho, e_y = values[:, 0] - H @ rho, values[:, 1] - H @ y
    innovations = np.zeros((len(observed), 2))
    innovations[observed] = np.stack([e_rho / np.sqrt(V_rho), e_y / np.sqrt(V_y)], axis=-1)
    n, unit, limit = covers.sum(axis=0), cells.unit[: model.n_segments], cells.speed_unit
    queried = np.minimum(n, 1)
    log_sigma = np.log(np.clip(sigma, 0.1, 1e6)).T @ covers / np.maximum(n, 1)
    outside = np.zeros((2, len(v)))
    road = model.road
    outside[0, road.entries] = inputs[road.entry_inputs] / (2000.0 * road.lanes[road.entries])
    outside[1, road.exits] = inputs[road.exit_inputs] / cells.unit[road.exit_cells]

    def held(numbers, largest):
        return np.clip(numbers, -largest, largest)

    numbers = [
        queried, H.sum(axis=0), 0.2 * (log_sigma[0] - queried * np.log(unit)),
        0.2 * (log_sigma[1] - queried * (flows * np.log(unit) + np.log(limit))),
        rho / unit, v / limit, 0.25 * np.log(prior[:, 2] / unit),
        0.25 * np.log(prior[:, 3] / limit),
        0.5 * held(innovations[observed, 0] @ covers, LARGEST_INNOVATION),
        0.5 * held(innovations[observed, 1] @ covers, LARGEST_INNOVATION),
        4 * held(P_rho * (e_rho / V_rho @ H) / unit, LARGEST_CORRECTION),
        4 * held(slip * P_rho * (e_y / V_y @ H) / unit, LARGEST_CORRECTION),
        4 * held(by_speed * P_v * (e_y / V_y @ H) / limit, LARGEST_CORRECTION),
        np.minimum(P_rho * (1 / V_rho @ H**2), 1.0),
        np.minimum(by_speed**2 * P_v * (1 / V_y @ H**2), 1.0),
        slip / limit, np.full(len(v), flows), 0.25 * np.log(1.0 + np.minimum(age, LONGEST_AGE)),
        *outside, *cells.fixed.T,
        settled := np.maximum(model.parameters.free_flow_speed - model.pressure(rho), 0.0) / limit,
        np.full(len(v), own := float(model.parameters.name == "own")), own * settled,
    ]  # fmt: skip
    age[:] = np.where(n > 0, 0.0, age + 1.0)
    return np.stack(numbers, axis=-1), innovations


class Twin:
    """The network that is trained, in double precision, on the episodes of an estimator."""

    def __init__(self, estimator):
        self.model, n = estimator.model, estimator.n_episodes
        cells = make_cells(self.model)
        weights = estimator.saved.weights
        self.network = trained.RecurrentNetwork(weights.width)
        self.network.take(estimator.saved.weights)
        S = self.model.n_segments
        edges = self.model.road.edges + S * np.arange(n)[:, None, None]
        self.roads = trained.Roads(
            torch.from_numpy(np.tile(cells.unit[:S], n)),
            torch.full((n * S,), cells.speed_unit),
            torch.full((n * S,), cells.fastest),
            torch.from_numpy(edges.reshape(-1, 2)),
            torch.ones(n * S, 2),
            torch.ones(n * S),
            torch.arange(n).repeat_interleave(S),
            torch.ones(n),
            n,
        )
        said = estimator.estimate()
        self.ahead = np.stack([said.density, said.speed, said.density_std, said.speed_std], -1)
        self.hidden = torch.zeros(n * S, self.network.width)
        self.age = np.full(self.ahead.shape[:2], LONGEST_AGE)

    def step(self, inputs, given):
        """Return the estimates and deviations after a step, and before the next `(n, S, 4)`."""
        both = [
            features(self.model, [part[k : k + 1] for part in given], inputs[k], *prior)
            for k, prior in enumerate(zip(self.ahead, self.age, strict=True))
        ]
        x, self.innovations = (np.stack(each) for each in zip(*both, strict=True))
        with torch.no_grad():
            self.hidden = self.network(self.roads, torch.from_numpy(x).flatten(0, 1), self.hidden)
            present, ahead = self.network.read(self.roads, self.hidden)
        self.ahead = ahead.numpy().reshape(self.ahead.shape)
        return present.numpy().reshape(self.ahead.shape), self.ahead


@pytest.fixture
def _double():
    before, n_threads = torch.get_default_dtype(), torch.get_num_threads()
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    yield
    torch.set_default_dtype(before)
    torch.set_num_threads(n_threads)


@pytest.mark.usefixtures("_double")
@pytest.mark.parametrize(
    ("release", "width", "noise"), [("speed", 8, 1.0), ("flow", 20, 10.0), ("rows", 8, 1.0)]
)
def test_it_is_the_network_that_is_trained(release, width, noise, tmp_path):
    """Messages are all of the hidden state, or a part of it, in single precision.

    What is far off is held to a range.
    """
    episodes = simulate(n=3, n_steps=40, noise=noise, release=release)
    estimator = of_weights(episodes, tmp_path, random_weights(width))
    twin, far = Twin(estimator), []
    for k in range(40):
        step(estimator, episodes, k)
        given = Measurement.of(episodes.model, **episodes.released(k, episodes.everyone))
        present, ahead = twin.step(episodes.inputs[k], given)
        hidden = twin.hidden.reshape(estimator.hidden.shape)
        np.testing.assert_allclose(estimator.hidden, hidden, atol=2e-5)
        np.testing.assert_allclose(estimator.means, present[..., :2], rtol=1e-5, atol=1e-3)
        said = estimator.estimate()
        np.testing.assert_allclose(said.density_std, present[..., 2], rtol=1e-4)
        np.testing.assert_allclose(said.speed_std, present[..., 3], rtol=1e-4)
        # Both differ by what single precision leaves of the predictions.
        np.testing.assert_allclose(estimator.innovations, twin.innovations, rtol=1e-3, atol=1e-3)
        far.append(np.abs(twin.innovations).max())
    estimator.predict(episodes.everyone, episodes.inputs[0])
    np.testing.assert_allclose(estimator.means, ahead[..., :2], rtol=1e-5, atol=1e-3)
    assert np.abs(estimator.hidden).max() > 0.5
    assert not estimator.diverged.any()


# What it gives ------------------------------------------------------------------------------------


def test_deviations_and_estimates_stay_in_their_range(tmp_path):
    episodes = simulate(n_steps=30)
    weights = random_weights()
    weights = weights._replace(heads_bias=np.array([90, 90, -90, 90] * 2, dtype=np.float32))
    estimator = of_weights(episodes, tmp_path, weights)
    run(estimator, episodes, range(30))
    model = episodes.model
    estimate, unit = estimator.estimate(), make_cells(model).unit[: model.n_segments]
    np.testing.assert_allclose(estimate.density[0], 4.0 * unit)
    np.testing.assert_allclose(estimate.speed, 1.1 * model.road.limits.max())
    np.testing.assert_allclose(estimate.density_std[0], unit * np.exp(LOWEST_SPREAD))


def test_a_limit_that_nobody_drives_at_makes_no_difference_to_a_calibrated_road():
    own = dataclasses.replace(load_parameters("w99-3lane"), name="own")
    roads = [PAPER_HIGHWAY.replaced(speed_limit=limit).road for limit in (100.0, 150.0)]
    first, other = (make_cells(ARZModel(road, own)) for road in roads)
    jam = own.jam_density / own.lanes
    ordinary = own.free_flow_speed * (1.0 - (10.0 / jam) ** own.gamma)
    assert first.speed_unit == other.speed_unit == pytest.approx(ordinary)
    assert first.fastest == other.fastest == pytest.approx(1.4 * ordinary)
    np.testing.assert_array_equal(first.fixed, other.fixed)
    shipped = [make_cells(ARZModel(road, load_parameters("w99-3lane"))) for road in roads]
    assert [each.speed_unit for each in shipped] == [100.0, 150.0]


# Files of weights ---------------------------------------------------------------------------------


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "weights.safetensors"
    write_weights(path, random_weights(), card())
    return path


def test_what_is_written_is_read(path, tmp_path):
    saved = read_weights(str(path))
    for name, array in random_weights()._asdict().items():
        np.testing.assert_array_equal(getattr(saved.weights, name), array)
    assert {key: value for key, value in saved.card.items() if key != "sha256"} == card()
    write_weights(tmp_path / "again.safetensors", random_weights(), card())
    assert (tmp_path / "again.safetensors").read_bytes() == path.read_bytes()


def test_a_pair_is_found_by_the_name_it_shares(tmp_path):
    source = str(tmp_path / "pair")
    single = f"{source}-flows.safetensors"
    write_weights(single, random_weights(), card())
    assert member_for(source, flows=True) == single
    assert member_for(source, flows=False) == source  # refused by the one who reads it
    assert member_for(single, flows=True) == single
    assert member_for("highway", flows=True) == "highway-flows"
    assert member_for("highway", flows=False) == "highway-speeds"
    with pytest.raises(ValueError, match=r"must be .* highway-flows, .*, got 'nowhere'"):
        read_weights("nowhere")


OWN = dataclasses.asdict(load_parameters("w99-3lane")) | {"name": "mine"}
LONG, HIGHWAY = {"corridor": "long-highway"}, {"recurrent": {"weights": "highway"}}


@pytest.mark.parametrize(
    ("played", "weights"),
    [
        ({}, "highway"),
        ({"privacy": "corrected"}, "highway"),
        ({"penetration": 0.2}, "highway"),
        (LONG, "long-highway"),
        (LONG | {"privacy": "corrected"}, "roads"),
        ({"corridor": {"speed_limit": 100.0}}, "roads"),
        ({"corridor": {"speed_limit": 30.0}}, "roads"),
        ({"epsilon": 1000.0}, "roads"),
        ({"parameters": OWN}, "roads"),
        (
            {"epsilon": 1000.0, "estimator_settings": {"recurrent": {"weights": "highway"}}},
            "highway",
        ),
    ],
)
def test_the_weights_of_the_package_that_know_what_is_played_are_taken(played, weights):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        config = resolve("private-highway", {"estimator": "recurrent", **played})
    assert config.settings().recurrent.weights == weights


def test_damaged_files_are_refused(path, tmp_path):
    check_hostile(lambda path: read_weights(str(path)), path, tmp_path / "bad.safetensors")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c, a: a.update(heads=a["heads"][:, :7].copy()), "heads must be float32 of shape"),
        (lambda c, a: a.update(hidden=np.zeros((0, 0), "f4")), r"width must be in 1\.\.512, got 0"),
        (lambda c, a: a.update(hidden=np.array(1.0)), r"width must be in 1\.\.512, got 0"),
        (lambda c, a: c.update(format="recurrent-9"), "'recurrent-9', this version reads"),
        (lambda c, a: c.update(channels=["queried"]), "features of format"),
        (lambda c, a: c.update(ranges={"lanes": [1, "2"]}), "'lanes' must be two numbers"),
    ],
)
def test_other_content_is_refused(change, message, path):
    path.write_bytes(edited(path, change))
    with pytest.raises(ValueError, match=rf"\.safetensors is not a file of weights: .*{message}"):
        read_weights(str(path))
