"""The recurrent network beside the one that is trained, and what it gives."""

import hashlib

import numpy as np
import pytest

from dptse_env.estimators import Measurement
from dptse_env.estimators.recurrent import (
    member_for,
    read_network,
    shipped_networks,
    write_network,
)
from dptse_env.estimators.recurrent_kernels import LARGEST_INNOVATION, LOWEST_SPREAD
from tests.hostile import check_hostile, edited

from .helpers import card, network_settings, random_network, run, simulate, started, step, update

torch = pytest.importorskip("torch")

from agents.filters import collecting, torch_network  # noqa: E402


def of_network(episodes, folder, network=None, **ranges):
    """The estimator of a network that is written into a folder."""
    settings = network_settings(folder, network, **ranges)
    return started("recurrent", "compiled", episodes, settings)


# Beside the network that is trained ---------------------------------------------------------------


class Twin:
    """The network that is trained, in double precision, on the episodes of an estimator."""

    def __init__(self, estimator):
        self.model, self.cells, n = estimator.model, estimator.cells, estimator.n_episodes
        self.network = torch_network.RecurrentNetwork(estimator.saved.network.width)
        self.network.take(estimator.saved.network)
        upstream = torch.zeros(2 * (self.model.n_segments,))
        upstream[self.cells.edges[:, 1], self.cells.edges[:, 0]] = 1.0
        rows = collecting.make_rows(self.model.rows)
        self.road = torch_network.Road(
            unit=torch.from_numpy(self.cells.unit),
            limit=self.cells.limit,
            flows=torch.full((n, 1), float(self.cells.flows)),
            fixed=torch.from_numpy(self.cells.fixed).expand(n, -1, -1),
            rows=collecting.Rows(*(torch.from_numpy(part).expand(n, *part.shape) for part in rows)),
            upstream=upstream,
            scales=(1.0, 1.0),
            n_mainline=self.model.network.n_mainline,
        )
        said = estimator.estimate()
        start = [said.density, said.speed, said.density_std, said.speed_std]
        self.state = self.network.begin(torch.from_numpy(np.stack(start, -1)))

    def step(self, inputs, given):
        """Return the estimates and deviations after a step, and before the next `(n, S, 4)`."""
        tensors = (torch.from_numpy(part) for part in collecting.make_released(given))
        outside = torch.from_numpy(collecting.input_channels(self.cells, inputs))
        released = collecting.Released(*tensors)
        with torch.no_grad():
            self.state = self.network(self.road, released, outside, self.state)
            tables = self.network.read(self.road, self.state.hidden)
        return [table.numpy() for table in tables]


@pytest.fixture
def _double():
    before, n_threads = torch.get_default_dtype(), torch.get_num_threads()
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    yield
    torch.set_default_dtype(before)
    torch.set_num_threads(n_threads)


def innovations_of(model, prior, given):
    """Those of a Kalman filter that takes all errors of a prediction as independent."""
    rho, v, rho_std, v_std = prior
    second, variance = v, v_std**2
    if model.reference_speed is not None:
        slip = v - given.centre
        second, variance = rho * slip, (rho * v_std) ** 2 + (slip * rho_std) ** 2
    weights, found = model.rows.weights, np.zeros(given.values.shape)
    for q, (mean, spread) in enumerate(((rho, rho_std**2), (second, variance))):
        total = spread @ np.square(weights).T + given.sigma[..., q] ** 2
        found[..., q] = (given.values[..., q] - mean @ weights.T) / np.sqrt(total)
    return np.where(given.observed[..., None], found, 0.0)


@pytest.mark.usefixtures("_double")
@pytest.mark.parametrize(
    ("release", "width", "noise"), [("speed", 8, 1.0), ("flow", 20, 10.0), ("rows", 8, 1.0)]
)
def test_it_is_the_network_that_is_trained(release, width, noise, tmp_path):
    """Messages are all of the hidden state, or a part of it, in single precision.

    What is far off is held to a range.
    """
    episodes = simulate(n=3, n_steps=40, noise=noise, release=release)
    estimator = of_network(episodes, tmp_path, random_network(width))
    twin, far = Twin(estimator), []
    for k in range(40):
        estimator.predict(episodes.everyone, episodes.inputs[k])
        prior = estimator.estimate()
        update(estimator, episodes, k)
        given = Measurement.of(episodes.model, **episodes.released(k, episodes.everyone))
        present, ahead = twin.step(episodes.inputs[k], given)
        np.testing.assert_allclose(estimator.hidden, twin.state.hidden, atol=1e-5)
        np.testing.assert_allclose(estimator.means, present[..., :2], rtol=1e-5, atol=1e-3)
        said = estimator.estimate()
        np.testing.assert_allclose(said.density_std, present[..., 2], rtol=1e-4)
        np.testing.assert_allclose(said.speed_std, present[..., 3], rtol=1e-4)
        expected = innovations_of(episodes.model, prior, given)
        np.testing.assert_allclose(estimator.innovations, expected, rtol=1e-9)
        far.append(np.abs(expected).max())
    assert max(far) > LARGEST_INNOVATION or noise == 1.0
    estimator.predict(episodes.everyone, episodes.inputs[0])
    np.testing.assert_allclose(estimator.means, ahead[..., :2], rtol=1e-5, atol=1e-3)
    assert np.abs(estimator.hidden).max() > 0.5
    assert not estimator.diverged.any()


# What it gives ------------------------------------------------------------------------------------


