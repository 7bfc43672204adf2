import copy

import pytest

pytest.importorskip("sb3_contrib")

import torch

from agents.experiments.seeds import training_seed
from agents.training.folder import read_progress
from agents.training.recipes import PlackettLuceRecipe, SwapRounds
from agents.training.swaps import try_swaps
from agents.training.training import BEST, POLICY, Training
from tests.agents.training.plans import (
    PRETRAINING,
    SMALL,
    StopError,
    make_plan,
    stop_at,
    without_time,
)

FEW_SWAPS = SwapRounds(rounds=2, episodes=3, seconds=5, trials=2, batches=4, batch_size=16)


def with_swaps(steps):
    recipe = PlackettLuceRecipe(**{**SMALL, **PRETRAINING, "swaps": FEW_SWAPS, "width": 8})
    return make_plan(recipe=recipe, steps=steps)


@pytest.mark.parametrize(("stopped", "steps"), [(0, 240), (1, 240), (2, 240), (2, 0), (5, 240)])
def test_a_training_killed_between_rounds_of_swaps_goes_on_alike(stopped, steps, tmp_path):
    plan = with_swaps(steps)
    whole = Training(plan, tmp_path / "whole")
    whole.run()
    broken = Training(plan, tmp_path / "broken", watchers=(stop_at(stopped),))
    with pytest.raises(StopError):
        broken.run()
    torch.manual_seed(99)
    again = Training(plan, tmp_path / "broken")
    assert again.update == max(stopped - 1, 0)
    again.run()
    assert again.is_finished
    assert without_time(again.rows) == without_time(whole.rows)
    for name in (POLICY, BEST):
        same = [(tmp_path / run / name).read_bytes() for run in ("whole", "broken")]
        assert same[0] == same[1]


def test_rounds_of_swaps_come_first_on_the_curve(tmp_path):
    told = []
    training = Training(with_swaps(240), tmp_path, on_share=lambda *one: told.append(one))
    training.run()
    rows = read_progress(tmp_path)
    assert [row["update"] for row in rows] == list(range(9))
    # Three episodes of 80 s in a round, each with (1 + 2) twins, under noise and its opposite.
    ahead = 36 + 2 * 3 * 80 * 7
    assert [row["steps"] for row in rows[:3]] == [36, 36 + 1680, ahead]
    assert [row["steps"] for row in rows[2:]] == [ahead + 40 * u for u in range(7)]
    assert [row["update"] for row in rows if "validation" in row] == [0, 1, 2, 5, 8]
    assert all(0.01 < row["error"] < 1 for row in rows[1:])
    assert [row["update"] for row in rows if "kl" in row] == [3, 4, 5, 6, 7, 8]
    kinds = [what for what, _ in told]
    assert list(dict.fromkeys(kinds)) == ["regression", "swaps", "fit"]
    assert all(0.0 <= share <= 1.0 for _, share in told)
    assert training.model.num_timesteps == 240


def test_steps_fall_from_round_to_round(tmp_path, monkeypatch):
    steps = []
    training = Training(with_swaps(0), tmp_path)
    monkeypatch.setattr(
        "agents.training.improvement.improve", lambda _p, _s, _t, step, *_: steps.append(step)
    )
    training.run()
    assert steps == [FEW_SWAPS.step, FEW_SWAPS.final_step]
    assert SwapRounds(rounds=5, step=9.0, final_step=1.0).step_of(1) == pytest.approx(7.0)
    assert SwapRounds(rounds=1).step_of(0) == SwapRounds().step


def test_every_round_tries_other_swaps_in_other_episodes(tmp_path, monkeypatch):
    began, given = [], []
    training = Training(with_swaps(0), tmp_path)

    def recorded(env, policy, seeds, generator, **keywords):
        began.append((seeds, copy.deepcopy(generator).random()))
        return try_swaps(env, policy, seeds, generator, **keywords)

    monkeypatch.setattr("agents.training.improvement.try_swaps", recorded)
    monkeypatch.setattr(
        "agents.training.improvement.improve", lambda policy, swaps, *_: given.append(swaps)
    )
    training.run()
    seeds = [set(seeds) for seeds, _ in began]
    assert [len(one) for one in seeds] == [3, 3]
    assert not seeds[0] & seeds[1]
    assert min(seeds[0] | seeds[1]) > training_seed(1) + SMALL["n_envs"]
    assert max(seeds[0] | seeds[1]) < training_seed(2)
    assert began[0][1] != began[1][1]
    # 80 s less the first of 20 to 24 leave eleven or twelve states of three episodes.
    assert {len(one.observations) for one in given} <= {33, 36}
    assert all(len(one.gain) == 2 * len(one.observations) for one in given)
