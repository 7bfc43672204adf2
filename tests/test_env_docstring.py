"""The docstring of `SensorQueryEnv`, the page of the task: its example runs, its tables hold."""

import ast
import doctest
import inspect

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete

import dptse_env.env
from dptse_env.config import KEYWORDS, PRESETS, SHORTCUTS, resolve
from dptse_env.env import SensorQueryEnv
from dptse_env.registration import ENVIRONMENTS
from dptse_env.spaces.actions import ACTION_ENCODINGS
from dptse_env.spaces.observations import BLOCKS
from tests.helpers import ROOT, SHORT

PAPER = "dptse_env:dptse/PaperHighway-v0"


def table(heading):
    """Return the rows of the table whose first column has a heading, without marks of code."""
    lines = inspect.getdoc(SensorQueryEnv).splitlines()
    cells = [[each.strip(" `") for each in line.strip("|").split("|")] for line in lines]
    start = next(k for k, row in enumerate(cells) if len(row) > 1 and row[0] == heading)
    end = next(k for k in range(start, len(lines)) if not lines[k])
    return cells[start + 2 : end]


def test_its_example_runs():
    failed, attempted = doctest.testmod(dptse_env.env)
    assert (failed, attempted) == (0, 7)


def test_its_table_of_blocks_is_that_of_the_code():
    rows = table("block")
    assert [row[0] for row in rows] == list(BLOCKS)
    assert [ast.literal_eval(row[3]) for row in rows] == [[b.low, b.high] for b in BLOCKS.values()]


@pytest.mark.parametrize(
    "keywords",
    [{}, {"privacy": "paced", "action": "sequential", "loops": {"positions": [0.0, 0.5]}}],
)
def test_its_sizes_of_blocks_are_those_of_observations(keywords):
    interface = gym.make(PAPER, **keywords).unwrapped.interface
    sizes = {"S": 19, "n": 15, "G": 15, "F": 3, "L": 2, "1": 1}
    expected = {row[0]: sizes[row[1]] for row in table("block")}
    for left_out in {*expected} - {*interface.observations.slices}:
        del expected[left_out]
    found = {name: at.stop - at.start for name, at in interface.observations.slices.items()}
    assert list(found.items()) == list(expected.items())


def test_its_spaces_of_actions_are_those_of_the_encodings():
    rows, known = table("action"), {"Box": Box, "Discrete": Discrete, "G": 6, "B": 2}
    assert [row[0] for row in rows] == list(ACTION_ENCODINGS)
    known |= {"MultiBinary": MultiBinary, "MultiDiscrete": MultiDiscrete}
    for name, space, _ in rows:
        env = gym.make(SHORT, action=name)
        assert env.action_space == eval(space, known)


@pytest.mark.parametrize("privacy", ["printed", "paced"])
def test_its_keys_of_info_are_those_of_episodes(privacy):
    env = gym.make(SHORT, privacy=privacy, traffic_seeds=[0], truth_in_info=True, epsilon=5)
    keys = [row[0] for row in table("key")]
    if privacy == "printed":
        keys = [key for key in keys if key not in ("prices", "spent_share", "centre_fallback")]
    at_reset = env.reset(seed=0)[1]
    assert {*at_reset} == {*keys}
    assert {*env.step(np.zeros(6, np.int8))[4]} == {*keys}


def test_its_arguments_are_all_there_are_and_give_the_defaults():
    defaults = {row[0]: ast.literal_eval(row[1]) for row in table("argument")}
    signature = inspect.signature(SensorQueryEnv).parameters
    own = {*signature} - {"preset", "overrides"}
    assert {name: defaults.pop(name) for name in own} == {
        name: signature[name].default for name in own
    }
    assert {*defaults} == {*KEYWORDS, *SHORTCUTS}
    assert resolve("paper-highway", defaults) == PRESETS["paper-highway"]


def test_its_ids_are_those_that_are_registered():
    rows = table("id")
    assert {f"dptse/{row[0]}" for row in rows} == {*ENVIRONMENTS}
    for name, n, segments, record, release, estimator, bandwidth, traffic in rows:
        config = PRESETS[ENVIRONMENTS[f"dptse/{name}"]]
        road, privacy = config.corridor, config.privacy
        found = (
            road.geometry.n_mainline,
            road.geometry.n_segments,
            road.conditions.duration,
            config.bandwidth,
        )
        assert found == (int(n), int(segments), int(record.removesuffix(" s")), int(bandwidth))
        assert config.estimator == estimator
        assert release == f"{privacy.preset}, {privacy.epsilon:g}"
        assert traffic == (
            "random" if type(road.conditions.demand).__name__.endswith("Distribution") else "fixed"
        )


def test_the_page_of_keywords_has_the_defaults_of_every_id():
    page = (ROOT / "docs" / "reference" / "configuration.md").read_text(encoding="utf-8")
    section = page.partition("\n## Ids\n")[2].partition("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("| ")]
    (_, *ids), _, *rows = [[e.strip(" `") for e in line.strip("|").split("|")] for line in lines]
    assert {f"dptse/{name}" for name in ids} == {*ENVIRONMENTS}
    for name, *shown in zip(ids, *(row[1:] for row in rows), strict=True):
        config = PRESETS[ENVIRONMENTS[f"dptse/{name}"]]
        road, privacy = config.corridor, config.privacy
        is_drawn = type(road.conditions.demand).__name__.endswith("Distribution")
        expected = (
            config.estimator, config.estimator_settings, config.parameters.name, config.bandwidth,
            privacy.preset, f"{privacy.epsilon:g}", f"{privacy.delta:g}",
            road.geometry.n_mainline, road.conditions.duration, "drawn" if is_drawn else "fixed",
        )  # fmt: skip
        assert shown == [str(each) for each in expected]
