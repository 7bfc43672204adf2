import json

import numpy as np
import pytest

from dptse_env.schedules import make_schedule
from dptse_env.schedules.plans import (
    Plan,
    PlanContext,
    read_plan,
    write_plan,
)

from .playing import make_batch, make_single, play

SETS = ((0, 3), (1, 2), (2, 4))


def plan_for(env, sets=SETS, kind="optimised-plan"):
    return Plan(kind, PlanContext.from_config(env.unwrapped.config), sets, {"rounds": 1})


def test_a_plan_is_followed_period_after_period(tmp_path):
    env = make_batch()
    write_plan(tmp_path / "plan.json", plan_for(env))
    queries, _ = play(env, str(tmp_path / "plan.json"), 7)
    for step, query in enumerate(queries):
        expected = np.isin(np.arange(6), SETS[step % 3])
        np.testing.assert_array_equal(query, np.tile(expected, (3, 1)))


def test_a_plan_is_read_back_as_written(tmp_path):
    plan = plan_for(make_batch())
    write_plan(tmp_path / "plan.json", plan)
    assert read_plan(tmp_path / "plan.json") == plan
    assert plan.name.startswith("optimised-plan-short-highway-")
    assert plan.name.endswith("-ekf-b2")


@pytest.mark.parametrize("keywords", [{"bandwidth": 3}], ids=str)
def test_a_plan_for_another_environment_is_refused_with_both_named(tmp_path, keywords):
    env, other = make_single(), make_single(**keywords)
    plan = plan_for(env)
    write_plan(tmp_path / "plan.json", plan)
    with pytest.raises(ValueError, match="was made for") as caught:
        make_schedule(str(tmp_path / "plan.json"), other)
    for place in (plan.context, PlanContext.from_config(other.unwrapped.config)):
        assert str(place) in str(caught.value)


@pytest.mark.parametrize(("changes", "message"), [
    ({"sets": []}, "sets must hold a period, got 0 sets"),
    ({"sets": [[0, 0]]}, r"sets\[0\] must be 2 distinct segments, got \[0, 0\]"),
    ({"sets": [[0, 9]]}, r"sets\[0\] has segment 9, the road has 6"),
], ids=str)  # fmt: skip
def test_a_bad_file_is_named(tmp_path, changes, message):
    path, env = tmp_path / "plan.json", make_single()
    write_plan(path, plan_for(env))
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    with pytest.raises(ValueError, match=message) as caught:
        make_schedule(str(path), env)
    assert str(path) in str(caught.value) or "has segment" in message


def test_a_file_that_is_not_json_or_missing_is_named(tmp_path):
    path = tmp_path / "plan.json"
    with pytest.raises(FileNotFoundError, match=r"plan\.json"):
        make_schedule(str(path), make_single())
    path.write_text("{")
    with pytest.raises(ValueError, match=r"plan\.json must be JSON"):
        make_schedule(str(path), make_single())
