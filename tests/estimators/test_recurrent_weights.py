"""Files of networks: what is written is read, and nothing else."""

import io
import json
import zipfile

import numpy as np
import pytest

from dptse_env.estimators.recurrent_weights import (
    member_for,
    parse_network,
    read_network,
    shipped_networks,
    write_network,
)

from .networks import card, random_network


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "network.npz"
    write_network(path, random_network(), card())
    return path


def rewritten(path, **changes):
    """The file with some entries replaced, or left out where they are None."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            key = name.removesuffix(".npy")
            content = changes.get(key, old.read(name))
            if content is not None:
                new.writestr(name, content)
    return buffer.getvalue()


def npy(array):
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, array, allow_pickle=True)
    return buffer.getvalue()


def card_bytes(**changes):
    text = json.dumps({**card(), **changes}).encode()
    return npy(np.frombuffer(text, dtype=np.uint8))


def test_what_is_written_is_read(path):
    saved = read_network(str(path))
    for name, array in random_network()._asdict().items():
        np.testing.assert_array_equal(getattr(saved.network, name), array)
    assert saved.card == card()
    assert saved.source == str(path)


def test_the_same_network_gives_the_same_bytes(path, tmp_path):
    write_network(tmp_path / "again.npz", random_network(), card())
    assert (tmp_path / "again.npz").read_bytes() == path.read_bytes()


def test_numpy_reads_it_too(path):
    with np.load(path, allow_pickle=False) as arrays:
        assert json.loads(arrays["card"].tobytes()) == card()


def test_an_unknown_name_lists_those_that_ship():
    with pytest.raises(ValueError, match=r"recurrent\.weights must be a file or one of .*'none'"):
        read_network("none")
    for name in shipped_networks():
        assert read_network(name).card["training"]


def test_a_pair_is_found_by_the_name_it_shares(tmp_path):
    source = str(tmp_path / "pair")
    write_network(f"{source}-flows.npz", random_network(), card())
    assert member_for(source, flows=True) == f"{source}-flows.npz"
    assert member_for(source, flows=False) == source  # refused by the one who reads it
    single = f"{source}-flows.npz"
    assert member_for(single, flows=True) == single
    assert member_for("highway", flows=True) == "highway-flows"
    assert member_for("highway", flows=False) == "highway-speeds"
    with pytest.raises(ValueError, match=r"or one of highway, highway-flows, .*, got"):
        read_network("nowhere")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"heads": None}, "no item named 'heads.npy'"),
        ({"heads": npy(np.zeros((8, 8)))}, "must be float32 or uint8"),
        ({"heads": npy(np.zeros((8, 7), dtype=np.float32))}, r"'heads' must be float32 of shape"),
        ({"heads": npy(np.full((8, 8), np.nan, np.float32))}, "'heads' must be finite"),
        ({"heads": npy(np.zeros((8, 8), np.float32))[:-4]}, "truncated or too long"),
        ({"heads": npy(np.array([print], dtype=object))}, "must be float32 or uint8"),
        ({"heads": b"nothing"}, "magic"),
        ({"hidden": npy(np.zeros((0, 0), np.float32))}, r"width must be in 1\.\.512, got 0"),
        ({"card": card_bytes(format="recurrent-9")}, "'recurrent-9', this version reads"),
        ({"card": card_bytes(channels=["queried"])}, "channels of format"),
        ({"card": card_bytes(ranges={"lanes": [1]})}, "'lanes' must be two numbers"),
        ({"card": card_bytes(ranges={"lanes": [1, "2"]})}, "'lanes' must be two numbers"),
        ({"card": npy(np.frombuffer(b"{", dtype=np.uint8))}, "its card must be JSON"),
    ],
)
def test_other_content_is_refused(changes, message, path):
    with pytest.raises(ValueError, match=f"'x' is not a saved network, or damaged: .*{message}"):
        parse_network(rewritten(path, **changes), "x")


def test_a_header_of_another_size_allocates_nothing(path):
    header = npy(np.zeros((8, 8), np.float32)).replace(b"(8, 8)", b"(8, 8000000000)"[:6])
    assert header != npy(np.zeros((8, 8), np.float32))
    with pytest.raises(ValueError, match="is not a saved network"):
        parse_network(rewritten(path, heads=header), "x")


@pytest.mark.parametrize("keep", [0, 10, 500])
def test_truncated_files_are_refused(keep, path):
    with pytest.raises(ValueError, match="'x' is not a saved network, or damaged"):
        parse_network(path.read_bytes()[:keep], "x")


def test_a_file_that_expands_without_end_is_refused(path):
    bomb = npy(np.zeros(2**25, dtype=np.uint8))
    with pytest.raises(ValueError, match=r"'card\.npy' has more than"):
        parse_network(rewritten(path, card=bomb), "x")


def test_nothing_is_written_that_could_not_be_read(tmp_path):
    network = random_network()
    bad = network._replace(heads=network.heads * np.float32(np.inf))
    with pytest.raises(ValueError, match="'heads' must be finite"):
        write_network(tmp_path / "x.npz", bad, card())
    assert not (tmp_path / "x.npz").exists()
