import json

import pytest

from agents.search.plan_scores import PlanTask
from dptse_env.schedules.plans import read_plan
from scripts.search_plan import Args, main

SHORT = "dptse_env:dptse/ShortHighway-v0"


def arguments(folder, **changes):
    keywords = {"kind": "optimised-plan", "period": 2, "neighbours": 3, **changes}
    rounds, workers = keywords.pop("rounds", 2), keywords.pop("workers", 1)
    task = PlanTask(env=SHORT, estimator="random_walk", seeds="0:4", **keywords)
    return Args(task=task, rounds=rounds, workers=workers, output=folder)


def test_it_leaves_a_plan_and_goes_on(tmp_path, capsys):
    main(arguments(tmp_path))
    (path,) = tmp_path.glob("*.json")
    assert str(path) in capsys.readouterr().out
    plan = read_plan(path)
    assert plan.provenance["rounds"] == 2
    assert set(plan.provenance["validation"]) == {"plan", "round-robin"}
    assert len(plan.sets) == 2
    main(arguments(tmp_path, rounds=3))
    assert read_plan(path).provenance["rounds"] == 3


def test_workers_find_the_same_plan(tmp_path):
    plans = []
    for workers in (1, 2):
        main(arguments(tmp_path / str(workers), workers=workers))
        (path,) = (tmp_path / str(workers)).glob("*.json")
        plans.append(read_plan(path))
    assert plans[0] == plans[1]


def test_a_static_set_has_one_set(tmp_path):
    main(arguments(tmp_path, kind="best-static"))
    (path,) = tmp_path.glob("best-static-*.json")
    assert len(read_plan(path).sets) == 1


def test_another_search_is_refused(tmp_path):
    main(arguments(tmp_path))
    (path,) = tmp_path.glob("*.json")
    before = path.read_text()
    with pytest.raises(ValueError, match="of another search: period is 2 there and 4 now"):
        main(arguments(tmp_path, period=4))
    assert path.read_text() == before
    assert json.loads(before)["provenance"]["task"]["period"] == 2


def test_bad_rounds_are_named(tmp_path):
    with pytest.raises(ValueError, match="rounds must be"):
        main(arguments(tmp_path, rounds=0))
