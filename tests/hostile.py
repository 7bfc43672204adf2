"""Values and files made to mislead, or to cost time and memory, and checks that they are refused.

Damage is to any file with a card, or to any text. `tests/fuzz.py` draws it at random.
"""

import copy
import json
import os
import re

import numpy as np
import pytest
from safetensors.numpy import save

from dptse_env.utils.files import LARGEST_FILE, content_digest, read_tensors


def nested(levels, value=()):
    """A list in a list in a list ..."""
    for _ in range(levels):
        value = [value]
    return value


ODD = (
    None, True, -1, 0, 2**63, 10**5000, 0.0, 5e-324, 1e308, float("nan"), float("inf"), "", "a\nb",
    "x" * 10_000, "no_such_module:Part", "none.json", "\0", b"1", (), {}, {"a": {"b": 1}}, {1: 2},
    nested(200), [0] * 200_000, [[]], object(),
)  # fmt: skip
"""Values that few fields may have, or none."""

TOKENS = (
    b"9" * 5000, b"1e999", b"-1e999", b"nan", b"inf", b"-1", b"0", b"5e-324", b"1e308", b"1e9",
    b"99999999999999999999", b'"', b'""', b'"a\\nb"', b'"no_such_module:Part"', b"'", b"[" * 3000,
    b"{" * 3000, b'{"a":' * 3000, b"]", b"}", b"=", b",", b"<", b"null", b"true", b"x" * 10_000,
    b"\0", b"\xff\xfe", b"\r", b"\n", b"", b"1", b"2", b"3", b"7.5", b"0.2", b"100", b"true",
    b"1", b"2", b"0.5", b"60", b"9" * 300,
)  # fmt: skip
"""Substitutes for a word of a text, or a few bytes of it; some of them may be in order."""


def changed(content, rng):
    """A text with some damage at a random place."""
    place = int(rng.integers(len(content)))
    token = TOKENS[rng.integers(len(TOKENS))]
    lines = content.splitlines(keepends=True)
    line = int(rng.integers(len(lines)))
    words = [*re.finditer(rb"[-+\w.]+", content)]
    word = words[rng.integers(len(words))]
    match rng.integers(9):
        case 0:
            return content[:place]
        case 1:
            flipped = content[place] ^ 1 << int(rng.integers(8))
            return content[:place] + bytes([flipped]) + content[place + 1 :]
        case 2:
            return content[:place] + token + content[place + int(rng.integers(4)) :]
        case 3:
            return b"".join([*lines[:line], *lines[line + 1 :]])
        case 4:
            return b"".join([*lines[:line], lines[line] * int(rng.integers(2, 300)), *lines[line:]])
        case 5:
            other = int(rng.integers(len(lines)))
            lines[line], lines[other] = lines[other], lines[line]
            return b"".join(lines)
        case _:  # what changes a single value is the most telling
            return content[: word.start()] + token + content[word.end() :]


def changed_tensors(path, rng):
    """A file of arrays with some damage at a random place: bytes, its card, or an array."""
    content, (card, arrays) = path.read_bytes(), copy.deepcopy(read_tensors(path))
    card.pop("sha256")
    first = sorted(arrays)[rng.integers(len(arrays))]
    array = arrays[first]
    match rng.integers(4):
        case 0:
            kinds = [*damaged(content), *odd(card, arrays)]
            return kinds[rng.integers(len(kinds))][1]
        case 1:  # numbers of other sizes, in a file that is sound
            scale = 10.0 ** rng.integers(-30, 30)
            with np.errstate(all="ignore"):
                return signed(card, {**arrays, first: (array * scale).astype(array.dtype)})
        case 2:
            changes = array[:0], array[::-1], array[None], array.astype("i8"), -array
            return signed(card, {**arrays, first: np.ascontiguousarray(changes[rng.integers(5)])})
        case _:
            text = changed(json.dumps(card).encode(), rng)
            try:
                return signed(json.loads(text), arrays)
            except (ValueError, TypeError, AttributeError, RecursionError):
                # No card that could be signed.
                return save(arrays, {"card": text.decode(errors="replace")})


def signed(card, arrays):
    """The content of a file with a true digest, whatever the card and the arrays are."""
    return save(arrays, {"card": json.dumps({**card, "sha256": content_digest(card, arrays)})})


def edited(path, change):
    """The content of a file after ``change(card, arrays)``, with a true digest."""
    card, arrays = copy.deepcopy(read_tensors(path))
    change(card, arrays)
    return signed(card, arrays)


