"""Many canaries in one episode: what each tells, and what they find together."""

import dataclasses

import numpy as np
import pytest

from agents.audit.attack import overheard
from agents.audit.one_run import attack_in_one_run, make_design
from agents.audit.worlds import Worlds
from dptse_env.parts import make_task, privacy_report

from .small import ROAD, config, paced

EVERYWHERE = ROAD.geometry.n_mainline


@pytest.mark.parametrize("kind", ["elsewhere", "fast", "absent"])
@pytest.mark.parametrize(
    "setting",
    [
        config(preset="printed"),
        config(3, adjacency="add_remove"),
        paced("ekf", boundary_inputs="private"),
        dataclasses.replace(paced(bandwidth=1), query_spans=(1, 2)),
    ],
)
def test_a_number_tells_of_its_canary_alone(kind, setting, record):
    """Each is alone in its seconds and segments, and its score is the whole difference it makes."""
    design, task = make_design(setting, 8, kind), make_task(setting)
    assert (design.plan @ task.queries.cost).max() <= setting.bandwidth
    zeros, ones = (design.with_coins(np.full(design.n, coin)) for coin in (0, 1))
    some = 0, design.n // 2, design.n - 1
    # The transcript of all zeros, against a world in which all coins differ, or one of them.
    others = [ones, *([*zeros[:each], ones[each], *zeros[each + 1 :]] for each in some)]
    pairs = [[k, 4 + k] for k in range(4)]
    worlds = Worlds(record, [zeros] * 4 + others, pairs * 2)
    streams = [np.random.default_rng(0) for _ in others]
    played = overheard(setting, worlds, np.arange(4), design.plan, streams)
    heard = np.array([release.heard[0] for release in played])
    together = design.by_canary(heard[:, 0])
    assert np.count_nonzero(together) > 0.7 * design.n
    assert together.sum() == pytest.approx(heard[:, 0].sum())
    for row, canary in enumerate(some, start=1):
        assert heard[:, row].sum() == pytest.approx(together[canary], abs=1e-9)


@pytest.mark.parametrize(
    ("setting", "kind"),
    [
        (config(EVERYWHERE, epsilon=5.0), "fast"),
        (config(EVERYWHERE, epsilon=5.0, adjacency="add_remove"), "absent"),
        (paced("ekf", bandwidth=3, unit="event", adjacency="add_remove"), "absent"),
    ],
)
def test_a_canary_reaches_mu_and_no_more(setting, kind, record):
    run = attack_in_one_run(setting, record)
    mu = privacy_report(setting).mu
    assert run.design.kind == kind
    assert run.distances.max() == pytest.approx(mu, rel=1e-6)
    assert run.distance > 0.95 * mu
    again = attack_in_one_run(setting, record)
    np.testing.assert_array_equal(run.scores, again.scores)
    assert not np.isin(attack_in_one_run(setting, record, seed=1).scores, run.scores).any()
