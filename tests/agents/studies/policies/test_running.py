import dataclasses

import numpy as np
import pytest

from agents.evaluation.episodes import run_episodes
from agents.experiments.runner import make_batch
from agents.seeds import STUDY_TEST
from agents.studies.policies.freezing import draft
from agents.studies.policies.plan import (
    Entry,
    Learner,
)
from agents.studies.policies.queries import BIN, PHASES, QueryCounter
from agents.studies.policies.running import (
    count_queries,
    make_task,
    run_entry,
    suitable,
)
from dptse_env.schedules import make_schedule
from dptse_env.traffic.scenario import draw_scenario
from tests.agents.policies import SHORT
from tests.agents.studies.policies.worlds import SMALL, WALK, checkpoints
from tests.release.sums import SumRelease


def test_a_task_runs_the_episodes_of_its_seeds(runs):
    manifest = draft(SMALL, checkpoints(runs), (), "command")
    learner = Learner("moved", "plackett-luce", "primary", "deterministic")
    for entry in (Entry("moved", "baseline", "oldest-first"), learner.entry(1)):
        task = make_task(entry, SMALL, manifest, seeds=(2000, 2001), noise=STUDY_TEST.start)
        scores = run_entry(task)
        assert [score.traffic_seed for score in scores] == [2000, 2001]
        keywords = {**SMALL.cell("moved").keywords, "action": "slots"}
        env = make_batch(SHORT, keywords, (2000, 2001))
        policy = make_schedule("oldest-first", env)
        if entry.kind == "learned":
            policy = checkpoints(runs)[1].saved().load(env, allow=("corridor",))
        expected = run_episodes(
            env, policy, traffic_seeds=(2000, 2001), seeds=(6_002_000, 6_002_001)
        )
        assert scores == expected


def test_drawn_actions_are_seeded_and_differ_from_the_likeliest(runs):
    manifest = draft(SMALL, checkpoints(runs), (), "command")
    scores = {}
    for mode in ("deterministic", "stochastic"):
        entry = Learner("primary", "plackett-luce", "primary", mode).entry(0)
        task = make_task(entry, SMALL, manifest, seeds=(2000, 2001), noise=STUDY_TEST.start)
        scores[mode] = run_entry(task)
        assert scores[mode] == run_entry(task)
    assert scores["deterministic"] != scores["stochastic"]


def test_a_cell_that_is_wrong_is_not_taken_for_a_schedule_that_does_not_suit():
    wrong = dataclasses.replace(SMALL.cells[0], keywords={"estimator": "kf"})
    with pytest.raises(ValueError, match="estimator must be one of"):
        suitable(wrong, ("paper",))


def test_queries_are_counted_by_segment_and_time():
    env = make_batch(SHORT, {**WALK, "incident": "random"}, (2000, 2001))
    counter, queried, times = QueryCounter(env.process, (2000, 2001)), [], []

    def note():
        counter()
        queried.append(env.process.queried.copy())
        times.append(env.process.time.copy())

    schedule = make_schedule("paper", env)
    run_episodes(env, schedule, traffic_seeds=(2000, 2001), seeds=(1, 2), on_second=note)
    flags, seconds = np.array(queried)[1:], np.array(times)[1:, 0]
    for k, counts in enumerate(counter.results()):
        total = sum(counts.counts(phase) for phase in PHASES)
        np.testing.assert_array_equal(total, flags[:, k].sum(axis=0))
        before = seconds <= counts.start
        np.testing.assert_array_equal(counts.counts("before"), flags[before, k].sum(axis=0))
        assert counts.counts("seconds").sum() == 240
        assert counts.counts("seconds")[0] == before.sum()
        incident = draw_scenario(env.config.corridor, counts.traffic_seed).incidents[0]
        after = seconds > incident.phases[-1][1]
        np.testing.assert_array_equal(counts.counts("after"), flags[after, k].sum(axis=0))
        assert after.any()
        near = np.abs(np.arange(6) - counts.incident) <= 2
        bins = flags[:, k][:, near].sum(axis=1).reshape(-1, BIN).sum(axis=1)
        np.testing.assert_array_equal(counts.counts("near"), bins)
    assert {counts.incident for counts in counter.results()} != {-1}


def test_a_segment_is_counted_once_for_all_queries_that_cover_it():
    keywords = {"privacy": SumRelease, "query_spans": (1, 2), "bandwidth": 3, "horizon": 61}
    env = make_batch(SHORT, keywords, (2000,))
    counter = QueryCounter(env.process, (2000,))
    env.reset(seed=0)
    counter()
    env.advance(np.isin(np.arange(11), (1, 6))[None].astype(np.int8))  # 1 by itself, and 0 with 1
    counter()
    assert counter.results()[0].counts("before").tolist() == [1, 1, 0, 0, 0, 0]


def test_without_an_incident_all_of_an_episode_is_before_it(runs):
    manifest = draft(SMALL, checkpoints(runs), (), "command")
    entry = Entry("moved", "baseline", "paper")
    (counts,) = count_queries(make_task(entry, SMALL, manifest, seeds=(2000,), noise=0))
    assert (counts.incident, counts.start) == (-1, 0.0)
    assert counts.counts("seconds").tolist() == [240, 0, 0]
    assert not counts.counts("near").any()