def packed(header, data):
    """The content of a file with any header: bytes, or what becomes JSON."""
    header = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(header).to_bytes(8, "little") + header + data


def damaged(content, flips=100, cuts=20):
    """Damage that no file survives, by kind."""
    rng = np.random.default_rng(0)
    for place, bit in zip(rng.integers(len(content), size=flips), range(flips), strict=True):
        flipped = bytearray(content)
        # Every second one is in the header, where damage is most varied.
        flipped[place if bit % 2 else place % 900] ^= 1 << bit % 8
        yield f"flip-{place}-{bit}", bytes(flipped)
    for size in (0, 7, 8, *rng.integers(len(content), size=cuts)):
        yield f"cut-{size}", content[:size]
    size = int.from_bytes(content[:8], "little")
    text, data = content[8 : 8 + size], content[8 + size :]
    header = json.loads(text)
    arrays = {name: entry for name, entry in header.items() if name != "__metadata__"}
    first, entry = next(iter(arrays.items()))

    def with_card(card):
        return packed({**header, "__metadata__": {"card": card}}, data)

    yield "zip", b"PK\x03\x04" + bytes(100)
    yield "header-of-100-MB", (10**8).to_bytes(8, "little") + content[8:]
    yield "header-deep", packed(b'{"a":' * 200_000, data)
    yield (
        "key-twice",
        packed(text.rstrip()[:-1] + f',"{first}":{json.dumps(entry)}}}'.encode(), data),
    )
    yield "bfloat16", packed({**header, first: {**entry, "dtype": "BF16"}}, data)
    yield "no-card", packed(arrays, data)
    yield "card-is-a-number", packed({**header, "__metadata__": {"card": 1}}, data)
    yield "card-is-a-list", with_card("[]")
    yield "card-deep", with_card("[" * 400_000)
    yield "card-of-digits", with_card('{"a": ' + "9" * 10**6 + "}")
    yield "card-infinite", with_card('{"a": 1e999}')
    yield "card-key-twice", with_card('{"a": 1, "a": 2}')
    yield "card-without-digest", with_card("{}")
    yield "card-unsigned", with_card('{"sha256": 1}')


def odd(card, arrays):
    """Damage with true digests, which only a check of the content can find, by kind."""
    first = max(arrays, key=lambda name: arrays[name].size)
    array = arrays[first]
    yield "not-a-number", signed(card, {**arrays, first: np.full(array.shape, np.nan, "f4")})
    yield "infinite", signed(card, {**arrays, first: np.full(array.shape, np.inf, "f4")})
    yield "flags", signed(card, {**arrays, first: array != 0})
    deep = {}
    for _ in range(20):
        deep = {"a": deep}
    yield "card-of-20-levels", signed({**card, "a": deep}, arrays)
    # Whoever knows what the arrays should be refuses these, `read_tensors` does not.
    yield "shape: flat", signed(card, {**arrays, first: np.zeros(array.size + 1, array.dtype)})
    yield "shape: type", signed(card, {**arrays, first: array.astype("f8")})
    yield "shape: missing", signed(card, {k: v for k, v in arrays.items() if k != first})
    yield "shape: unknown", signed(card, {**arrays, "unknown": np.zeros(2**20, "f4")})
    yield "shape: none", signed(card, {})


def check_refusals(read, path, kinds):
    """Check that ``read(path)`` refuses each content in one line."""
    for kind, content in kinds:
        path.write_bytes(content)
        try:
            with pytest.raises(ValueError, match=re.escape(path.name)) as refused:
                read(path)
        except BaseException as problem:
            problem.add_note(f"kind: {kind}")
            raise
        assert len(str(refused.value).splitlines()) == 1, kind


def check_hostile(read, good, path, shapes=True):
    """Check that ``read(path)`` refuses all kinds of damage to the file `good`.

    Other shapes count as damage where `read` knows which ones there should be.
    """
    read(good)
    check_refusals(read, path, damaged(good.read_bytes()))
    kinds = odd(*read_tensors(good))
    check_refusals(read, path, [each for each in kinds if shapes or "shape" not in each[0]])
    path.write_bytes(b"")
    os.truncate(path, LARGEST_FILE + 1)  # a hole, which takes no room
    with pytest.raises(ValueError, match=f"at most {LARGEST_FILE} bytes"):
        read(path)
