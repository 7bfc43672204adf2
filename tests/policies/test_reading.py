"""Reading of policy files without torch; the hostile ones are in `tests.sb3.test_hostile_files`."""

import hashlib
import io
import json
import sys
import zipfile
from importlib.resources import files

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dptse_env.policies import parse_policy, read_policy

SHIPPED = (files("dptse_env") / "policies" / "private-highway.zip").read_bytes()


def entries_of(content):
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def packed(entries, method=zipfile.ZIP_DEFLATED):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def with_weights(change):
    """The shipped policy with changed entries in its archive of weights."""
    entries = entries_of(SHIPPED)
    weights = entries_of(entries["weights.pt"])
    return packed({**entries, "weights.pt": packed(change(weights))})


def with_table(program):
    return with_weights(lambda weights: {**weights, "archive/data.pkl": program})


def test_card_and_weights_are_read_without_torch(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    assert len(read_policy("private-highway").weights) == 7


def test_weights_are_those_that_torch_reads():
    torch = pytest.importorskip("torch")
    file = read_policy("private-highway")
    weights = torch.load(io.BytesIO(entries_of(SHIPPED)["weights.pt"]), weights_only=True)
    assert file.weights.keys() == weights.keys()
    for name, tensor in weights.items():
        assert file.weights[name].dtype == np.float32
        np.testing.assert_array_equal(file.weights[name], tensor.numpy())
    assert file.sha256 == hashlib.sha256(SHIPPED).hexdigest()
    assert file.card["training"]["seed"] == 3


def refusal_of(content):
    try:
        parse_policy(content, "some.zip")
    except ValueError as problem:
        return str(problem)
    return None


def accepted_or_refused(content):
    """Return whether a policy could be read; a refusal is one line that names the file."""
    refusal = refusal_of(content)
    if refusal is None:
        return True
    assert refusal.startswith("'some.zip' is not a saved policy, or damaged: ")
    assert len(refusal.splitlines()) == 1
    return False


@given(st.integers(0, len(SHIPPED) - 1))
@settings(max_examples=40)
def test_truncated_files_are_refused(size):
    assert not accepted_or_refused(SHIPPED[:size])


@given(st.data())
def test_flipped_bytes_are_refused_or_harmless(data):
    content = bytearray(SHIPPED)
    # Directories and headers are at either end, where damage is most varied.
    ends = st.one_of(st.integers(0, 900), st.integers(len(content) - 900, len(content) - 1))
    position = st.one_of(ends, st.integers(0, len(content) - 1))
    for place in data.draw(st.lists(position, min_size=1, max_size=4)):
        content[place] ^= data.draw(st.integers(1, 255))
    accepted_or_refused(bytes(content))


@given(st.data())
def test_damaged_weights_are_refused_or_read(data):
    def change(weights):
        name = data.draw(st.sampled_from(sorted(weights)))
        content = bytearray(weights[name])
        for place in data.draw(st.lists(st.integers(0, len(content) - 1), max_size=4)):
            content[place] = data.draw(st.integers(0, 255))
        return {**weights, name: bytes(content)}

    accepted_or_refused(with_weights(change))


def test_an_invalid_escape_in_a_name_is_damage():
    def change(weights):
        content = bytearray(weights["archive/data.pkl"])
        content[content.index(b"torch") + 2 : content.index(b"torch") + 4] = b"\\o"
        return {**weights, "archive/data.pkl": bytes(content)}

    with pytest.raises(ValueError, match="its table of weights is damaged"):
        parse_policy(with_weights(change), "some.zip")


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner),
    max_leaves=6,
)


@given(st.data())
@settings(max_examples=40)
def test_edited_cards_are_refused_or_read(data):
    entries = entries_of(SHIPPED)
    card = node = json.loads(entries["card.json"])
    key = data.draw(st.sampled_from(sorted(card)))
    while isinstance(node[key], dict) and node[key] and data.draw(st.booleans()):
        node = node[key]
        key = data.draw(st.sampled_from(sorted(node)))
    node[key] = data.draw(json_values)
    accepted_or_refused(packed({**entries, "card.json": json.dumps(card)}))


@given(st.binary(max_size=300))
def test_arbitrary_tables_of_weights_are_refused(program):
    assert not accepted_or_refused(with_table(program + b"."))


def card(text):
    return packed({**entries_of(SHIPPED), "card.json": text})


WRONG = [
    (lambda: card("[" * 20 + "]" * 20), "nested more than 16 levels deep"),
    (lambda: card("[" * 60_000), "nested more than 16 levels deep"),
    (lambda: card(" " * 70_000), r"entry 'card\.json' has more than 65536 bytes"),
    (lambda: card('{"fits": NaN}'), "must have finite numbers, got NaN"),
    (lambda: card(b"\xff\xfe\xff"), "can't decode"),
    (lambda: packed({"card.json": "{}"}), "must have a field 'fits'"),
    (lambda: packed({"weights.pt": b""}), r"no item named 'card\.json'"),
    (lambda: packed(entries_of(SHIPPED), zipfile.ZIP_BZIP2), "must be stored or deflated"),
    (lambda: b"PK\x01\x02" * 1001, "more than 1000 entries"),
    (lambda: SHIPPED + bytes(2**24), "more than 16777216 bytes"),
    (lambda: with_weights(lambda w: {}), "must have one table of tensors, got 0"),
    (lambda: with_weights(lambda w: {**w, "archive/byteorder": b"big"}),
     "little-endian order"),
    (lambda: with_weights(lambda w: {**w, "archive/data/0": w["archive/data/0"][:8]}),
     r"'scorer\.rule' reaches beyond its storage"),
    (lambda: with_weights(lambda w: {**w, "archive/data/0": bytes(16)}),
     "'archive/data/0' has more than 12 bytes"),
    (lambda: with_weights(lambda w: {**w, "archive/data/0": b"\x00\x00\x80\x7f" * 3}),
     r"'scorer\.rule' must be finite"),
    (lambda: with_table(b"cos\nsystem\n."), "more than float32 tensors .*os system"),
    (lambda: with_table(b"I1\n."), "pickle instruction INT"),
    (lambda: with_table(b"\x80\x02]."), "pickle instruction EMPTY_LIST"),
    (lambda: with_table(b"."), "a mapping of names to tensors"),
    (lambda: with_table(b"h\x05."), "table of weights is damaged"),
    (lambda: with_table(b"}(K\x01K\x02u."), "a mapping of names to tensors"),
    (lambda: with_table(b"ccollections\nOrderedDict\nK\x01R."), "unknown kind of tensor"),
    (lambda: with_table(b"K\x01Q."), "unknown kind of storage"),
    (lambda: with_table(b"X\xff\xff\xff\x7fabc."), "expected 2147483647 bytes"),
    (lambda: with_table(b"}" * 70_000), "more than 65536 bytes"),
]  # fmt: skip


def test_what_is_wrong_is_named():
    for make, message in WRONG:
        damaged = make()
        with pytest.raises(ValueError, match=message):
            parse_policy(damaged, "some.zip")
        assert not accepted_or_refused(damaged)
