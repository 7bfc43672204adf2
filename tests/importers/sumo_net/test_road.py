"""Records of a SUMO net of one's own, against what SUMO says of it."""

import dataclasses
import gzip
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from dptse_env.importers.sumo_net import Files, import_road, read_configuration, segment_path
from dptse_env.traffic import (
    MAINLINE,
    SHORT_HIGHWAY,
    DemandDistribution,
    Drivers,
    Incident,
    RecordingError,
    RecordLibrary,
    draw_scenario,
    read_corridor,
    simulate,
    write_corridor,
)
from dptse_env.traffic.own_sumo import TRAFFIC, copy_input
from dptse_env.traffic.sumo import running, seconds
from dptse_env.traffic.sumo_input import packaged_net
from dptse_env.utils.files import file_digest
from tests.helpers import ROOT
from tests.importers.sumo_net.conftest import FLOWS, PATH


def imported(files, **options):
    return import_road(files, segment_path(files, PATH, 100.0), "motorway", 240, **options)


@pytest.fixture(scope="module")
def road(files):
    return imported(files)


ELSEWHERE = '<routes><vehicle id="v" depart="0"><route edges="elsewhere"/></vehicle></routes>'


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (ELSEWHERE, "routes: own.rou.xml must have vehicles that use the path from 0 s to 60 s"),
        (
            ELSEWHERE.replace("elsewhere", "nowhere"),
            "SUMO refuses these files: recording road with traffic seed 0 failed",
        ),
        (None, "routes: must have at least one file for "),
    ],
)
def test_routes_of_no_use_are_refused(files, tmp_path, content, message):
    path = tmp_path / "own.rou.xml"
    path.write_text(content or "")
    own = dataclasses.replace(files, routes=(path,) if content else ())
    with pytest.raises(ValueError, match=re.escape(message)) as refused:
        import_road(own, segment_path(files, PATH, 100.0), "road", 60)
    assert "\n" not in str(refused.value)


def test_every_vehicle_on_the_path_and_its_ramps_is_counted_once(road):
    corridor = road.corridor
    limits = {}
    for column in corridor.sumo.columns:
        for edge, start, end in column:
            low, high = limits.get(edge, (np.inf, 0.0))
            limits[edge] = min(low, start), max(high, end)
    assert sum(edge.startswith(":") for edge in limits) == 7  # also in the middle of junctions
    counts = []
    scenario = draw_scenario(corridor, 0)
    with running(corridor, scenario) as libsumo:
        for _ in seconds(libsumo, corridor, scenario):
            places = {
                name: libsumo.vehicle.getLanePosition(name)
                for edge in limits
                for name in libsumo.edge.getLastStepVehicleIDs(edge)
                if limits[edge][0] - 0.01
                <= libsumo.vehicle.getLanePosition(name)
                <= limits[edge][1] + 0.01
            }
            counts.append(len(places))
    np.testing.assert_array_equal(road.record.counts.sum(axis=1), counts)
    assert max(counts) > 30


def test_the_record_is_that_of_the_generated_net_if_the_files_are_the_same(tmp_path):
    calm = SHORT_HIGHWAY.replaced(incident=None)
    scenario = draw_scenario(calm, 3)
    net, routes = tmp_path / "short.net.xml", tmp_path / "short.rou.xml"
    net.write_text(packaged_net("short-highway"))
    routes.write_bytes(ElementTree.tostring(_vehicles(calm, scenario)))
    files = Files(
        net,
        (routes,),
        step_length=0.5,
        options=("--no-internal-links", "--collision.action=none", "--time-to-teleport=-1"),
    )
    path = ["upstream", *(f"main_{i}" for i in range(6)), "downstream"]
    road = import_road(files, segment_path(files, path, 100.0), "short", 240, seed=3)
    expected = simulate(calm, 3)
    for name in ("step", "segment", "speed"):
        np.testing.assert_array_equal(getattr(road.record, name), getattr(expected, name))
    pairs = set(zip(road.record.vehicle.tolist(), expected.vehicle.tolist(), strict=True))
    assert len(pairs) == len(set(expected.vehicle)) == road.record.n_vehicles
    found, fields = road.corridor.fields(), calm.fields()
    same = ("n_mainline", "on_ramps", "off_ramps", "fixed_sensors", "lanes", "ramp_lanes")
    for name in (*same, "segment_length", "speed_limit", "density_scale", "speed_scale"):
        assert found[name] == fields[name], name


