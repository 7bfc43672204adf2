import dataclasses

import numpy as np
import pytest

from agents.environments import make_vector
from agents.evaluation.episodes import run_episodes
from agents.studies.estimators.linear_stack import (
    EQUAL,
    LAGS,
    N_FEATURES,
    STACK,
    fit_stack,
    read_fit,
    stack_settings,
    write_fits,
)
from dptse_env.schedules import make_schedule

from .made_up import TINY


def play(settings, on_second=None, seeds=(2000,), world=TINY):
    keywords = {**world.keywords, "estimator": STACK, "estimator_settings": settings}
    env = make_vector(TINY.env, len(seeds), {**keywords, "traffic_seeds": list(seeds)})
    policy = make_schedule("round-robin", env)
    return run_episodes(
        env, policy, traffic_seeds=seeds, seeds=seeds, warm_up=10,
        on_second=None if on_second is None else lambda: on_second(env.process),
    )  # fmt: skip


def test_without_a_fit_it_is_the_mean_of_both_filters():
    def check(process):
        stack = process.estimator
        density = (stack.ekf.estimate().density + stack.walk.estimate().density) / 2
        np.testing.assert_allclose(process.estimate.density, np.maximum(density, 0.0), atol=1e-9)

    play(stack_settings(TINY), check)


def test_features_are_the_filters_now_and_before():
    kept = []

    def check(process):
        stack, n = process.estimator, process.interface.n_mainline
        kept.append(stack._parts())
        features = stack.features()
        assert features.shape[-1] == N_FEATURES
        for k, (age, offset) in enumerate(LAGS):
            if len(kept) <= 21:
                continue
            at = 3
            expected = kept[-1 - age][:, min(max(at + offset, 0), n - 1)]
            np.testing.assert_allclose(features[:, at, 4 * k : 4 * k + 4], expected)
        assert (features[..., -1] == 1.0).all()

    play(stack_settings(TINY), check)
    assert len(kept) > 40


def test_a_fit_lowers_the_error_and_calibrates_deviations(tmp_path):
    whole = dataclasses.replace(TINY, keywords={"privacy": "paced"})
    fit = fit_stack(whole, (0, 1), ("round-robin",), None)
    write_fits(tmp_path / "stack.json", {"tiny": fit})
    assert len(fit["coefficients"][0]) == N_FEATURES
    settings = stack_settings(whole, str(tmp_path / "stack.json"), "tiny")
    fitted = play(settings, seeds=(0, 1), world=whole)
    plain = play(stack_settings(whole), seeds=(0, 1), world=whole)
    errors = [np.mean([each.reward for each in scores]) for scores in (fitted, plain)]
    assert errors[0] > errors[1]
    assert all(0.2 < factor < 10.0 for factor in fit["factors"])
    assert read_fit(str(tmp_path / "stack.json"), "tiny").factors == tuple(fit["factors"])


def test_the_mean_weighs_both_filters_alike():
    density, speed = np.array(EQUAL.coefficients)
    np.testing.assert_array_equal(np.flatnonzero(density), [0, 2])
    np.testing.assert_array_equal(np.flatnonzero(speed), [1, 3])
    assert density.sum() == speed.sum() == pytest.approx(1.0)
