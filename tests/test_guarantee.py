"""The environment under the preset that guarantees privacy: account, warnings, truth."""

import json

import gymnasium as gym
import numpy as np
import pytest

from tests.helpers import assert_same, make_env, play


def guaranteed(**keywords):
    return make_env(**{"privacy": {"preset": "capped", "cap": 5}, **keywords})


def test_the_account_of_a_guarantee_is_in_info():
    env = guaranteed(horizon=20)
    (_, at_reset), *steps = play(env, 20)
    account = at_reset["privacy"]
    assert json.loads(json.dumps(account, allow_nan=False)) == account
    assert account["guarantee"].startswith("(1, 0.05)-differential privacy of density and flow")
    assert account["void_reasons"] == []
    assert (account["unit"], account["cap"], account["adjacency"]) == ("trip", 5, "replace")
    assert account["assumptions"]["contributions"] == 5
    mus = [at_reset["mu"], *(step[4]["mu"] for step in steps)]
    counted = np.minimum(np.arange(21), 5)
    np.testing.assert_allclose(mus, account["mu"] * np.sqrt(counted / 5), rtol=1e-12)
    assert steps[-1][4]["epsilon"] == pytest.approx(account["epsilon"])
    assert account["epsilon"] == pytest.approx(1.0)


def test_a_void_guarantee_is_warned_of_when_the_environment_is_made():
    with pytest.warns(UserWarning, match=r"boundary_inputs: .*without noise") as caught:
        env = guaranteed(privacy={"preset": "capped", "boundary_inputs": "true"})
    assert len(caught) == 1
    account = env.reset(seed=0)[1]["privacy"]
    assert (account["guarantee"], account["void_reasons"]) == ("none", ["boundary_inputs"])
    with pytest.warns(UserWarning, match="speed_sensitivity"):
        env = guaranteed(privacy={"preset": "capped", "speed_release": "mean"})
    account = env.reset(seed=0)[1]["privacy"]
    assert (account["guarantee"], account["void_reasons"]) == ("none", ["speed_sensitivity"])


def test_counted_vehicles_are_shown_only_with_the_truth():
    _, _, _, _, hidden = play(guaranteed(), 30)[-1]
    assert not {"exposures", "individual_epsilon", "truth"} & set(hidden)
    env = guaranteed(truth_in_info=True)
    env.reset(seed=0, options={"traffic_seed": 0})
    for _ in range(100):
        *_, info = env.step(env.action_space.sample())
    exposures = np.array(info["truth"]["exposures"])
    epsilons = np.array(info["truth"]["individual_epsilon"])
    assert exposures.max() == 5
    assert epsilons.max() == pytest.approx(info["epsilon"])
    np.testing.assert_array_equal(epsilons == 0.0, exposures == 0)
    assert (exposures == 0).any()
    record = env.unwrapped.process.traffic.record(0)
    assert len(exposures) == len(epsilons) == record.n_vehicles
    _, again = env.reset(options={"traffic_seed": 0})
    assert not any(again["truth"]["exposures"])
    assert not any(again["truth"]["individual_epsilon"])


def test_contributions_do_not_depend_on_other_episodes():
    alone, after = guaranteed(truth_in_info=True), guaranteed(truth_in_info=True)
    after.reset(seed=9, options={"traffic_seed": 1})
    after.reset(seed=9, options={"traffic_seed": 2})
    lengths = {after.unwrapped.process.traffic.record(index).n_vehicles for index in range(3)}
    assert len(lengths) > 1
    for env in (alone, after):
        env.action_space.seed(0)
    options = {"traffic_seed": min(range(3), key=lambda s: _n_vehicles(after, s))}
    assert_same(alone.reset(seed=0, options=options), after.reset(seed=0, options=options))
    for _ in range(60):
        chosen = alone.action_space.sample()
        assert_same(alone.step(chosen), after.step(chosen))


def _n_vehicles(env, slot):
    return env.unwrapped.process.traffic.record(slot).n_vehicles


# --- the paced ledger ---------------------------------------------------------------------------


def paced(**keywords):
    return make_env(**{"privacy": {"preset": "paced", "epsilon": 0.5}, **keywords})


def test_the_account_of_paced_ledgers_grows_up_to_the_guarantee():
    env = paced(horizon=80, random_start=True, truth_in_info=True)
    (_, at_reset), *steps = play(env, 80)
    account = at_reset["privacy"]
    assert json.loads(json.dumps(account, allow_nan=False)) == account
    # All but the truth, which is shown here, is in order.
    assert account["void_reasons"] == ["truth_in_info"]
    assert (account["preset"], account["unit"], account["adjacency"]) == (
        "paced", "trip", "replace",
    )  # fmt: skip
    infos = [at_reset, *(step[4] for step in steps)]
    mus, epsilons = ([info[key] for info in infos] for key in ("mu", "epsilon"))
    assert mus == sorted(mus)
    assert epsilons == sorted(epsilons)
    assert (mus[0], epsilons[0]) == (0.0, 0.0)
    assert mus[-1] == pytest.approx(account["mu"])
    assert epsilons[-1] == pytest.approx(0.5)
    for info in infos:
        assert info["centre_fallback"] == 0.0
        truth = info["truth"]
        assert max(truth["ledgers"], default=0.0) <= 1.0
        assert max(truth["individual_epsilon"], default=0.0) <= info["epsilon"] + 1e-9
    assert not any(at_reset["truth"]["ledgers"])
    assert max(infos[-1]["truth"]["ledgers"]) > 0.9
    assert sum(info["truth"]["n_refused"] for info in infos) > 0


def test_ledgers_are_shown_only_with_the_truth():
    (_, at_reset), *steps = play(paced(), 5)
    account = at_reset["privacy"]
    assert account["guarantee"].startswith("(0.5, 0.05)-differential privacy of count and flow")
    for info in (at_reset, steps[-1][4]):
        assert not {"ledgers", "individual_epsilon", "n_refused", "truth"} & set(info)


def test_vector_environments_of_gymnasium_take_ledgers():
    made = [lambda s=s: paced(truth_in_info=True, traffic_seeds=[s]) for s in range(3)]
    env = gym.vector.SyncVectorEnv(made)
    env.reset(seed=0)
    for _ in range(3):
        *_, info = env.step(env.action_space.sample())
    assert len({len(one) for one in info["truth"]["ledgers"]}) > 1
    assert info["centre_fallback"].tolist() == [0.0] * 3
    env.close()


def test_a_spec_with_every_keyword_of_paced_ledgers_survives_json():
    env = gym.make(
        "dptse_env:dptse/PrivateHighway-v1",
        privacy={
            "epsilon": 2.0, "delta": 0.01, "unit": "event", "adjacency": "add_remove",
            "pace": 0.6, "clip": 25.0, "ratio": 3.0, "pacing": "tracer",
            "boundary_inputs": "private",
        },
        traffic_seeds="0:2",
        horizon=20,
    )  # fmt: skip
    again = gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.config == env.unwrapped.config
    assert_same(play(env, 5), play(again, 5))
