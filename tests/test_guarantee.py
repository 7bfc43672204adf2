"""The environment under presets that guarantee privacy: account, warnings, truth."""

import json

import gymnasium as gym
import numpy as np
import pytest

from tests.helpers import make_env, play

CAPPED, PACED = {"preset": "capped", "cap": 5}, {"preset": "paced", "epsilon": 0.5}


@pytest.mark.parametrize(
    ("privacy", "claim", "settings"),
    [
        (CAPPED, "0.7504-Gaussian differential privacy, which is (1, 0.05)-", {"cap": 5}),
        (PACED, "0.4919-Gaussian differential privacy, which is (0.5, 0.05)-", {"pace": 0.85}),
    ],
)
def test_the_account_is_in_info_and_grows_up_to_the_guarantee(privacy, claim, settings):
    env = make_env(privacy=privacy, horizon=80, random_start=True)
    (_, at_reset), *steps = play(env, 80)
    account, infos = at_reset["privacy"], [at_reset, *(step[4] for step in steps)]
    assert json.loads(json.dumps(account, allow_nan=False)) == account
    assert account["guarantee"].startswith(claim)
    assert account["void_reasons"] == []
    assert account.items() >= {"unit": "trip", "adjacency": "replace", **settings}.items()
    mus, epsilons = ([info[key] for info in infos] for key in ("spent_mu", "spent_epsilon"))
    assert mus == sorted(mus)
    assert epsilons == sorted(epsilons)
    assert (mus[0], epsilons[0]) == (0.0, 0.0)
    assert mus[-1] == pytest.approx(account["mu"])
    assert epsilons[-1] == pytest.approx(account["epsilon"]) == account["claimed_epsilon"]
    if "cap" in settings:
        counted = np.minimum(np.arange(81), 5)
        np.testing.assert_allclose(mus, account["mu"] * np.sqrt(counted / 5), rtol=1e-12)
    private = {"exposures", "ledgers", "individual_epsilon", "n_refused", "truth"}
    assert not any(private & set(info) for info in infos)


@pytest.mark.parametrize(
    ("privacy", "reason"),
    [({"boundary_inputs": "true"}, "boundary_inputs"), ({"speed_release": "mean"}, "speed_")],
)
def test_a_void_guarantee_is_warned_of_when_the_environment_is_made(privacy, reason):
    with pytest.warns(UserWarning, match=reason) as caught:
        env = make_env(privacy=CAPPED | privacy)
    assert len(caught) == 1
    account = env.reset(seed=0)[1]["privacy"]
    assert account["guarantee"] == "none"
    assert account["void_reasons"][0].startswith(reason)


@pytest.mark.parametrize(
    ("privacy", "what", "most"), [(CAPPED, "exposures", 5), (PACED, "ledgers", 1.0)]
)
def test_what_vehicles_have_spent_is_shown_with_the_truth(privacy, what, most):
    env = make_env(privacy=privacy, truth_in_info=True)
    env.action_space.seed(0)
    _, info = env.reset(seed=0, options={"traffic_seed": 0})
    assert info["privacy"]["void_reasons"] == ["truth_in_info"]
    refused = 0
    for _ in range(100):
        *_, info = env.step(env.action_space.sample())
        spent, epsilons = (np.array(info["truth"][key]) for key in (what, "individual_epsilon"))
        assert spent.max(initial=0) <= most
        assert epsilons.max(initial=0) <= info["spent_epsilon"] * (1.0 + 1e-9)
        refused += info["truth"].get("n_refused", 0)
    assert spent.max() > 0.9 * most
    assert (spent == 0).any()
    assert (epsilons[spent == 0] == 0.0).all()
    assert (epsilons[spent > 0.1 * most] > 0.0).all()
    assert (refused > 0) == (what == "ledgers")
    assert len(spent) == len(epsilons) == env.unwrapped.process.traffic.record(0).n_vehicles
    _, again = env.reset(options={"traffic_seed": 0})
    assert not any(again["truth"][what])
    assert not any(again["truth"]["individual_epsilon"])


def test_a_spec_with_every_keyword_of_paced_ledgers_survives_json():
    privacy = {
        "epsilon": 2.0, "delta": 0.01, "unit": "event", "adjacency": "add_remove", "pace": 0.6,
        "clip": 25.0, "ratio": 3.0, "pacing": "tracer", "boundary_inputs": "private",
    }  # fmt: skip
    given = {"privacy": privacy, "traffic_seeds": "0:2", "horizon": 20}
    env = gym.make("dptse_env:dptse/PrivateHighway-v1", **given)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.config == env.unwrapped.config
