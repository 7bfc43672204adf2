"""A small motorway of one's own, as netconvert compiles it, and traffic on it."""

import importlib.util
import subprocess
from pathlib import Path

import pytest

from dptse_env.importers.sumo_net import Files

NODES = """
<nodes>
    <node id="n0" x="0" y="0"/> <node id="n1" x="400" y="0"/> <node id="n2" x="650" y="0"/>
    <node id="n3" x="1000" y="0"/> <node id="n4" x="1500" y="200"/> <node id="n5" x="2000" y="300"/>
    <node id="r0" x="0" y="-250"/> <node id="r1" x="200" y="-120"/>
    <node id="x1" x="1620" y="100"/> <node id="x2" x="1800" y="-100"/>
    <node id="alone" x="0" y="900"/> <node id="far" x="500" y="900"/>
</nodes>"""

EDGES = """
<edges>
    <edge id="in" from="n0" to="n1" numLanes="2" speed="30"/>
    <edge id="merge" from="n1" to="n2" numLanes="3" speed="30"/>
    <edge id="narrow" from="n2" to="n3" numLanes="2" speed="25"/>
    <edge id="bend" from="n3" to="n4" numLanes="2" speed="25"
          shape="1000,0 1200,10 1350,60 1450,140 1500,200"/>
    <edge id="out" from="n4" to="n5" numLanes="2" speed="25"/>
    <edge id="ramp-a" from="r0" to="r1" numLanes="1" speed="20"/>
    <edge id="ramp-b" from="r1" to="n1" numLanes="1" speed="20"/>
    <edge id="exit-a" from="n4" to="x1" numLanes="1" speed="20"/>
    <edge id="exit-b" from="x1" to="x2" numLanes="1" speed="20"/>
    <edge id="elsewhere" from="alone" to="far" numLanes="1" speed="20"/>
</edges>"""

CONNECTIONS = """
<connections>
    <connection from="in" to="merge" fromLane="0" toLane="1"/>
    <connection from="in" to="merge" fromLane="1" toLane="2"/>
    <connection from="ramp-b" to="merge" fromLane="0" toLane="0"/>
    <connection from="merge" to="narrow" fromLane="1" toLane="0"/>
    <connection from="merge" to="narrow" fromLane="2" toLane="1"/>
</connections>"""

PATH = ("in", "merge", "narrow", "bend", "out")

FLOWS = """
<routes>
    <vType id="car" speedDev="0.1"/>
    <route id="through" edges="in merge narrow bend out"/>
    <route id="leaving" edges="in merge narrow bend exit-a exit-b"/>
    <route id="joining" edges="ramp-a ramp-b merge narrow bend out"/>
    <flow id="t" type="car" route="through" end="600" vehsPerHour="1500" departLane="best"/>
    <flow id="l" type="car" route="leaving" end="600" vehsPerHour="300" departLane="best"/>
    <flow id="j" type="car" route="joining" end="600" vehsPerHour="400"/>
</routes>"""


def netconvert(folder: Path, edges="", connections="", nodes=NODES) -> Path:
    """Compile the motorway with more edges and connections; return the net file."""
    if importlib.util.find_spec("sumo") is None:
        pytest.skip("eclipse-sumo (extra corridors) is missing")
    import sumo

    command = [str(Path(sumo.__file__).parent / "bin" / "netconvert"), "--xml-validation=never"]
    for option, name, text in (
        ("-n", "nod.xml", nodes),
        ("-e", "edg.xml", EDGES.replace("</edges>", f"{edges}</edges>")),
        ("-x", "con.xml", CONNECTIONS.replace("</connections>", f"{connections}</connections>")),
    ):
        (folder / name).write_text(text)
        command += [option, str(folder / name)]
    net = folder / "road.net.xml"
    subprocess.run([*command, "-o", str(net)], check=True, capture_output=True)
    return net


def motorway(folder: Path) -> Files:
    """Write the motorway and its traffic to a folder."""
    net = netconvert(folder)
    routes = folder / "road.rou.xml"
    routes.write_text(FLOWS)
    return Files(net, (routes,), step_length=0.5)


@pytest.fixture(scope="session")
def files(tmp_path_factory):
    return motorway(tmp_path_factory.mktemp("motorway"))
