"""A mixture of estimators beside its equations."""

from dataclasses import replace

import numpy as np
import pytest

from dptse_env.estimators import EstimatorSettings, MixtureSettings, make_estimator
from dptse_env.estimators.mixture import _weights_on
from dptse_env.traffic import CORRIDORS

from .helpers import RELEASES, model_of, run, simulate, started, step, update

EXPERTS = ("asm", "random_walk", "ekf")


def mixing(*experts, **changes):
    return EstimatorSettings(mixture=MixtureSettings(experts or EXPERTS, **changes))


@pytest.mark.parametrize("release", RELEASES)
def test_experts_are_weighed_by_what_they_foretell(release):
    episodes = simulate("published", n=2, n_steps=25, noise=2.0, release=release)
    model, settings, likelihoods = episodes.model, mixing(memory=20.0), np.zeros((3, 2))
    mixture = started("mixture", "compiled", episodes, settings)
    experts = [started(name, "compiled", episodes, settings) for name in EXPERTS]
    H = model.averaging
    for k in range(25):
        step_of = episodes.inputs[k], episodes.observed[k]
        likelihoods *= 1.0 - 1.0 / 20.0
        for expert, likelihood in zip(experts, likelihoods, strict=True):
            expert.predict(episodes.everyone, step_of[0])
            rho, v, rho_std, v_std = expert.estimate()
            y, variance = v, v_std**2
            if release != "speed":
                centre = model.centre if episodes.centre is None else episodes.centre[k]
                y = rho * (v - centre)
                variance = (rho * v_std) ** 2 + ((v - centre) * rho_std) ** 2
            for i in range(2):
                for m in np.flatnonzero(step_of[1][i]):
                    for j, (mean, spread) in enumerate(((rho, rho_std**2), (y, variance))):
                        V = H[m] ** 2 @ spread[i] + episodes.sigma[k, i, m, j] ** 2
                        error = episodes.values[k, i, m, j] - H[m] @ mean[i]
                        likelihood[i] -= 0.5 * (error**2 / V + np.log(V))
            update(expert, episodes, k)
        step(mixture, episodes, k)
    weights = np.exp(likelihoods - likelihoods.max(axis=0))
    weights /= weights.sum(axis=0)
    np.testing.assert_allclose(mixture.weights, weights, rtol=1e-8, atol=1e-12)
    table = np.array([expert.estimate() for expert in experts])
    found = mixture.estimate()
    for i in range(2):
        mean = np.einsum("en,ens->ns", weights, table[:, i])
        squares = np.einsum("en,ens->ns", weights, table[:, i] ** 2 + table[:, 2 + i] ** 2)
        np.testing.assert_allclose(found[i], mean, rtol=1e-9)
        np.testing.assert_allclose(found[2 + i] ** 2, squares - mean**2, rtol=1e-6)


def test_an_expert_that_is_wrong_loses_its_weight_and_gets_it_back():
    """A walk follows what is released, and the model alone does not."""
    episodes = simulate("w99-3lane", n_steps=190)
    wrong = replace(episodes, values=episodes.values + np.array([80.0, 0.0]))
    settings = mixing("random_walk", "open_loop", memory=10.0)
    mixture = started("mixture", "compiled", episodes, settings)
    for given, steps, weight in (
        (episodes, range(120), 1.0),
        (wrong, range(120, 140), 0.0),
        (episodes, range(140, 190), 1.0),
    ):
        run(mixture, given, steps)
        np.testing.assert_allclose(mixture.weights[:, 0], [1.0 - weight, weight], atol=0.01)


@pytest.mark.parametrize(
    ("experts", "message"),
    [
        (("asm",), r"mixture\.experts must be two or more names of other .*, got"),
        (("asm", "mixture"), r"mixture\.experts must be two or more names of other"),
    ],
)
def test_experts_are_two_or_more_others(experts, message):
    with pytest.raises(ValueError, match=message):
        mixing(*experts)


@pytest.mark.parametrize(
    ("expert", "message"),
    [
        ("dptse_env.estimators.mixture:Mixture", " must be other estimators than a mixture, got "),
        ("no_such:Part", ": estimator 'no_such:Part' cannot be imported: "),
    ],
)
def test_an_expert_that_cannot_be_is_refused_by_its_place(expert, message):
    with pytest.raises(ValueError, match=rf"^estimator_settings\.mixture\.experts{message}"):
        make_estimator(
            "mixture", "compiled", model_of("published", "speed"), 1, mixing("ekf", expert)
        )


def test_an_expert_is_an_estimator_or_the_name_of_weights():
    model = model_of("published", "speed")
    mixture = make_estimator("mixture", "compiled", model, 1, EstimatorSettings())
    assert [each.saved.source for each in mixture.experts] == ["highway-speeds", "roads-speeds"]


@pytest.mark.parametrize(
    ("road", "flows", "experts"),
    [
        ("paper-highway", True, ["highway", "roads"]),
        ("long-highway", True, ["long-highway", "roads"]),
        ("long-highway", False, ["highway", "roads"]),
    ],
)
def test_the_first_expert_is_what_recurrent_takes_on_the_road(road, flows, experts):
    assert list(_weights_on(CORRIDORS[road].road, flows)) == experts


def test_settings_that_an_expert_cannot_have_are_refused():
    model = model_of("published", "speed")
    with pytest.raises(ValueError, match=r"weights must be a file or one of .*, got 'kf'"):
        make_estimator("mixture", "compiled", model, 1, mixing("asm", "kf"))
    bad = replace(mixing("asm", "mhe"), process_noise=(0.0, 0.01))
    with pytest.raises(ValueError, match="process_noise"):
        make_estimator("mixture", "compiled", model, 1, bad)
