"""What is read, and what is refused in one line that names the file."""

import re
from dataclasses import replace

import pytest

from dptse_env.traffic.sumo_import import (
    Files,
    find_layout,
    import_road,
    read_configuration,
    seconds,
)
from tests.traffic.sumo_import.conftest import PATH

CONFIGURATION = """
<configuration>
    <input>
        <net-file value="net/road.net.xml"/>
        <route-files value="a.rou.xml, b.rou.xml"/>
        <additional-files value="types.add.xml"/>
    </input>
    <output><fcd-output value="fcd.xml"/><tripinfo value="trips.xml"/></output>
    <time><begin value="07:00:00"/><end value="36000"/><step-length value="0.5"/></time>
    <processing>
        <time-to-teleport value="300"/><no-internal-links value="true"/>
        <max-depart-delay value="600"/>
    </processing>
    <random_number><seed value="3"/><random value="true"/></random_number>
    <report><verbose value="true"/><log value="run.log"/><no-step-log value="true"/></report>
    <gui_only><gui-settings-file value="view.xml"/><delay value="20"/></gui_only>
</configuration>"""


def test_a_configuration_gives_files_and_options_of_the_traffic(tmp_path):
    path = tmp_path / "town.sumocfg"
    path.write_text(CONFIGURATION)
    files = read_configuration(path)
    assert files == Files(
        net=tmp_path / "net/road.net.xml",
        routes=(tmp_path / "a.rou.xml", tmp_path / "b.rou.xml"),
        additional=(tmp_path / "types.add.xml",),
        begin=25200.0,
        step_length=0.5,
        options=("--time-to-teleport=300", "--no-internal-links=true", "--max-depart-delay=600"),
    )
    assert not files.internal_links


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('"07:00:00"', '"seven"'), "begin must be seconds or hh:mm:ss, got 'seven'"),
        (('<net-file value="net/road.net.xml"/>', ""), "must name one net-file, got 0"),
        (("<processing>", '<processing><mesosim value="true"/>'), "mesosim must be left out"),
        (("</configuration>", ""), "must be XML"),
    ],
)
def test_configurations_of_no_use_are_refused(tmp_path, change, message):
    path = tmp_path / "town.sumocfg"
    path.write_text(CONFIGURATION.replace(*change))
    expected = rf"^configuration: {re.escape(str(path))}.*{re.escape(message)}"
    with pytest.raises(ValueError, match=expected):
        read_configuration(path)


@pytest.mark.parametrize(("text", "expected"), [("01:30:00", 5400.0), ("1:00:00:10.5", 86410.5)])
def test_times_are_seconds_or_clock_times(text, expected):
    assert seconds(text, "begin") == expected


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\x00\x8f\x11 not to be read", "must be XML, got something else (binary, encrypted"),
        (b"\x1f\x8bno archive at all", "must be XML"),
        (b"<routes/>", "must be a network (<net>), got <routes>"),
        (b"<net version='9.1'/>", "version must be at most 1.20, got 9.1"),
        (b"<net version='1.20'><edge id='a'", "no network of SUMO"),
    ],
)
def test_networks_of_no_use_are_refused(tmp_path, content, message):
    path = tmp_path / "road.net.xml"
    path.write_bytes(content)
    expected = rf"^net: {re.escape(str(path))}.*{re.escape(message)}"
    with pytest.raises(ValueError, match=expected) as refused:
        find_layout(Files(path, ()), PATH, 100.0)
    assert "\n" not in str(refused.value)


ELSEWHERE = '<routes><vehicle id="v" depart="0"><route edges="elsewhere"/></vehicle></routes>'
UNKNOWN = '<routes><vehicle id="v" depart="0"><route edges="nowhere"/></vehicle></routes>'


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<routes/>", "routes: {path} must have vehicles, got an empty file"),
        ("no xml", "routes: {path} must be XML"),
        (ELSEWHERE, "routes: own.rou.xml must have vehicles that use the path from 0 s to 60 s"),
        (UNKNOWN, "SUMO refuses these files: recording road with traffic seed 0 failed"),
    ],
)
def test_routes_of_no_use_are_refused(files, tmp_path, content, message):
    path = tmp_path / "own.rou.xml"
    path.write_text(content)
    layout = find_layout(files, PATH, 100.0)
    with pytest.raises(ValueError, match=re.escape(message.format(path=path))) as refused:
        import_road(replace(files, routes=(path,)), layout, "road", 60)
    assert "\n" not in str(refused.value)


def test_a_simulation_needs_vehicles_and_reads_no_files_behind_its_back(files, tmp_path):
    layout = find_layout(files, PATH, 100.0)
    with pytest.raises(ValueError, match="routes: must have at least one file"):
        import_road(replace(files, routes=()), layout, "road", 60)
    path = tmp_path / "all.rou.xml"
    path.write_text('<routes><include href="more.rou.xml"/></routes>')
    with pytest.raises(ValueError, match=r"^routes: .*<include> must not read another file"):
        import_road(replace(files, routes=(path,)), layout, "road", 60)
    path = tmp_path / "signs.add.xml"
    path.write_text(
        '<additional><variableSpeedSign id="s" lanes="in_0" file="s.xml"/></additional>'
    )
    with pytest.raises(ValueError, match=r"<variableSpeedSign> must not read another file"):
        import_road(replace(files, additional=(path,)), layout, "road", 60)
