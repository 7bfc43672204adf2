"""Files made to cost time and memory are refused within a second and 128 MB, whatever they hold."""

import functools
import io
import os
import re
import struct
import tempfile
import time
import zipfile
from contextlib import contextmanager
from pathlib import Path

import gymnasium as gym
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("torch")
pytest.importorskip("sb3_contrib")
pytest.importorskip("resource")

import resource

import torch

from dptse_env.sb3 import load_policy, save_policy
from tests.sb3.saved_files import (
    ABOUT,
    edit_card,
    edit_weights,
    entries_of,
    make_policy,
    rewrite,
    write_entries,
)

ADDITIONAL = 128 * 2**20
"""Bytes that loading may take beyond those of the imports and of first, good files."""
MANY = 136 * 2**20
"""Bytes, more than loading may take."""


def bomb(path, name, method=zipfile.ZIP_DEFLATED, declared=None):
    """Put an entry of zeros into an archive, in place of one of the same name."""
    entries = {key: value for key, value in entries_of(path).items() if key != name}
    write_entries(path, entries)
    with zipfile.ZipFile(path, "a", method, True, 1) as archive, archive.open(name, "w") as entry:
        for _ in range(MANY // 2**22):
            entry.write(bytes(2**22))
    if declared is not None:  # the sizes in the headers understate the content
        content = path.read_bytes()
        path.write_bytes(content.replace(struct.pack("<I", MANY), struct.pack("<I", declared)))


def bomb_in_weights(path):
    weights = path.with_suffix(".pt")
    weights.write_bytes(entries_of(path)["weights.pt"])
    bomb(weights, "archive/data/0")
    rewrite(path, **{"weights.pt": weights.read_bytes()})


def table(path, program):
    """Put another table of tensors into the weights."""
    weights = path.with_suffix(".pt")
    weights.write_bytes(entries_of(path)["weights.pt"])
    rewrite(weights, **{"archive/data.pkl": program})
    rewrite(path, **{"weights.pt": weights.read_bytes()})


def long_card(path, text):
    rewrite(path, **{"card.json": text})


def arguments(path, **values):
    edit_card(path, lambda card: card["policy"]["arguments"].update(values))


def wide_layers(path):
    """Ask for layers of 12,000 units, and have weights of their shapes that take no room."""
    arguments(path, net_arch=[12_000] * 3)
    wide = torch.zeros(1).expand(12_000, 12_000)
    edit_weights(path, lambda weights: weights.update({"mlp_extractor.policy_net.2.weight": wide}))


def many_entries(path):
    """Repeat the first record of the directory."""
    content = path.read_bytes()
    start = content.index(b"PK\x01\x02")
    record = content[start : content.index(b"PK\x01\x02", start + 1)]
    end = struct.pack(
        "<4s4H2LH", b"PK\x05\x06", 0, 0, 65535, 65535, 200_000 * len(record), start, 0
    )
    path.write_bytes(content[:start] + 200_000 * record + end)


def table_of(n_values):
    """A table with a tensor that declares so many values."""
    buffer = io.BytesIO()
    torch.save({"scorer.rule": torch.zeros(3)}, buffer)
    with zipfile.ZipFile(buffer) as archive:
        program = archive.read("archive/data.pkl")
    sized = b"J" + struct.pack("<i", n_values)
    return program.replace(b"K\x03", sized)


HOSTILE = {
    "width": lambda path: arguments(path, width=12_000),
    "mask-layers": lambda path: arguments(path, net_arch=[12_000] * 3),
    "mask-many-layers": lambda path: arguments(path, net_arch=[1] * 20_000),
    "mask-wide-layers": wide_layers,
    "bomb-weights": lambda path: bomb(path, "weights.pt"),
    "bomb-card": lambda path: bomb(path, "card.json"),
    "bomb-understated": lambda path: bomb(path, "weights.pt", declared=1000),
    "bomb-bzip2": lambda path: bomb(path, "weights.pt", zipfile.ZIP_BZIP2),
    "bomb-in-weights": bomb_in_weights,
    "large": lambda path: os.truncate(path, MANY),
    "nested-card": lambda path: long_card(path, "[" * 100_000),
    "nested-card-within-size": lambda path: long_card(path, "[" * 60_000),
    "card-of-quotes": lambda path: long_card(path, '"' + '\\"' * 30_000),
    "card-of-digits": lambda path: long_card(path, '{"fits": ' + "9" * 60_000 + "}"),
    "large-number": lambda path: arguments(path, width=10**4000),
    "entries": many_entries,
    "declared-values": lambda path: table(path, table_of(2**31 - 1)),
    "declared-text": lambda path: table(path, b"X\xff\xff\xff\x7fa."),
    "memo": lambda path: table(path, b"}r\xff\xff\xff\xff."),
    "doubled-tuples": lambda path: table(path, b")" + b"q\x00h\x00\x86" * 10_000 + b"."),
    "doubled-names": lambda path: table(path, b"})" + b"q\x00h\x00\x86" * 9000 + b"K\x01s."),
    "nested-tuples": lambda path: table(path, b")" + b"\x85" * 60_000 + b"."),
    "bytearray": lambda path: table(path, b"c__builtin__\nbytearray\nJ\xff\xff\xff\x7f\x85R."),
}


@contextmanager
def little_memory():
    """Leave this process no more than `ADDITIONAL` bytes of further memory."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + ADDITIONAL, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads memory from /proc")
@pytest.mark.parametrize("action", ["slots", "mask"])
def test_hostile_files_are_refused_soon_and_in_little_memory(tmp_path, action):
    content, env = saved(action)
    good = tmp_path / "good.zip"
    good.write_bytes(content)
    load_policy(good, env)
    hostile = {
        name: make for name, make in HOSTILE.items() if ("mask" in name) == (action == "mask")
    }
    for name, damage in hostile.items():
        path = tmp_path / f"{name}.zip"
        path.write_bytes(content)
        damage(path)
        with little_memory():
            began = time.process_time()
            with pytest.raises(ValueError, match=f"{name}.zip") as refused:
                load_policy(path, env)
            assert time.process_time() - began < 1.0, name
        refusal = str(refused.value)
        assert len(refusal.splitlines()) == 1
        assert re.search("is not a saved policy, or damaged|cannot be loaded", refusal), name


tensors = st.builds(
    lambda shape, dtype, fill: torch.full(shape, fill).to(dtype),
    st.lists(st.integers(0, 9), max_size=5),
    st.sampled_from([torch.float32, torch.float64, torch.int8, torch.bool]),
    st.sampled_from([0.0, 1.0, float("nan")]),
)
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner),
    max_leaves=6,
)


@functools.cache
def saved(action):
    """The content of a policy file, and an environment for it."""
    with tempfile.TemporaryDirectory() as folder:
        policy, config = make_policy(action)
        save_policy(Path(folder) / "one.zip", policy, config, **ABOUT)
        content = (Path(folder) / "one.zip").read_bytes()
    return content, gym.make(ABOUT["env"], action=action)


@pytest.mark.parametrize("action", ["slots", "scores", "sequential"])
@given(data=st.data())
@settings(max_examples=30)
def test_edited_files_are_refused_or_act(action, data):
    content, env = saved(action)

    def edit(card):
        node = card
        keys = data.draw(st.sampled_from([["policy", "arguments"], ["fits"], ["policy"], []]))
        for key in keys:
            node = node[key]
        node[data.draw(st.sampled_from(sorted(node)))] = data.draw(json_values)

    def replace(weights):
        name = data.draw(st.sampled_from(sorted(weights)))
        change = data.draw(st.sampled_from(["add", "remove", "reshape", "refill"]))
        if change == "add":
            weights[data.draw(st.text(max_size=4))] = data.draw(tensors)
        elif change == "remove":
            del weights[name]
        elif change == "reshape":
            weights[name] = data.draw(tensors)
        else:
            weights[name].fill_(data.draw(st.sampled_from([0.0, 1.0, float("nan")])))

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "one.zip"
        path.write_bytes(content)
        if data.draw(st.booleans()):
            edit_card(path, edit)
        if data.draw(st.booleans()):
            edit_weights(path, replace)
        try:
            policy = load_policy(path, env, allow=("corridor", "bandwidth"))
        except ValueError as problem:
            refusal = str(problem)
        else:
            refusal = "one.zip"
            observation, _ = env.reset(seed=0)
            env.step(policy.predict(observation)[0])
    assert "one.zip" in refusal
    assert len(refusal.splitlines()) == 1
