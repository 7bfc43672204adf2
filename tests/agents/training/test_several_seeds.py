"""Trainings that are handed from worker to worker, and rounds that workers share."""

import dataclasses

import pytest

pytest.importorskip("sb3_contrib")

import numpy as np
import torch

from agents.engines.local import THIS_PROCESS, LocalProcesses
from agents.training import several_seeds
from agents.training.run_files import PROGRESS, read_checkpoint, read_progress
from agents.training.several_seeds import train_all
from agents.training.swap_parts import split
from agents.training.training import BEST, POLICY, Training
from tests.agents.training.plans import make_plan, make_recipe, without_time


def weights(folder):
    learner = read_checkpoint(folder)["learner"]
    return learner["policy"]


def equal(one, other):
    return one.keys() == other.keys() and all(torch.equal(one[k], other[k]) for k in one)


def in_parts(parts):
    recipe = make_recipe("plackett-luce")
    swaps = dataclasses.replace(recipe.swaps, parts=parts)
    return make_plan(recipe=dataclasses.replace(recipe, swaps=swaps))


@pytest.mark.parametrize("learner", ["plackett-luce", "scores"])
def test_a_training_that_is_handed_on_comes_out_as_one_that_is_not(tmp_path, learner):
    plans = {tmp_path / str(seed): make_plan(learner, seed=seed) for seed in (1, 2)}
    grown = []
    train_all(
        plans,
        THIS_PROCESS,
        records=None,
        on_rows=lambda folder, rows: grown.append((folder.name, len(rows))),
        seconds=0.0,
    )
    # Each worker did no more than the updates to the next checkpoint.
    assert len(grown) > 2 * len(plans)
    for folder, plan in plans.items():
        alone = Training(plan, tmp_path / "alone" / folder.name)
        alone.run()
        assert equal(weights(folder), weights(alone.folder))
        assert without_time(read_progress(folder)) == without_time(alone.rows)
        for name in (BEST, POLICY):
            assert (folder / name).exists()
    assert not equal(*(weights(folder) for folder in plans))


def test_a_training_goes_on_where_its_folder_stands(tmp_path, monkeypatch):
    plans = {tmp_path / "0": make_plan()}
    begun = []

    def once(workers, stretch):
        if begun:
            raise KeyboardInterrupt
        begun.append(stretch)
        return workers.submit(several_seeds.run_stretch, stretch)

    with monkeypatch.context() as patch:
        patch.setattr(several_seeds, "_begin", once)
        with pytest.raises(KeyboardInterrupt):
            train_all(plans, THIS_PROCESS, records=None, seconds=0.0)
    rows = read_progress(tmp_path / "0")
    assert 0 < len(rows) < 3
    train_all(plans, THIS_PROCESS, records=None, seconds=0.0)
    assert read_progress(tmp_path / "0")[: len(rows)] == rows
    alone = Training(make_plan(), tmp_path / "alone")
    alone.run()
    assert equal(weights(tmp_path / "0"), weights(alone.folder))


def test_a_folder_of_another_plan_is_refused_before_anything_runs(tmp_path):
    train_all({tmp_path / "0": make_plan()}, THIS_PROCESS, records=None)
    before = (tmp_path / "0" / PROGRESS).read_bytes()
    with pytest.raises(ValueError, match=r"0 was made with other settings: seed is 1 there and 9"):
        train_all(
            {tmp_path / "9": make_plan(), tmp_path / "0": make_plan(seed=9)},
            THIS_PROCESS,
            records=None,
        )
    assert (tmp_path / "0" / PROGRESS).read_bytes() == before
    assert not (tmp_path / "9" / PROGRESS).exists()


def test_parts_of_a_round_come_out_the_same_wherever_they_run(tmp_path):
    kept = {}
    for name, engine in {"here": THIS_PROCESS, "there": LocalProcesses(2)}.items():
        Training(in_parts(2), tmp_path / name, engine=engine).run()
        kept[name] = weights(tmp_path / name)
    assert equal(kept["here"], kept["there"])
    # Draws of a part are its own.
    Training(in_parts(1), tmp_path / "whole").run()
    assert not equal(kept["here"], weights(tmp_path / "whole"))


def test_a_round_has_as_many_episodes_in_parts():
    assert split(7, 3) == [range(2), range(2, 4), range(4, 7)]
    assert split(2, 5) == [range(1), range(1, 2)]
    assert np.concatenate(split(480, 7)).tolist() == list(range(480))
