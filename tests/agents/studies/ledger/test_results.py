import dataclasses
import math

import numpy as np
import pytest

from agents.experiments.cells import DENSITY, METRICS
from agents.experiments.provenance import design_provenance
from agents.experiments.reports import fill
from agents.statistics import Interval
from agents.studies.ledger import sentences, study, tables
from agents.studies.ledger.cell import CAPPED, EXACT, PACED
from agents.studies.ledger.expectations import EXPECTATIONS, judge_all
from agents.studies.ledger.figures import draw_epsilon, draw_ladder, draw_ledgers
from agents.studies.ledger.results import REFUSED, crossing
from tests.agents.studies.ledger.made_up import DESIGN, N_MAINLINE, make_up, trip_sums


def errors(cell):
    """Paced ledgers err less than capped contributions, and less with more epsilon."""
    if cell.mechanism == EXACT:
        return 5.0
    return {CAPPED: 20.0, PACED: 16.0}[cell.mechanism] - 2.0 * math.log(cell.epsilon)


@pytest.fixture(scope="module")
def results():
    return make_up(errors, n_refused=20)


@pytest.mark.parametrize(
    ("values", "place"),
    [((2.0, 1.0, -1.0), 20.0), ((-1.0, -2.0, -3.0), 0.0), ((3.0, 2.0, 1.0), math.inf)],
)
def test_a_crossing_is_found_in_the_logarithm(values, place):
    assert crossing((1.0, 4.0, 100.0), values) == pytest.approx(place)


def test_the_equal_error_is_where_the_curves_meet(results):
    # Capped at 5 errs as much as paced at an epsilon lower by the factor exp(-4 / 2).
    equal = results.equal_error(DESIGN.cell(CAPPED, epsilon=10.0), DESIGN.delta)
    assert equal.epsilon == pytest.approx(10.0 * math.exp(-2.0), rel=1e-6)
    assert equal.low <= equal.epsilon <= equal.high
    assert results.equal_error(DESIGN.cell(CAPPED), DESIGN.delta).epsilon == 0.0
    assert math.isinf(results.equal_error(DESIGN.cell(EXACT), DESIGN.delta).epsilon)


def test_percentages_and_counts_of_traffic_are_paired(results):
    base, capped = DESIGN.cell(), DESIGN.cell(CAPPED)
    assert results.n_lower(base, capped) == 3
    assert results.n_lower(capped, base) == 0
    assert -24.0 < results.percent(base, capped).mean < -10.0
    assert results.mean(base, REFUSED).mean == pytest.approx(2.0)


def test_lengths_with_too_few_trips_have_no_share():
    def trips(seed):
        return trip_sums(seed, last=50 if seed < 2002 else 0)

    cell = DESIGN.cell()
    spent = make_up(errors, trips=trips).spent_by_length(cell)
    assert spent[0].mean == spent[-1].mean == pytest.approx(50.0)
    assert (spent[0].n, spent[-1].n) == (3, 2)
    assert spent[1] is None
    refused = make_up(errors, trips=trips).refused_by_length(cell)
    assert refused[0].mean == pytest.approx(2.0)


def test_the_place_of_most_refusals_is_named(results):
    places = results.refused_by_place(DESIGN.cell())
    assert [each.mean for each in places] == [*([0.0] * (N_MAINLINE - 1)), 10.0]
    assert sentences.refusal_numbers(results)["place"] == N_MAINLINE - 1
    assert f"{N_MAINLINE - 1}: 10.00" in tables.ledger_table(results)


def test_what_falls_short_is_said():
    assert not any("Schedules" in line for line in sentences.shortfalls(make_up(errors)))

    def worse(cell):
        return errors(cell) + (9.0 if cell.mechanism == PACED else 0.0)

    lines = sentences.shortfalls(make_up(worse))
    (line,) = (line for line in lines if "Schedules" in line)
    assert "`round-robin`" in line
    (line,) = (line for line in lines if "Guarantees" in line)
    assert "(5, 0.05)" in line
    assert any("missed" in line for line in lines)


def test_a_better_setting_than_the_base_is_said():
    def better(cell):
        return errors(cell) - (1.0 if cell.pace == 1.0 else 0.0)

    lines = sentences.shortfalls(make_up(better))
    assert any("the pace, 0.8" in line and "with 1" in line for line in lines)
    assert not any("the pace" in line for line in sentences.shortfalls(make_up(errors)))


def test_schedules_are_sorted_by_the_pacing_that_they_need():
    def staring(cell):
        needs = cell.schedule == "largest-variance" and cell.pacing == "equal-rates"
        return errors(cell) + (2.0 if needs else 0.0)

    policies = sentences.policy_numbers(make_up(staring))
    assert policies["need_following"] == ["largest-variance"]
    assert policies["need_equal"] == []
    assert policies["either"] == ["round-robin"]


@pytest.mark.parametrize(
    ("interval", "verdict"),
    [
        (Interval(-31.0, -32.0, -30.0, 3), "met"),
        (Interval(-30.0, -32.0, -28.0, 3), "undecided"),
        (Interval(-20.0, -29.0, -11.0, 3), "missed"),
    ],
)
def test_an_expectation_is_judged_by_the_interval(interval, verdict, results):
    expectation = dataclasses.replace(EXPECTATIONS[0], limit=-30.0)
    assert expectation.verdict(interval) == verdict


def test_nothing_is_expected_of_what_was_not_run(results):
    statements = [each.statement for each in judge_all(results)]
    assert len(statements) == sum(not each.needs_pairs for each in EXPECTATIONS)
    assert any("ε = 1 − `capped` as shipped at ε = 5" in text for text in statements)


def test_the_report_holds_every_table(results):
    provenance = design_provenance(DESIGN)
    content = study.report(results, provenance, "the command")
    text = fill(study.TEMPLATES, content)
    for name in ("ladder", "guarantees", "variants", "settings", "policy", "policy_speed",
                 "ledger", "expectation", "health"):  # fmt: skip
        assert getattr(tables, f"{name}_table")(results) in text
    for metric in METRICS:
        assert tables.epsilon_table(results, metric) in text
    for table in (tables.place_table, tables.length_table):
        assert table(results, content["shown"]) in text
    for line in content["shortfalls"]:
        assert line in text
    assert "the command" in text
    assert "evaluation alone" in text


def test_an_equal_error_beyond_the_grid_is_said_to_be_there(results):
    text = fill(study.TEMPLATES, study.report(results, design_provenance(DESIGN), "the command"))
    assert "with ε = below 1 " in text


def test_figures_show_every_cell(results):
    for axis in draw_epsilon(results).axes:
        assert len(axis.containers) == 4
    means = draw_epsilon(results).axes[0].containers[2].lines[0].get_ydata()
    cells = DESIGN.along_epsilon(PACED, DESIGN.delta)
    np.testing.assert_allclose(means, [each.mean for each in results.means(cells, DENSITY)])
    for axis in draw_ladder(results).axes:
        assert len(axis.containers) == len(DESIGN.ladder())
    shown = study.shown_trips(DESIGN)
    for axis in draw_ledgers(results, shown).axes:
        assert len(axis.containers) == len(shown)
