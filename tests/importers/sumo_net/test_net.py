"""Networks of no use are refused in one line that names the file."""

import re

import pytest

from dptse_env.importers.sumo_net import Files, segment_path
from tests.importers.sumo_net.conftest import PATH


def refused(path, content):
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"^net: {re.escape(str(path))}") as error:
        segment_path(Files(path, ()), PATH, 100.0)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 500
    return str(error.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\x00\x8f\x11 not to be read", "must be XML, got something else (binary, encrypted"),
        (b"\x1f\x8bno archive at all", "must be XML"),
        (b"<routes/>", "must be a SUMO net (<net>), got <routes>"),
        (b"<net version='9.1'/>", "version must be at most 1.20, got 9.1"),
        (b"<net version='1.20'/>", "must have edges, got a net without any"),
        (b"<net version='1.20'><edge id='%a'" % (b"a" * 10_000), "must be a SUMO net, got"),
    ],
)
def test_files_that_are_no_nets_are_refused(tmp_path, content, message):
    assert message in refused(tmp_path / "road.net.xml", content)


@pytest.mark.parametrize(
    ("pattern", "change", "message"),
    [
        (r' speed="[^"]*"', "", "KeyError: 'speed'"),
        (r' shape="[^"]*"', ' shape="1;2"', "could not convert string to float"),
        (r'(<lane id="in_0".*?) length="[^"]*"', r'\1 length="nan"', "lane 'in_0' must have a len"),
        (r'(<lane id="out_1".*?) speed="[^"]*"', r'\1 speed="-1"', "lane 'out_1' must have a leng"),
        (r' via="[^"]*"', ' via="in_0"', "lane 'in_0' must lead over its junction, got a circle"),
        (r'<connection from=":[^/]*/>', "", "must lead over its junction, got an end"),
    ],
)
def test_damaged_nets_are_refused(files, tmp_path, pattern, change, message):
    damaged = re.sub(pattern, change, files.net.read_text())
    assert message in refused(tmp_path / "road.net.xml", damaged.encode())


def test_a_path_is_no_loop(files):
    with pytest.raises(ValueError, match=f"path: must not be a loop, got .*{PATH[0]}.* twice"):
        segment_path(files, [*PATH, PATH[0]], 100.0)
