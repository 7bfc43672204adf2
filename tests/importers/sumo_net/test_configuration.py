"""Files of a simulation are read; bad ones are refused in one line that names the file."""

import re
from dataclasses import replace
from functools import partial

import pytest

from dptse_env.importers.sumo_net import Files, read_configuration

CONFIGURATION = """
<configuration>
    <input>
        <net-file value=" a net/the road;1.net.xml "/>
        <route-files value="a.rou.xml, b c.rou.xml"/>
        <additional-files v="types.add.xml"/>
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


XI = 'xmlns:x="http://www.w3.org/2001/XInclude"'


def read(folder, *change):
    path = folder / "town.sumocfg"
    path.write_text(CONFIGURATION.replace(*change) if change else CONFIGURATION)
    return read_configuration(path)


def test_a_configuration_gives_files_and_options_of_the_traffic(tmp_path):
    files = read(tmp_path)
    assert files == Files(
        net=tmp_path / "a net/the road;1.net.xml",
        routes=(tmp_path / "a.rou.xml", tmp_path / "b c.rou.xml"),
        additional=(tmp_path / "types.add.xml",),
        begin=25200.0,
        step_length=0.5,
        options=("--time-to-teleport=300", "--no-internal-links=true", "--max-depart-delay=600"),
        left_out=(
            "fcd-output", "tripinfo", "end", "seed", "random", "verbose", "log", "no-step-log",
            "gui-settings-file", "delay",
        ),
    )  # fmt: skip
    assert not files.internal_links
    assert read(tmp_path, "07:00:00", "1:00:00:10.5").begin == 86410.5
    assert read(tmp_path, "07:00:00", "12").begin == 12.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('"07:00:00"', '"seven"'), ": begin must be seconds or hh:mm:ss, got 'seven'"),
        (("net-file", "no-file"), " must name one net-file, got 0"),
        (("<processing>", '<processing><mesosim value="true"/>'), ": mesosim must be left out"),
        (("</configuration>", ""), " must be XML"),
        (("configuration>", "net>"), " must be a <configuration> of SUMO, got <net>"),
        ("routes <routes/>", " must have vehicles, got an empty file"),
        ("routes no xml", " must be XML"),
        ("routes <net><edge/></net>", " must hold routes, got <net>"),
        ('routes <routes><include href="b.xml"/></routes>', ": <include> must not read another"),
        ('additional <a><vss file="s.xml"/></a>', ": <vss> must not read another file, got 's."),
        ('additional <a><calibrator file="c"/></a>', ": <calibrator> must not read another file"),
        (f'routes <a {XI}><x:include href="/etc/b"/></a>', ": <include> must not read another"),
        ("additional <a><b/>", " must be XML"),
        ("additional " + 9000 * "<a>" + 9000 * "</a>", " must be XML: maximum recursion depth"),
    ],
)
def test_files_of_no_use_are_refused(tmp_path, change, message):
    if isinstance(change, tuple):
        kind, path, check = "configuration", tmp_path / "town.sumocfg", partial(read, tmp_path)
    else:
        kind, _, content = change.partition(" ")
        routes, path, change = tmp_path / "all.rou.xml", tmp_path / "own.xml", ()
        routes.write_text("<routes><vehicle/></routes>")
        path.write_text(content)
        (tmp_path / "net.xml").write_text("<net/>")
        files = replace(Files(tmp_path / "net.xml", (routes,)), **{kind: (path,)})
        check = partial(files.check, 0)
    with pytest.raises(ValueError, match=f"^{re.escape(f'{kind}: {path}{message}')}"):
        check(*change)
