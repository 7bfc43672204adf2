import dataclasses

import pytest

from agents.studies.policies.plan import (
    BASELINES,
    CELLS,
    PAPER,
    PRIVATE,
    PolicyDesign,
)
from agents.studies.policies.running import cell_config
from dptse_env.config import parse_seeds
from dptse_env.schedules import ORACLES
from scripts.train import Args
from tests.agents.studies.policies.worlds import SMALL


def test_the_full_design_is_that_of_the_study():
    design = PolicyDesign()
    assert (len(design.validation_seeds), len(design.test_seeds)) == (64, 64)
    cells = {cell.name: cell for cell in design.cells}
    assert next(iter(cells)) == "primary"
    configs = {name: cell_config(cell, (0,)) for name, cell in cells.items()}
    primary = configs["primary"]
    assert (cells["primary"].env, cells["paper"].env) == (PRIVATE, PAPER)
    assert (primary.estimator, primary.bandwidth) == ("ekf", 5)
    assert (primary.privacy.preset, primary.privacy.epsilon) == ("capped", 5.0)
    changes = {
        "bandwidth-3": {"bandwidth": 3},
        "bandwidth-7": {"bandwidth": 7},
        "ukf": {"estimator": "ukf"},
        "mhe": {"estimator": "mhe"},
        "epsilon-1": {"privacy": dataclasses.replace(primary.privacy, epsilon=1.0)},
        "epsilon-10": {"privacy": dataclasses.replace(primary.privacy, epsilon=10.0)},
    }
    for name, change in changes.items():
        assert configs[name] == dataclasses.replace(primary, **change)
    fixed = configs["paper-incident"].corridor
    assert fixed.incident == configs["paper"].corridor.incident
    assert fixed.demand == primary.corridor.demand
    # PaperHighway releases speeds in place of flows: another observation.
    assert {name for name, cell in cells.items() if not cell.transfers} == {"primary", "paper"}
    assert not set(BASELINES) & set(ORACLES)
    assert {"paper", "round-robin", "largest-variance", "greedy-trace"} <= set(BASELINES)


def test_recipes_are_not_chosen_where_trainings_chose_their_best_policy():
    kept_by = parse_seeds(Args().validation)
    assert not set(kept_by) & set(PolicyDesign().validation_seeds)


def test_quick_is_a_part_of_the_full_design():
    part = PolicyDesign().quick()
    assert [cell.name for cell in part.cells] == ["primary"]
    assert set(part.test_seeds) < set(PolicyDesign().test_seeds)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cells": CELLS[1:]}, "begin with 'primary'"),
        ({"cells": (CELLS[0], CELLS[0])}, "distinct"),
        ({"test_seeds": (1000, 1001)}, "test_seeds must be test seeds"),
        ({"validation_seeds": (2000, 2001)}, r"in 1000\.\.1999"),
        ({"validation_seeds": (1000,)}, "2 or more"),
        ({"baselines": ("oldest-first",)}, "hold 'paper' and no oracle"),
        ({"baselines": ("paper", "oracle-error")}, "no oracle"),
    ],
)
def test_bad_designs_are_named(changes, message):
    with pytest.raises(ValueError, match=message):
        PolicyDesign(**changes)


def test_a_design_survives_json():
    for design in (PolicyDesign(), SMALL):
        again = PolicyDesign.from_json(design.to_json())
        assert again.to_json() == design.to_json()
        configs = [[cell_config(cell, (0,)) for cell in each.cells] for each in (design, again)]
        assert configs[0] == configs[1]


def test_designs_of_earlier_manifests_are_read():
    content = SMALL.to_json()
    for cell in content["cells"]:
        cell["says"] = cell.pop("description")
    assert PolicyDesign.from_json(content).to_json() == SMALL.to_json()