def _vehicles(corridor, scenario):
    """Write a scenario of a generated net as SUMO's routes."""
    root = ElementTree.Element("routes")
    ElementTree.SubElement(root, "vType", {"id": "car", **corridor.conditions.drivers.attributes()})
    for i, origin in enumerate(scenario.origins):
        end = scenario.exits[i]
        first = 0 if origin == MAINLINE else corridor.geometry.on_ramps[origin]
        last = corridor.geometry.n_mainline if end == MAINLINE else corridor.geometry.off_ramps[end]
        start = ["upstream"] if origin == MAINLINE else [f"before_on_{origin}", f"on_{origin}"]
        stop = ["downstream"] if end == MAINLINE else [f"off_{end}", f"after_off_{end}"]
        edges = [*start, *(f"main_{k}" for k in range(first, last)), *stop]
        vehicle = ElementTree.SubElement(
            root, "vehicle", id=f"car-{i}", type="car", depart=f"{scenario.departures[i]:.3f}",
            departSpeed="max", departLane="best",
        )  # fmt: skip
        ElementTree.SubElement(vehicle, "route", edges=" ".join(edges))
    return root


def test_vehicles_out_of_order_depart_and_what_nobody_takes_is_told(files, tmp_path):
    routes = FLOWS.replace('id="l"', 'id="l" begin="300"')  # before the flow that joins
    lines = [line for line in routes.splitlines() if "flow" in line]
    in_order = routes.replace(lines[1] + "\n", "").replace(lines[2], f"{lines[2]}\n{lines[1]}")
    roads = []
    for name, text in (("mixed", routes), ("in-order", in_order)):
        (tmp_path / name).write_text(text)
        own = dataclasses.replace(files, routes=(tmp_path / name,))
        roads.append(import_road(own, segment_path(own, PATH, 100.0), "road", 60))
    mixed, sorted_road = roads
    assert mixed.record.digest == sorted_road.record.digest
    assert "mixed: out of order of departure" in " ".join(mixed.remarks)
    assert "out of order" not in " ".join(sorted_road.remarks)
    assert {f"no vehicle leaves {how}" for how in ("at the downstream end", "by exit-a")} <= {
        *mixed.remarks
    }


def test_vehicles_that_do_not_depart_are_told_when_they_are_recorded(road, tmp_path, caplog):
    crowded = DemandDistribution(road.corridor.conditions.published_demand, (6.0, 6.0))
    corridor = road.corridor.replaced(demand=crowded, duration=60)
    RecordLibrary(tmp_path).ensure(corridor, [0, 1])
    (message,) = caplog.messages
    assert re.fullmatch(
        r"motorway, traffic seeds 0\.\.1: for instance \d+ of \d+ vehicles that .* not departed",
        message,
    )


LOCAL = """
import pathlib, sys
from dptse_env.importers.sumo_net import Files, segment_path, import_road
from dptse_env.traffic import RecordLibrary, SHORT_HIGHWAY
files = Files(pathlib.Path("road.net.xml"), (pathlib.Path("road.rou.xml"),))
road = import_road(files, segment_path(files, sys.argv[1:], 100.0), "road", 30).corridor
longer = SHORT_HIGHWAY.replaced(segment_length=0.15, duration=30, incident=None)
for corridor in (road, SHORT_HIGHWAY, longer):
    print(RecordLibrary("Aufzeichnungen für mich").get(corridor, 0).n_rows)
"""


