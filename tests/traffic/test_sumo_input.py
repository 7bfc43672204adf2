"""Nets for SUMO: those that come with the package, and compiled ones."""

import importlib.util
import re

import pytest

from dptse_env.traffic import CORRIDORS, PAPER_HIGHWAY
from dptse_env.traffic.sumo_input import (
    NetconvertError,
    compile_net,
    edge_ids,
    net_xml,
    packaged_net,
)
from tests.helpers import UNEVEN

needs_netconvert = pytest.mark.skipif(
    importlib.util.find_spec("sumo") is None, reason="eclipse-sumo (extra corridors) is missing"
)


@needs_netconvert
@pytest.mark.parametrize("name", CORRIDORS)
def test_packaged_nets_are_what_netconvert_makes_of_the_presets(name):
    assert compile_net(CORRIDORS[name].geometry) == packaged_net(name)


def test_a_preset_is_not_compiled(monkeypatch):
    monkeypatch.setattr("dptse_env.traffic.sumo_input.compile_net", None)
    changed = PAPER_HIGHWAY.replaced(name="mine", incident=None, duration=60)
    assert net_xml(changed.geometry) == packaged_net("paper-highway")


@needs_netconvert
def test_a_netconvert_of_another_version_than_libsumo_is_refused(monkeypatch):
    monkeypatch.setattr("dptse_env.traffic.sumo_input.installed", lambda package: "1.2.3")
    with pytest.raises(NetconvertError, match=r"found 1\.2\.3: pip install 'eclipse-sumo==1\."):
        compile_net(PAPER_HIGHWAY.replaced(n_mainline=21).geometry)


def test_the_net_has_the_lengths_lanes_and_limits_of_the_corridor():
    road, arrays = UNEVEN.geometry, UNEVEN.road
    text = net_xml(road)
    columns = arrays.lengths, arrays.lanes, arrays.limits
    for edge, length, count, limit in zip(edge_ids(road), *columns, strict=True):
        found = re.findall(
            rf'<lane id="{edge}_\d+" index="\d+" .*?speed="([\d.]+)" length="([\d.]+)"', text
        )
        assert len(found) == count, edge
        assert {float(speed) for speed, _ in found} == {round(limit / 3.6, 2)}
        assert {float(each) for _, each in found} == {round(1000.0 * length, 2)}
