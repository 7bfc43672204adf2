"""Trainings at once, and rounds that workers share."""

from concurrent.futures import Future

import pytest

pytest.importorskip("sb3_contrib")

import numpy as np
import torch

from agents.executors import THIS_PROCESS, ExecutorError, ThisProcess
from agents.training.recipes import PlackettLuceRecipe, RegressionRounds, SwapRounds
from agents.training.run_files import PROGRESS, read_checkpoint, read_progress
from agents.training.several_seeds import train_all
from agents.training.swap_parts import split
from agents.training.training import BEST, POLICY, Training
from tests.agents.elsewhere import Elsewhere
from tests.agents.training.plans import StopError, make_plan, stop_at, without_time


def weights(folder):
    learner = read_checkpoint(folder)["learner"]
    return learner["policy"]


def equal(one, other):
    return one.keys() == other.keys() and all(torch.equal(one[k], other[k]) for k in one)


def one_round(parts=1, seed=1):
    swaps = SwapRounds(rounds=1, episodes=2, seconds=10, trials=1, batches=5, parts=parts)
    recipe = PlackettLuceRecipe(regression=RegressionRounds(rounds=0), swaps=swaps, width=8)
    return make_plan(recipe=recipe, seed=seed, validation_seeds=(1000,))


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """A training by itself; leave it alone."""
    training = Training(one_round(), tmp_path_factory.mktemp("alone"))
    training.run()
    return training


def train(plans, executor=THIS_PROCESS):
    train_all(plans, executor, records=None, progress=False)


def test_trainings_at_once_come_out_as_alone(tmp_path, alone):
    train({tmp_path / str(seed): one_round(seed=seed) for seed in (1, 2)}, Elsewhere())
    assert without_time(read_progress(tmp_path / "1")) == without_time(alone.rows)
    for name in (BEST, POLICY):
        assert (tmp_path / "1" / name).read_bytes() == (alone.folder / name).read_bytes()
    assert not equal(weights(tmp_path / "1"), weights(tmp_path / "2"))


def test_a_training_goes_on_where_its_folder_stands(tmp_path, alone):
    """As after the loss of a worker, whose task is run again."""
    broken = Training(one_round(), tmp_path / "0", watchers=(stop_at(1),))
    with pytest.raises(StopError):
        broken.run()
    rows = read_progress(tmp_path / "0")
    assert [row["update"] for row in rows] == [0]
    train({tmp_path / "0": one_round()})
    assert read_progress(tmp_path / "0")[:1] == rows
    assert equal(weights(tmp_path / "0"), weights(alone.folder))


def test_a_folder_of_another_plan_is_refused_before_anything_runs(tmp_path):
    Training(make_plan(), tmp_path / "0")
    plans = {tmp_path / "9": make_plan(), tmp_path / "0": make_plan(seed=9)}
    with pytest.raises(ValueError, match=r"0 has the training of another plan: seed is 1 there"):
        train(plans)
    assert not (tmp_path / "9").exists()
    assert not (tmp_path / "0" / PROGRESS).exists()


def test_a_folder_that_workers_do_not_share_is_an_error(tmp_path):
    class Apart(ThisProcess):
        """Trains on the disk of another machine."""

        def submit(self, fn, /, *args, **kwargs):
            future = Future()
            future.set_result(None)
            return future

    with pytest.raises(ExecutorError, match="choose an --output that all nodes have"):
        train({tmp_path / "0": make_plan()}, Apart())


@pytest.mark.slow
def test_parts_of_a_round_come_out_the_same_wherever_they_run(tmp_path, alone):
    kept = {}
    for name, executor in {"here": THIS_PROCESS, "there": Elsewhere()}.items():
        Training(one_round(2), tmp_path / name, executor=executor).run()
        kept[name] = weights(tmp_path / name)
    assert equal(kept["here"], kept["there"])
    # Draws of a part are its own.
    assert not equal(kept["here"], weights(alone.folder))


def test_a_round_has_as_many_episodes_one_round():
    assert split(7, 3) == [range(2), range(2, 4), range(4, 7)]
    assert split(2, 5) == [range(1), range(1, 2)]
    assert np.concatenate(split(480, 7)).tolist() == list(range(480))