def test_letters_beyond_ascii_in_folders_are_of_no_matter(files, tmp_path):
    folder = tmp_path / "Meine Straße"
    folder.mkdir()
    for path in (files.net, *files.routes):
        shutil.copy(path, folder)
    places = dict.fromkeys(("TMPDIR", "HOME", "TEMP", "TMP"), str(folder))
    done = subprocess.run(
        [sys.executable, "-c", LOCAL, *PATH],
        env=os.environ | places | {"LC_ALL": "C", "PYTHONPATH": str(ROOT)},
        cwd=folder, capture_output=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr.decode()
    assert all(int(count) > 0 for count in done.stdout.split())


def test_demand_exit_shares_and_dwell_are_counted(road):
    corridor = road.corridor
    rates = [rate for _, rate in corridor.conditions.demand.mainline]
    assert np.mean(rates) == pytest.approx(1800.0, rel=0.1)  # those who leave come along, too
    on_ramp = [rate for _, rate in corridor.conditions.demand.on_ramps[0]]
    assert np.mean(on_ramp) == pytest.approx(400.0, rel=0.1)
    # At the off-ramp: 300 of 1500 + 300 + 400 an hour.
    assert corridor.geometry.exit_shares[0] == pytest.approx(300 / 2200, rel=0.3)
    assert 3.0 < corridor.scales.average_dwell < 6.0
    assert corridor.measured == ("demand", "exit_shares", "average_dwell")
    assert road.remarks == (
        "the record begins on an empty mainline; a warm-up fills it",
        f"fixed sensors are assumed on the last mainline segment and on off-ramps: "
        f"fixed_sensors = {list(corridor.fixed_sensors)}",
    )


def test_an_incident_slows_the_vehicles_on_its_segment_alone(road):
    segment = road.corridor.geometry.n_mainline - 2
    incident = Incident(segment=segment, phases=((60.0, 120.0, 10.0),))
    slow = simulate(road.corridor.replaced(incident=incident), 0)
    here = (slow.segment == segment) & (slow.step > 80) & (slow.step <= 120)
    assert slow.speed[here].mean() < 20.0
    assert slow.speed[here].max() < 90.0
    beyond = (slow.segment == segment + 1) & (slow.step > 80) & (slow.step <= 120)
    assert slow.speed[beyond].max() > 35.0  # free again, and faster
    late = (slow.segment == segment) & (slow.step > 200)
    assert slow.speed[late].mean() > 40.0
    before = slow.step <= 60
    np.testing.assert_array_equal(slow.speed[before], road.record.speed[road.record.step <= 60])


def test_a_warm_up_starts_the_record_with_traffic(files, road):
    warm = imported(files, warm_up=120)
    assert warm.corridor.sumo.begin == 120
    assert road.record.counts[0].sum() == 0
    np.testing.assert_array_equal(warm.record.counts[0], road.record.counts[120])


def test_an_incident_makes_no_vehicle_faster(files, road, tmp_path):
    slow = tmp_path / "slow.rou.xml"
    slow.write_text(FLOWS.replace('id="car"', 'id="car" maxSpeed="10"'))
    digests = file_digest(files.net), file_digest(slow)
    sumo = dataclasses.replace(road.corridor.sumo, routes=(str(slow),), sha256=digests)
    limited = road.corridor.replaced(sumo=sumo, incident=Incident(2, ((30, 200, 90.0),)))
    assert 30.0 < simulate(limited, 0).speed.max() <= 36.01


def test_a_road_file_moves_with_its_files_which_are_told_by_their_content(road, files, tmp_path):
    folder, there = tmp_path / "here", tmp_path / "there"
    folder.mkdir()
    for path in (files.net, *files.routes):
        shutil.copy(path, folder)
    sumo = dataclasses.replace(road.corridor.sumo, folder=str(folder))
    corridor = road.corridor.replaced(sumo=sumo)
    write_corridor(folder / "road.toml", corridor)
    assert str(tmp_path) not in (folder / "road.toml").read_text()
    assert read_corridor(folder / "road.toml") == corridor
    below = tmp_path / "roads" / "mine" / "road.toml"
    below.parent.mkdir(parents=True)
    write_corridor(below, corridor)
    assert 'folder = "../../here"' in below.read_text()
    (tmp_path / "link.toml").symlink_to(below)
    assert read_corridor(tmp_path / "link.toml") == corridor
    write_corridor(tmp_path / "link.toml", corridor, {"bandwidth": 3})
    assert (read_corridor(below), "bandwidth" in below.read_text()) == (corridor, True)
    moved = read_corridor(folder.rename(there) / "road.toml")
    assert Path(moved.sumo.folder) == there
    assert moved.digest == road.corridor.digest
    np.testing.assert_array_equal(simulate(moved, 0).counts, road.record.counts)
    published = moved.replaced(demand=moved.conditions.demand.scaled(2.0), lanes=4)
    assert published.digest == road.corridor.digest  # the vehicles are those of the files
    assert moved.replaced(duration=241).digest != road.corridor.digest
    routes = there / "road.rou.xml"
    routes.write_text(routes.read_text().replace("1500", "1600"))
    with pytest.raises(RecordingError, match=r"road\.rou\.xml: is not the file that the road was"):
        simulate(moved, 0)
    routes.unlink()
    with pytest.raises(RecordingError, match=r"road\.rou\.xml: cannot be read: No such file"):
        simulate(moved, 0)


def test_scenarios_and_corridors_of_no_use_are_refused(road):
    sumo = road.corridor.sumo
    for change, message in (
        ({"options": ("--fcd-output=all.xml",)}, "options must be options that change the traffic"),
        ({"options": ("-v",)}, "options must be --name=value each"),
        ({"step_length": 0.3}, "step_length must be a whole part of a second"),
        ({"sha256": ()}, "sha256 must be one for each of 2 files"),
        ({"columns": ((("in", 5.0, 5.0),),)}, r"columns\[0\] must be stretches that end"),
        ({"columns": ((("in", 0.0, 5.0),), (("in", 4.0, 9.0),))}, "without overlap on edge 'in'"),
    ):
        with pytest.raises(ValueError, match=rf"sumo\..*{message}"):
            dataclasses.replace(sumo, **change)
    columns = sumo.columns[:-1]
    with pytest.raises(ValueError, match=r"corridor\.sumo\.columns must be one for each of the"):
        road.corridor.replaced(sumo=dataclasses.replace(sumo, columns=columns))
    with pytest.raises(ValueError, match=r"corridor\.drivers must be left out"):
        road.corridor.replaced(drivers=Drivers("IDM"))


WRITERS = """
    <inductionLoop id="e1" lane="narrow_0" pos="5" period="10" file="{}"/>
    <instantInductionLoop id="i1" lane="narrow_0" pos="5" file="{}"/>
    <laneAreaDetector id="e2" lane="narrow_0" pos="5" endPos="50" period="10" file="{}"/>
    <entryExitDetector id="e3" period="10" file="{}">
        <detEntry lane="narrow_0" pos="5"/><detExit lane="narrow_0" pos="90"/>
    </entryExitDetector>
    <edgeData id="edges" period="10" file="{}"/> <laneData id="lanes" period="10" file="{}"/>
    <vTypeProbe id="probe" type="car" period="10" file="{}"/>
    <routeProbe id="routes" edge="in" period="10" file="{}"/>
    <calibrator id="c" edge="in" pos="0" period="10" output="{}" routeProbe="routes"/>
    <wrapped><e1Detector id="e4" lane="narrow_0" pos="5" period="10" file="{}"/></wrapped>"""
EQUIPPED = """
    <param key="has.ssm.device" value="true"/> <param key="device.ssm.file" value="{}"/>
    <param key="has.toc.device" value="true"/>
    <param key="device.toc.manualType" value="car"/>
    <param key="device.toc.automatedType" value="van"/> <param key="device.toc.file" value="{}"/>
    <param key="has.example.device" value="true"/> <param key="device.example.log" value="{}"/>
    <param key="device.rerouting.output" value="{}"/>"""
VEHICLES = """<routes>
    <vType id="car">{}</vType>
    <vTypeDistribution id="any"><vType id="van">{}</vType></vTypeDistribution>
    <flow id="f" type="car" from="in" to="out" begin="0" end="30" vehsPerHour="900">{}</flow>
    <vehicle id="v" depart="1" type="any"><route edges="in merge"/>{}</vehicle>
    <trip id="t" depart="2" type="any" from="in" to="out">{}</trip>
</routes>"""


def options_of(*topics):
    """Return the options of SUMO in topics of its configuration, and whether they are files."""
    sumo = pytest.importorskip("sumo", reason="eclipse-sumo (extra corridors) is missing")
    schema = ElementTree.parse(
        Path(sumo.__file__).parent / "data" / "xsd" / "types" / "sumoConfigurationType.xsd"
    )
    return {
        element.get("name"): element.get("type") == "fileOptionType"
        for kind in schema.findall("{*}complexType")
        if not topics or kind.get("name").removeprefix("sumo").removesuffix("TopicType") in topics
        for element in kind.findall(".//{*}element")
    }


def test_options_of_the_traffic_are_told_from_all_others():
    assert not [name for name, is_file in options_of().items() if is_file and taken(name)]
    assert not list(filter(taken, options_of("configuration", "output", "report", "ssm_device")))
    traffic = options_of("processing", "routing")
    left_out = {name for name in traffic if not taken(name)}
    assert left_out == {
        "threads", "scale", "astar.all-distances", "astar.landmark-distances",
        "device.rerouting.output",
    }  # fmt: skip


def taken(option):
    return TRAFFIC.fullmatch(option) is not None


def test_flows_of_intervals_depart_in_order_among_vehicles(tmp_path):
    def at(begin, flow):
        return f'<interval begin="{begin}" end="300">{flow}</interval>'

    own, plain = '<flow begin="70"/>', "<flow/>"
    vehicle, route = '<vehicle depart="99"/>', "<route/>"
    given, copy = tmp_path / "given.xml", tmp_path / "copy.xml"
    given.write_text(
        f"<all>{at('0:02:30', plain + own)}{at(50, plain)}{vehicle}{plain}{route}</all>"
    )
    assert not copy_input(given, copy, 60.0).is_sorted
    in_order = [route, at(50, plain), plain, at("0:02:30", own), vehicle, at("0:02:30", plain)]
    assert canonicalize(copy.read_text()) == canonicalize(f"<all>{''.join(in_order)}</all>")


@pytest.mark.parametrize("place", ["{root}/kept.xml", "{root}/missing/new.xml", "kept.xml"])
def test_nothing_that_files_name_is_written(files, place, tmp_path, monkeypatch):
    root = tmp_path / "theirs"
    root.mkdir()
    monkeypatch.chdir(root)
    place = place.format(root=root)
    named = iter(lambda: place, None)

    def filled(text):
        return re.sub(r"\{\}", lambda _: next(named), text)

    Path("kept.xml").write_text("results of a week")
    shutil.copy(files.net, "road.net.xml")
    Path("more.add.xml").write_bytes(
        gzip.compress(f"<additional>{filled(WRITERS)}</additional>".encode())
    )
    Path("road.rou.xml").write_text(VEHICLES.replace("{}", filled(EQUIPPED)))
    outputs = [name for name, is_file in options_of("output", "report").items() if is_file]
    options = "".join(f'<{name} value="{place}"/>' for name in [*outputs, "device.ssm.file"])
    Path("road.sumocfg").write_text(
        '<configuration><net-file value="road.net.xml"/><route-files value="road.rou.xml"/>'
        '<additional-files value="more.add.xml"/><device.ssm.probability value="1"/>'
        f'<save-state.times value="5"/>{options}</configuration>'
    )
    before = {path: file_digest(path) for path in root.rglob("*")}
    read = read_configuration(root / "road.sumocfg")
    road = import_road(read, segment_path(read, PATH, 100.0), "road", 30)
    assert {path: file_digest(path) for path in root.rglob("*")} == before
    assert any(
        "more.add.xml: outputs that are not written: 1 of inductionLoop" in each
        for each in road.remarks
    )


def test_a_copy_for_sumo_names_no_file_and_keeps_all_else(tmp_path):
    given, copy = tmp_path / "given.xml", tmp_path / "copy.xml"
    switched = '<timedEvent type="SaveTLSStates" source="j" dest="{}"/>'
    actuated = (
        '<tlLogic id="j"><param key="file" value="{}"/><param key="in_0" value="e1"/></tlLogic>'
    )
    text = f"<all>{WRITERS}{switched}{actuated}<vType id='&lt;ü' maxAccelProfile='1'/></all>"
    given.write_text(text.replace("{}", "a week/results"), encoding="utf-16")
    found = copy_input(given, copy, 0.0)
    assert found.outputs["timedEvent"] == found.outputs["parameter file"] == 1
    expected = re.sub(r'output="{}" |<param key="file" value="{}"/>', "", text).replace("{}", "NUL")
    assert canonicalize(copy.read_text()) == canonicalize(expected)


def canonicalize(text):
    return ElementTree.canonicalize(text, strip_text=True)
