import dataclasses

import pytest

from agents.studies.paper.plan import (
    BASELINE_ESTIMATORS,
    PAPER_ESTIMATORS,
    SETTINGS,
    PaperDesign,
    canonical,
)
from tests.agents.studies.paper.made_up import DESIGN


def test_cells_that_results_share_are_run_once():
    cells = DESIGN.cells()
    assert len(set(cells)) == len(cells)
    # Per estimator and setting: 4 numbers of CV segments, 3 other epsilons, 2 other deltas.
    assert len(cells) == 5 * 4 * (4 + 3 + 2) + 2
    for name in PAPER_ESTIMATORS:
        for setting in SETTINGS:
            base = DESIGN.base(name, setting)
            assert all(base in DESIGN.along(field, name, setting) for field in DESIGN.sweeps)


def test_the_full_design_is_the_paper_s():
    design = PaperDesign()
    assert design.sweeps["bandwidth"] == (5, 6, 7, 8, 9, 10, 11)
    assert design.picture("ukf", SETTINGS[0]).bandwidth == 7
    assert len(design.traffic_seeds) >= 20
    base = design.base("mhe", SETTINGS[3])
    assert (base.epsilon, base.delta, base.bandwidth) == (1.0, 0.05, 5)
    assert (base.privacy, base.parameters) == ("corrected", "w99-3lane")


def test_every_cell_runs_under_all_four_settings():
    kinds = {(cell.privacy, cell.parameters) for cell in DESIGN.cells() if cell.estimator == "ekf"}
    assert kinds == {(a, b) for a in ("paper", "corrected") for b in ("paper", "w99-3lane")}


def test_the_open_loop_runs_once_for_each_parameter_set():
    cells = [cell for cell in DESIGN.cells() if cell.estimator == "open_loop"]
    assert [cell.parameters for cell in cells] == ["paper", "w99-3lane"]
    assert len(set(DESIGN.along("epsilon", "open_loop", SETTINGS[0]))) == 1
    ekf = DESIGN.base("ekf", SETTINGS[0])
    assert canonical(ekf) == ekf


def test_sweeps_are_sorted_and_hold_the_base_value():
    design = dataclasses.replace(DESIGN, epsilons=(3.0, 0.2), deltas=(0.2,))
    assert design.sweeps["epsilon"] == (0.2, 1.0, 3.0)
    assert design.sweeps["delta"] == (0.05, 0.2)


def test_baselines_come_last_and_always():
    design = dataclasses.replace(DESIGN, estimators=("mhe", "ekf"))
    assert design.all_estimators == ("ekf", "mhe", *BASELINE_ESTIMATORS)


def test_timed_episodes_alternate_estimators():
    timed = DESIGN.timed()
    assert [seed for _, seed in timed] == sorted(seed for _, seed in timed)
    assert {seed for _, seed in timed} == {2000, 2001, 2002}
    assert [cell.estimator for cell, _ in timed[:6]] == list(DESIGN.all_estimators)


def test_quick_is_a_part_of_the_full_design():
    full, part = PaperDesign(), PaperDesign().quick()
    n_part, n_full = (len(each.cells()) * len(each.traffic_seeds) for each in (part, full))
    assert n_part < n_full / 10
    assert set(part.traffic_seeds) < set(full.traffic_seeds)
    assert set(part.cells()) < set(full.cells())
    assert part.sweeps["bandwidth"] == (5, 8, 11)
    assert part.sweeps["epsilon"] == (0.1, 1.0, 10.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": "2000"}, "seeds must be 2 or more"),
        ({"seeds": "all"}, "must be 'first:stop' or one seed"),
        ({"seeds": "0:4"}, r"test seeds, in 2000\.\.2999.*got 0"),
        ({"seeds": "1999:2001"}, "got 1999"),
        ({"schedule": "random"}, r"schedule must be one of .*round-robin"),
        ({"n_timed": 1}, "n_timed must be >= 2"),
        ({"estimators": ("kf",)}, "estimator must be one of"),
        ({"estimators": ("random_walk",)}, "estimators must be among ekf, ukf, enkf, mhe"),
        ({"cv_segments": (5, 6)}, "cv_segments must be 3 or more"),
        ({"epsilons": (1.0, 2.0)}, "both sides of 1"),
        ({"epsilons": ()}, "both sides of 1"),
        ({"deltas": (0.05,)}, "beside 0.05"),
    ],
)
def test_bad_designs_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(DESIGN, **changes).check()
