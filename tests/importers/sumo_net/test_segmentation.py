import re
from itertools import pairwise
from xml.etree import ElementTree

import pytest

from dptse_env.importers.sumo_net import Files, segment_path
from tests.importers.sumo_net.conftest import NODES, PATH, netconvert


def lengths_of_edges(net):
    """Return the length of every edge, internal ones included [m]."""
    return {
        edge.get("id"): max(float(lane.get("length")) for lane in edge.iter("lane"))
        for edge in ElementTree.parse(net).iter("edge")
    }


def test_segments_cover_the_path_without_gaps(files):
    segments = segment_path(files, PATH, 100.0)
    edges = lengths_of_edges(files.net)
    S, columns = segments.geometry.n_segments, segments.columns
    on_path = [*columns[S : S + 1], *columns[: S - 2], columns[S + 1]]
    stretches = [stretch for column in on_path for stretch in column]
    for name in PATH:
        parts = [(start, end) for edge, start, end in stretches if edge == name]
        assert parts[0][0] == 0.0
        assert parts[-1][1] == pytest.approx(edges[name], abs=0.01)
        assert all(end == start for (_, end), (start, _) in pairwise(parts))
    internal = {edge for edge, _, _ in stretches if edge.startswith(":")}
    assert len(internal) == 5  # four junctions along the path, and one way out of it
    lengths = segments.geometry.segment_lengths
    total = 1000 * (sum(lengths[:-2]) + 2 * lengths[0])
    crossings = sum(edges[edge] for edge in internal)
    assert total == pytest.approx(sum(edges[name] for name in PATH) + crossings, rel=0.02)


def test_ramps_lie_at_faces_and_acceleration_lanes_count_as_lanes_of_the_mainline(files):
    segments, longer = (segment_path(files, PATH, length) for length in (100.0, 150.0))
    road = segments.geometry
    (on,), (off,) = road.on_ramps, road.off_ramps
    assert on == 3  # 400 m before the junction are four parts, the first of them the boundary
    assert segments.names == ("ramp-b", "exit-a")
    between = road.segment_lengths[on:off]
    assert between == pytest.approx([between[0]] * len(between), abs=1e-4)
    assert 0.09 < between[0] < 0.11
    assert road.segment_lengths[-2:] == (0.1, 0.1)
    near = segment_path(files, PATH, 100.0, ends=(290.0, None)).geometry
    assert near.on_ramps == (1,)  # a stretch of little over 100 m also has a boundary segment
    assert road.segment_lanes[:on] == (2,) * on
    # 250 m: two segments, and less than half of one
    assert road.segment_lanes[on : on + 2] == (3, 3)
    assert set(road.segment_lanes[on + 3 : -2]) == {2}
    assert longer.geometry.segment_lanes[longer.geometry.on_ramps[0] + 1] == 3  # two thirds of it
    assert road.speed_limits[0] == 108.0
    assert road.speed_limits[road.n_mainline - 1] == 90.0
    # Ramps of several edges go on behind a boundary inside an edge.
    ramp, before = longer.columns[longer.geometry.n_mainline], longer.columns[-2]
    assert {edge for edge, _, _ in ramp if not edge.startswith(":")} == {"ramp-b"}
    assert {edge for edge, _, _ in before if not edge.startswith(":")} == {"ramp-b", "ramp-a"}
    part = segment_path(files, PATH, 100.0, ends=(150.0, 300.0))
    n = part.geometry.n_mainline
    assert n < road.n_mainline
    (upstream,) = part.columns[n + 2]
    assert upstream[:2] == ("in", 150.0)
    assert part.columns[n + 3][-1] == ("out", pytest.approx(200.0, abs=5.0), 300.0)


def test_roads_that_meet_at_one_junction_are_one_ramp(tmp_path):
    net = netconvert(
        tmp_path,
        '<edge id="second" from="alone" to="n1" numLanes="1" speed="20"/>',
        '<connection from="second" to="merge" fromLane="0" toLane="2"/>',
    )
    segments = segment_path(Files(net, ()), PATH, 100.0)
    assert segments.names[0] == "ramp-b + second"
    assert segments.geometry.ramp_lanes == (2, 1)
    columns = segments.columns[segments.geometry.n_mainline]
    assert {"ramp-b", "second"} <= {edge for edge, _, _ in columns}


def test_a_lay_by_is_an_off_ramp_and_an_on_ramp_on_either_half(tmp_path):
    net = netconvert(
        tmp_path,
        '<edge id="lay-by" from="n2" to="n3" numLanes="1" speed="20" '
        'shape="650,0 700,-30 950,-30 1000,0"/>',
        '<connection from="merge" to="lay-by" fromLane="0" toLane="0"/>'
        '<connection from="lay-by" to="bend" fromLane="0" toLane="0"/>',
    )
    segments = segment_path(Files(net, ()), PATH, 100.0)
    assert segments.names == ("ramp-b", "lay-by", "lay-by", "exit-a")
    N = segments.geometry.n_mainline
    joining, leaving = segments.columns[N + 1], segments.columns[N + 2]
    assert leaving[0][:2] == ("lay-by", 0.0)
    assert joining[0][1] > leaving[0][2] + 100.0  # the two boundary segments lie between them
    # Not one vehicle can be on two columns: the road would be refused.
    taken = sorted((s, e) for column in segments.columns for n, s, e in column if n == "lay-by")
    assert all(end <= start for (_, end), (start, _) in pairwise(taken))


@pytest.mark.parametrize(
    ("path", "options", "message"),
    [
        (("in", "merg", "narrow"), {}, "no edge 'merg'; similar: merge"),
        (("in", "narrow"), {}, "'in' must be connected to 'narrow', got connections to merge"),
        (("in", "elsewhere"), {"between": True}, "'elsewhere' must be reachable from 'in'"),
        (PATH, {"ends": (450.0, None)}, "first_position must be in [0, "),
        (PATH, {"left_out": ("narrow",)}, "leave_out: 'narrow' must be an edge that joins"),
        (("in", "merge"), {"ends": (350.0, None)}, "from its start to on-ramp ramp-b"),
        (("in",), {"ends": (200.0, 100.0)}, "from its start to its end for its segments"),
    ],
)
def test_paths_of_no_use_are_refused_in_one_line(files, path, options, message):
    with pytest.raises(ValueError, match=re.escape(message)) as refused:
        segment_path(files, path, 100.0, **options)
    assert "\n" not in str(refused.value)


def test_ramps_too_near_to_one_another_are_refused_by_name(tmp_path):
    net = netconvert(
        tmp_path,
        '<edge id="off" from="n2" to="r0" numLanes="1" speed="20"/>',
        '<connection from="merge" to="off" fromLane="0" toLane="0"/>',
        NODES.replace('<node id="n2" x="650" y="0"/>', '<node id="n2" x="425" y="0"/>'),
    )
    found = Files(net, ())
    with pytest.raises(
        ValueError, match=r'on-ramp ramp-b and off-ramp off are \d+ m apart; .* --leave-out="off"$'
    ):
        segment_path(found, PATH, 100.0)
    kept = segment_path(found, PATH, 100.0, left_out=("off",))
    assert kept.names == ("ramp-b", "exit-a")
    assert any(remark.startswith("left out: off") for remark in kept.remarks)
