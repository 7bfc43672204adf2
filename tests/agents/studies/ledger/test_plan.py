import dataclasses
import math

import pytest

from agents.environments import make_config
from agents.studies.ledger.cell import CAPPED, EXACT, PACED, FilterSets
from agents.studies.ledger.plan import LedgerDesign
from tests.agents.studies.ledger.made_up import DESIGN, SHORT

FULL = LedgerDesign()


def test_the_full_design_holds_what_the_study_is_about():
    assert len(FULL.traffic_seeds) == 20
    cells = set(FULL.cells())
    for mechanism in (CAPPED, PACED):
        for epsilon in (0.5, 1.0, 2.0, 5.0, 10.0):
            for delta in (0.05, 0.001):
                assert FULL.cell(mechanism, epsilon=epsilon, delta=delta) in cells
        for change in (
            {"adjacency": "add_remove"}, {"unit": "event"}, {"boundary_inputs": "private"},
        ):  # fmt: skip
            assert FULL.cell(mechanism, **change) in cells
        for name in ("ekf", "ekf-demand"):
            assert FULL.cell(mechanism, name, schedule="paper") in cells
        assert FULL.cell(mechanism, "random_walk") in cells
    for pace in (0.6, 0.7, 0.9, 1.0):
        assert FULL.cell(pace=pace) in cells
    for clip in (18.0, 25.0, 35.0, 102.0):
        assert FULL.cell(clip=clip) in cells
    for ratio in (0.25, 0.5):
        assert FULL.cell(ratio=ratio) in cells
    for schedule in FULL.schedules:
        for cell in (
            FULL.cell(CAPPED, schedule=schedule),
            FULL.cell(schedule=schedule),
            FULL.cell(schedule=schedule, pacing="equal-rates"),
        ):
            assert cell in cells
    for unit, bandwidth in (("sums", 5), ("segments", 4), ("segments", 6)):
        assert FULL.cell(span=2, bandwidth=bandwidth, bandwidth_unit=unit) in cells
    assert FULL.cell(bandwidth=10) in cells
    for name in ("ukf-demand", "enkf-demand", "mhe-demand", "random_walk"):
        assert FULL.cell(PACED, name) in cells
        assert FULL.cell(PACED, name, span=2, bandwidth_unit="sums") in cells
    assert FULL.cell(EXACT) in cells
    assert FULL.cell(EXACT, span=2, bandwidth_unit="sums") in cells


def test_cells_that_tables_share_are_run_once():
    cells = FULL.cells()
    assert len(cells) == len(set(cells))
    assert {each.cell for each in FULL.watched} <= set(cells)


def test_every_mechanism_has_the_set_that_was_tuned_for_it():
    sets = FilterSets()
    assert FULL.shipped.settings == sets.capped == sets.paced
    assert FULL.cell(CAPPED).settings == sets.capped_demand
    assert FULL.cell().settings == FULL.cell(EXACT).settings == sets.paced_demand
    assert FULL.cell(CAPPED, "random_walk").settings == sets.capped_walk
    names = [cell.settings for _, cell in FULL.filters()]
    assert names[0] == sets.paced_demand
    assert len(set(names)) == len(names) == 5
    assert all(name.endswith("-w99-3lane-paced") for name in names)


def test_a_rung_rests_on_an_earlier_one():
    for design in (FULL, DESIGN):
        seen = set()
        for rung in design.ladder():
            assert rung.base is None or rung.base in seen
            seen.add(rung.cell)


def test_the_ladder_is_the_same_at_every_guarantee():
    for epsilon, delta in FULL.guarantees:
        for rung, base in zip(FULL.ladder(epsilon, delta), FULL.ladder(), strict=True):
            assert rung.label == base.label
            if rung.cell.mechanism != EXACT:
                assert rung.cell == dataclasses.replace(base.cell, epsilon=epsilon, delta=delta)


@pytest.mark.parametrize("cell", DESIGN.cells(), ids=str)
def test_the_environment_is_what_the_cell_says(cell):
    config = make_config(SHORT, cell.keywords)
    privacy = config.privacy
    assert config.estimator == cell.filter_name.removesuffix("-demand")
    assert config.bandwidth == cell.bandwidth
    assert privacy.boundary == cell.boundary_inputs
    if cell.mechanism == EXACT:
        assert "Exact" in privacy.preset
        assert (cell.epsilon, cell.delta, privacy.clip) == (math.inf, 0.0, cell.clip)
        return
    assert privacy.preset == cell.mechanism
    assert (privacy.epsilon, privacy.delta) == (cell.epsilon, cell.delta)
    assert (privacy.adjacency, privacy.unit) == (cell.adjacency, cell.unit)
    if cell.mechanism == PACED:
        assert (privacy.pace, privacy.clip, privacy.ratio) == (cell.pace, cell.clip, cell.ratio)
        assert ("EqualRates" in privacy.pacing) == (cell.pacing == "equal-rates")


def test_sums_are_asked_for_by_keywords_and_segments_by_none():
    keywords = FULL.sums().keywords
    assert (keywords["query_spans"], keywords["bandwidth_unit"]) == ([2], "sums")
    assert not {"query_spans", "bandwidth_unit"} & FULL.cell().keywords.keys()


def test_sums_can_be_left_out():
    assert all(cell.span == 1 for cell in DESIGN.cells())


def test_what_a_mechanism_does_not_have_makes_no_further_cell():
    assert DESIGN.cell(CAPPED, pace=0.6, clip=18.0, ratio=0.5) == DESIGN.cell(CAPPED)
    assert DESIGN.cell(EXACT, epsilon=1.0, pace=0.6, adjacency="add_remove") == DESIGN.cell(EXACT)
    assert DESIGN.cell(EXACT, clip=18.0) != DESIGN.cell(EXACT)


def test_grids_are_sorted_and_hold_the_base_values():
    assert DESIGN.epsilons == (1.0, 5.0, 10.0)
    assert DESIGN.paces == (0.8, 1.0)
    assert DESIGN.clips == (25.0, 51.0)


def test_quick_is_a_part_of_the_full_design():
    quick = FULL.quick()
    assert set(quick.cells()) < set(FULL.cells())
    assert set(quick.traffic_seeds) < set(FULL.traffic_seeds)
    n_quick, n_full = (len(each.cells()) * len(each.traffic_seeds) for each in (quick, FULL))
    assert n_quick < n_full / 8


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": "7:9"}, r"test seeds, in 2000\.\.2999.*got 7"),
        ({"schedules": ("paper", "oracle-error")}, "schedules must be distinct and of .*paper"),
        ({"schedules": ("paper", "paper")}, "schedules must be distinct"),
        ({"schedules": ()}, "schedules must be distinct"),
        ({"epsilons": ()}, "epsilons must hold a value beside 5"),
        ({"paces": (0.8,)}, "paces must hold a value beside 0.8"),
        ({"schedule": "random"}, r"schedule must be one of .*round-robin"),
    ],
)
def test_bad_designs_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(DESIGN, **changes).check()


def test_an_unknown_set_of_settings_is_named_before_anything_is_run():
    design = dataclasses.replace(DESIGN, sets=dataclasses.replace(DESIGN.sets, paced="best"))
    with pytest.raises(ValueError, match=r"estimator_settings must be one of .*got 'best'"):
        design.configs  # noqa: B018