def test_news_travel_from_cell_to_cell(tmp_path):
    """One cell a second, in both directions and along ramps."""
    episodes = simulate(n_steps=1)
    pair = [of_network(episodes, tmp_path) for _ in range(2)]
    n = episodes.model.n_segments
    sparsity = np.eye(n, dtype=bool)
    for start, end in episodes.model.layout.edges:
        sparsity[start, end] = sparsity[end, start] = True
    observed = np.zeros_like(episodes.observed[0])
    reached = np.arange(n) == 8
    for second in range(4):
        observed[0, 8] = second == 0
        for estimator, shift in zip(pair, (0.0, 30.0), strict=True):
            step(estimator, episodes, 0, observed=observed, values=episodes.values[0] + shift)
        a, b = (estimator.estimate().density[0] for estimator in pair)
        np.testing.assert_array_equal(np.abs(a - b) > 1e-9, reached)
        reached = sparsity @ reached


def test_deviations_and_estimates_stay_in_their_range(tmp_path):
    episodes = simulate(n_steps=30)
    network = random_network()
    network = network._replace(heads_bias=np.array([90, 90, -90, 90] * 2, dtype=np.float32))
    estimator = of_network(episodes, tmp_path, network)
    run(estimator, episodes, range(30))
    estimate, unit = estimator.estimate(), estimator.cells.unit
    np.testing.assert_allclose(estimate.density[0], 4.0 * unit)
    np.testing.assert_allclose(estimate.speed, 1.1 * episodes.model.network.speed_limit)
    np.testing.assert_allclose(estimate.density_std[0], unit * np.exp(LOWEST_SPREAD))


def test_a_road_outside_of_the_card_is_refused_unless_asked(tmp_path):
    episodes, rows = simulate(n_steps=1), simulate(n_steps=1, release="rows")
    for given, ranges, message in (
        (episodes, {"n_mainline": [3, 9]}, r"trained on n_mainline in \[3, 9\].* has \[15, 15\]"),
        (rows, {"span": [1, 2]}, r"trained on span in \[1, 2\], .* has \[1, 3\]"),
        (episodes, {"flows": [1, 1]}, r"trained on flows in \[1, 1\]"),
    ):
        with pytest.raises(ValueError, match=message):
            of_network(given, tmp_path, **ranges)
        of_network(given, tmp_path, outside=True, **ranges)


# Files of networks --------------------------------------------------------------------------------

DIGESTS = {
    "highway-flows": ("a7cd6a7d0da0", "463df28b4d90"),
    "highway-speeds": ("98c08e7ad753", "2bb2c4ca118a"),
    "long-highway-flows": ("0718f2eebe91", "af13a07e0dc6"),
}
"""The first digits of the digests of the files before they were converted, and of their weights."""


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "network.safetensors"
    write_network(path, random_network(), card())
    return path


def test_what_is_written_is_read(path, tmp_path):
    saved = read_network(str(path))
    for name, array in random_network()._asdict().items():
        np.testing.assert_array_equal(getattr(saved.network, name), array)
    assert {key: value for key, value in saved.card.items() if key != "sha256"} == card()
    write_network(tmp_path / "again.safetensors", random_network(), card())
    assert (tmp_path / "again.safetensors").read_bytes() == path.read_bytes()


def test_the_weights_that_ship_are_those_that_were_recorded():
    digests = {}
    for name in shipped_networks():
        saved, content = read_network(name), hashlib.sha256()
        for array in saved.network:
            content.update(array.tobytes())
        digests[name] = saved.card["converted_from"][:12], content.hexdigest()[:12]
    assert digests == DIGESTS


def test_a_pair_is_found_by_the_name_it_shares(tmp_path):
    source = str(tmp_path / "pair")
    single = f"{source}-flows.safetensors"
    write_network(single, random_network(), card())
    assert member_for(source, flows=True) == single
    assert member_for(source, flows=False) == source  # refused by the one who reads it
    assert member_for(single, flows=True) == single
    assert member_for("highway", flows=True) == "highway-flows"
    assert member_for("highway", flows=False) == "highway-speeds"
    with pytest.raises(ValueError, match=r"must be a file or one of highway, highway-flows, .*, g"):
        read_network("nowhere")


def test_damaged_files_are_refused(path, tmp_path):
    check_hostile(lambda path: read_network(str(path)), path, tmp_path / "bad.safetensors")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c, a: a.update(heads=a["heads"][:, :7].copy()), "heads must be float32 of shape"),
        (lambda c, a: a.update(hidden=np.zeros((0, 0), "f4")), r"width must be in 1\.\.512, got 0"),
        (lambda c, a: a.update(hidden=np.array(1.0)), r"width must be in 1\.\.512, got 0"),
        (lambda c, a: c.update(format="recurrent-9"), "'recurrent-9', this version reads"),
        (lambda c, a: c.update(channels=["queried"]), "channels of format"),
        (lambda c, a: c.update(ranges={"lanes": [1, "2"]}), "'lanes' must be two numbers"),
    ],
)
def test_other_content_is_refused(change, message, path):
    path.write_bytes(edited(path, change))
    with pytest.raises(ValueError, match=rf"\.safetensors is not a saved network: .*{message}"):
        read_network(str(path))


def test_nothing_is_written_that_could_not_be_read(tmp_path):
    network, path = random_network(), tmp_path / "x.safetensors"
    for bad, about in (
        (network._replace(heads=network.heads * np.float32(np.inf)), card()),
        (network._replace(heads=network.heads[:1]), card()),
        (network, {**card(), "format": "mine"}),
    ):
        with pytest.raises(ValueError, match=r"heads|format"):
            write_network(path, bad, about)
    assert not path.exists()
