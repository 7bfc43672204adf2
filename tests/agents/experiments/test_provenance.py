import copy
import dataclasses
import json

import pytest

from agents.experiments.provenance import (
    PROVENANCE_FILE,
    check_folder,
    design_provenance,
    environment_provenance,
    results_provenance,
    take_folder,
)
from agents.studies.paper.plan import PaperDesign

DESIGN = PaperDesign(estimators=("ekf",), seeds="2000:2002")


@pytest.fixture(scope="module")
def provenance():
    return design_provenance(DESIGN)


def test_it_names_versions_settings_and_parameters(provenance):
    made_with = provenance["made_with"]
    assert made_with["versions"]["dptse-env"]
    assert made_with["parameters"]["paper"]["free_flow_speed"] == 102.0
    assert set(made_with["settings"]) == {
        *(f"{a}-{b}-{c}" for a in ("ekf", "random_walk") for b in ("paper", "w99-3lane")
          for c in ("paper", "corrected")),
        "open_loop-paper-paper", "open_loop-w99-3lane-paper",
    }  # fmt: skip
    assert "process_noise" in made_with["settings"]["ekf-paper-paper"]
    assert set(provenance["tuned"]) <= set(made_with["settings"])


def test_several_environments_share_their_settings():
    configs = DESIGN.configs
    parts = {name: environment_provenance(name, "any", configs[:2]) for name in ("a", "b")}
    provenance = results_provenance({"cells": parts}, configs)
    assert provenance["made_with"]["cells"]["b"]["env"] == "b"
    assert set(provenance["made_with"]) == {"cells", "settings"}


def test_a_folder_is_started_and_gone_on_with(provenance, tmp_path):
    folder = tmp_path / "deep" / "out"
    assert check_folder(folder, provenance) is None
    assert not folder.exists()
    take_folder(folder, provenance)
    (folder / "episodes.csv").touch()
    assert take_folder(folder, provenance) == check_folder(folder, provenance) == provenance
    assert json.loads((folder / PROVENANCE_FILE).read_text()) == provenance


def test_another_state_of_the_code_is_noted_where_results_are_added(provenance, tmp_path):
    before = {**provenance, "sources": ["before"]}
    take_folder(tmp_path, before)
    assert check_folder(tmp_path, provenance) == before
    both = ["before", *provenance["sources"]]
    assert take_folder(tmp_path, provenance)["sources"] == both
    assert take_folder(tmp_path, provenance)["sources"] == both


def test_other_seeds_and_points_go_on_in_the_same_folder(provenance, tmp_path):
    take_folder(tmp_path, provenance)
    take_folder(tmp_path, design_provenance(dataclasses.replace(DESIGN, seeds="2000:2003")))


def test_settings_of_new_estimators_are_added(provenance, tmp_path):
    take_folder(tmp_path, provenance)
    take_folder(tmp_path, design_provenance(dataclasses.replace(DESIGN, estimators=("ukf",))))
    kept = json.loads((tmp_path / PROVENANCE_FILE).read_text())["made_with"]["settings"]
    assert {"ekf-paper-paper", "ukf-paper-paper"} <= set(kept)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("versions", "dptse-env"), "0.0.1"),
        (("settings", "ekf-paper-paper", "process_noise"), [0.5, 0.5]),
        (("parameters", "w99-3lane", "gamma"), 3.0),
        (("corridor",), "another"),
    ],
)
def test_a_folder_made_otherwise_is_refused_with_both_named(provenance, path, value, tmp_path):
    before = copy.deepcopy(provenance)
    place = before["made_with"]
    for key in path[:-1]:
        place = place[key]
    now, place[path[-1]] = place[path[-1]], value
    take_folder(tmp_path, before)
    for take in (take_folder, check_folder):
        with pytest.raises(ValueError, match="made with other settings") as refusal:
            take(tmp_path, provenance)
        for word in (".".join(path), repr(value), repr(now)):
            assert word in str(refusal.value)
    assert json.loads((tmp_path / PROVENANCE_FILE).read_text()) == before


@pytest.mark.parametrize("text", ["", "{}", '{"made_with": {}}'])
def test_a_damaged_origin_is_named(provenance, text, tmp_path):
    (tmp_path / PROVENANCE_FILE).write_text(text)
    with pytest.raises(ValueError, match=r"run\.json is not as this program writes it"):
        take_folder(tmp_path, provenance)


def test_a_folder_of_something_else_is_refused(provenance, tmp_path):
    (tmp_path / "thesis.txt").touch()
    with pytest.raises(ValueError, match=r"not empty and has no run\.json"):
        take_folder(tmp_path, provenance)


def test_values_out_of_range_show_before_anything_is_run():
    with pytest.raises(ValueError, match=r"bandwidth must be in 1\.\.15, got 16"):
        design_provenance(dataclasses.replace(DESIGN, cv_segments=(5, 6, 16)))
