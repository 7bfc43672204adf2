"""Privacy reports: their form in ``info``, and what voids them."""

import dataclasses
import json

import pytest

from dptse_env.config import resolve
from dptse_env.parts import privacy_report
from dptse_env.release import VOID_REASONS
from dptse_env.release.report import in_order

OWN = {
    "printed": {"adjacency"},
    "capped": {"unit", "cap", "adjacency", "share"},
    "paced": {"unit", "adjacency", "pace", "clip", "ratio"},
}


@pytest.mark.parametrize(
    ("preset", "penetration"), [("printed", 0.5), ("capped", 1.0), ("capped", 0.5), ("paced", 0.5)]
)
def test_the_dict_is_its_own_json_and_fresh_each_time(preset, penetration):
    keywords = {"privacy": preset, "penetration": penetration}
    found = privacy_report(resolve("paper-highway", keywords))
    first = found.to_dict()
    assert json.loads(json.dumps(first, allow_nan=False)) == first
    fields = {field.name for field in dataclasses.fields(found)} - {"details"}
    groups = {"groups"} if penetration < 1.0 else set()
    assert set(first) == fields | OWN[preset] | groups
    # Gymnasium's vector form would be a column of None, which libraries stumble over.
    assert None not in first.values()
    again = found.to_dict()
    first["void_reasons"].append("more")
    first["assumptions"].clear()
    for group in first.get("groups", []):
        group.clear()
    assert found.to_dict() == again


@pytest.mark.parametrize(
    ("keywords", "reasons"),
    [
        ({}, ()),
        ({"truth_in_info": True}, ("truth_in_info",)),
        ({"privacy": {"boundary_inputs": "true"}}, ("boundary_inputs",)),
        ({"corridor": {"measured": ["demand"]}}, ("measured_values",)),
    ],
)
def test_whatever_else_depends_on_the_traffic_voids_a_guarantee(keywords, reasons):
    found = privacy_report(resolve("private-highway", keywords))
    assert found.void_reasons == reasons
    assert (found.guarantee == "none") == bool(reasons)
    assert found.voided(["own"]).void_reasons == (*reasons, "own")


def test_reasons_come_in_the_order_of_the_table_and_unknown_ones_last():
    names = list(VOID_REASONS)
    assert in_order(["z", names[3], "a", names[0]]) == (names[0], names[3], "a", "z")
