"""Privacy reports: their form in ``info``, and what voids them."""

import dataclasses
import json

import numpy as np
import pytest

from dptse_env.config import resolve
from dptse_env.parts import privacy_report
from dptse_env.release import VOID_REASONS
from dptse_env.release.report import in_order
from tests.helpers import SumRelease

OWN = {
    "printed": {"adjacency"},
    "capped": {"unit", "cap", "adjacency", "share"},
    "paced": {"unit", "adjacency", "clip", "ratio"},
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
    unstated = dataclasses.replace(found, mu=np.inf, epsilon=np.inf).to_dict()
    assert (unstated["mu"], unstated["epsilon"]) == (None, None)


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


WHOLE, PARTLY, EVENT = {}, {"penetration": 0.1}, {"unit": "event", "adjacency": "add_remove"}
TRIP = "one vehicle's whole trip"
CAPPED = f"{TRIP} (counted in the first 64 seconds in which it is observed, then no more)"
TOGETHER = "under queries and fixed sensors together"
PROTECTED = [
    ("paced", WHOLE, f"{TRIP}, replaced by any other, connected or not, or by none"),
    (
        "paced",
        PARTLY,
        f"a connected vehicle: {TRIP}, replaced by any other, connected or not, or by none, "
        f"{TOGETHER}",
    ),
    ("capped", WHOLE, f"{CAPPED}, replaced by any other, connected or not, or by none"),
    (
        {"preset": "capped", **EVENT},
        WHOLE,
        "one second of one vehicle's trip, added or removed",
    ),
    ({"preset": "paced", **EVENT}, WHOLE, "one vehicle's second of a trip, added or removed"),
    (
        "printed",
        PARTLY,
        f"a connected vehicle: one vehicle's trip, replaced by another, {TOGETHER}",
    ),
]


@pytest.mark.parametrize("loops", [None, {"positions": [0.5]}])
@pytest.mark.parametrize(
    ("sensors", "boundary", "together"),
    [
        ((), "nominal", ""),
        ((), "private", ", under queries and boundary segments together"),
        ((3,), "private", f", {TOGETHER}"),
    ],
)
def test_a_report_names_those_alone_who_see_a_vehicle(sensors, boundary, together, loops):
    keywords = {
        "penetration": 0.2, "corridor": {"fixed_sensors": sensors}, "loops": loops,
        "privacy": {"preset": "paced", "boundary_inputs": boundary},
    }  # fmt: skip
    found = privacy_report(resolve("private-highway", keywords))
    change = "left out" if loops else "or by none"
    for said in (found.protects, found.guarantee):
        after = said.partition(change)[2]
        assert after.startswith(together)
        assert ("together" in after) == bool(together)


GIVEN = ", given the counts and speeds of the loops, which are public and not protected"
ALONE = "; a vehicle alone in an interval shows its speed there, as loops.least_count is below 2"
CHANGES = {
    "replaced by any other, connected or not, or by none": "replaced by others or left out",
    "replaced by another": "replaced by others",
    "added or removed": "added or left out",
}


@pytest.mark.parametrize(("privacy", "keywords", "protects"), PROTECTED, ids=range(len(PROTECTED)))
@pytest.mark.parametrize("least_count", [0, 2])
def test_a_report_protects_presence_and_beside_loops_reports_given_the_readings(
    privacy, keywords, protects, least_count
):
    """All numbers stay: nothing is paid for a loop, and nothing is kept for it."""
    loops = {"positions": [0.5, 1.0], "interval": 60, "least_count": least_count}
    without, beside = (
        privacy_report(resolve("private-highway", {"privacy": privacy, **keywords, **more}))
        for more in ({}, {"loops": loops})
    )
    without, beside = without.to_dict(), beside.to_dict()
    assert json.loads(json.dumps(beside)) == beside
    assert without["protects"] == protects
    assert "loops" not in str(without)
    for rows, reports in CHANGES.items():
        protects = protects.replace(rows, reports)
    reports = (
        f"the reports of a connected vehicle: {protects.removeprefix('a connected vehicle: ')}"
    )
    given = GIVEN + (ALONE if least_count < 2 else "")
    assert beside.pop("protects") == reports + given
    assert beside.pop("loops") == {**loops, "ramps": []}
    claim, found = without.pop("guarantee"), beside.pop("guarantee")
    claimed = claim.replace(without.pop("protects"), reports) + given
    assert found == ("none" if claim == "none" else claimed)
    assert beside == without


class Claims(SumRelease):
    """States a guarantee of its own."""

    def report(self):
        own = {"guarantee": "a claim", "protects": "a trip", "void_reasons": ()}
        return dataclasses.replace(super().report(), **own)


def test_the_claim_of_a_foreign_model_is_conditional_on_loops_too():
    privacy = {"preset": Claims, "boundary_inputs": "nominal"}
    loops = {"positions": [0.3], "least_count": 5}
    found = privacy_report(resolve("short-highway", {"privacy": privacy, "loops": loops}))
    assert (found.guarantee, found.protects) == ("a claim" + GIVEN, "a trip" + GIVEN)
    assert found.void_reasons == ()


def test_reasons_come_in_the_order_of_the_table_and_unknown_ones_last():
    names = list(VOID_REASONS)
    assert in_order([*"hgfedcba", names[3], names[0]]) == (names[0], names[3], *"abcdefgh")
