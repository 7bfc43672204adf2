import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest

from dptse_env.estimators import REFERENCES, make_estimator
from dptse_env.model import ARZModel, load_parameters
from dptse_env.traffic import PAPER_HIGHWAY

from .episodes import EVERY, tell

MODEL = ARZModel(PAPER_HIGHWAY, load_parameters("paper"))


@pytest.mark.parametrize(("name", "backend"), EVERY)
def test_every_name_and_backend_follows_the_protocol(name, backend):
    estimator = make_estimator(name, backend, MODEL, 3)
    everyone = np.arange(3)
    states = MODEL.states(np.full((3, 19), 30.0), np.full((3, 19), 80.0))
    estimator.reset(everyone, states, [np.random.default_rng(i) for i in everyone])
    estimator.predict(everyone, np.zeros((3, 9)))
    tell(estimator, everyone, np.ones((3, 19), bool), MODEL.measure(states), np.ones(2))
    assert estimator.n_episodes == 3
    assert estimator.innovations.shape == (3, 19, 2)
    assert estimator.diverged.tolist() == [False] * 3
    first, second = estimator.estimate(), estimator.estimate()
    for field in ("density", "speed", "density_std", "speed_std"):
        a, b = getattr(first, field), getattr(second, field)
        assert a.shape == (3, 19)
        assert np.isfinite(a).all()
        assert not np.shares_memory(a, b)
        assert (a >= 0.0).all()


@pytest.mark.parametrize("reference_speed", [None, 40.0])
def test_every_estimator_measures_as_its_model_does(reference_speed):
    model = ARZModel(PAPER_HIGHWAY, load_parameters("paper"), 0.5, reference_speed)
    states = MODEL.states(np.full((1, 19), 30.0), np.full((1, 19), 80.0))
    second = 80.0 if reference_speed is None else 30.0 * (80.0 - 40.0)
    for name, backend in EVERY:
        own = make_estimator(name, backend, model, 1).model
        assert own.reference_speed == reference_speed
        assert own.time_step == 0.5
        np.testing.assert_allclose(own.measure(states)[..., 1], second, err_msg=name)


def test_unknown_names_say_what_is_allowed():
    with pytest.raises(
        ValueError,
        match=r"estimator must be one of ekf, .*, recurrent, or 'package\.module:Name', got 'kf'",
    ):
        make_estimator("kf", "compiled", MODEL, 1)
    with pytest.raises(ValueError, match="backend must be one of compiled, reference, got 'torch'"):
        make_estimator("ekf", "torch", MODEL, 1)
    with pytest.raises(ValueError, match="backend must be 'compiled' for 'blend', only ekf, ukf"):
        gym.make("dptse_env:dptse/ShortHighway-v0", estimator="blend", backend="reference")
    with pytest.raises(ValueError, match="n_episodes must be >= 1, got 0"):
        make_estimator("ekf", "compiled", MODEL, 0)


@pytest.mark.parametrize("name", ["blend", "recurrent", "random_walk", "open_loop"])
def test_only_textbook_filters_have_a_reference(name):
    message = rf"must be 'compiled' for '{name}', only {', '.join(REFERENCES)} have a reference"
    with pytest.raises(ValueError, match=message):
        make_estimator(name, "reference", MODEL, 1)
    with pytest.raises(ValueError, match=message):
        gym.make("dptse_env:dptse/ShortHighway-v0", estimator=name, backend="reference")


def test_the_library_of_reference_filters_is_imported_for_these_alone():
    code = """
import sys
from dptse_env.estimators import make_estimator
from dptse_env.model import ARZModel, load_parameters
from dptse_env.traffic import PAPER_HIGHWAY
make_estimator("ekf", "compiled", ARZModel(PAPER_HIGHWAY, load_parameters("paper")), 1)
assert "filterpy" not in sys.modules
make_estimator("ekf", "reference", ARZModel(PAPER_HIGHWAY, load_parameters("paper")), 1)
assert "filterpy" in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)
