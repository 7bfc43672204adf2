import copy
import dataclasses
import json

import pytest

from agents.experiments.provenance import FILE, provenance, take_folder
from agents.studies.paper.plan import Design

DESIGN = Design(estimators=("ekf",), seeds=(2000, 2001))


@pytest.fixture(scope="module")
def own():
    return provenance(DESIGN)


def test_it_names_versions_settings_and_parameters(own):
    made_with = own["made_with"]
    assert made_with["versions"]["dptse-env"]
    assert made_with["parameters"]["paper"]["free_flow_speed"] == 102.0
    assert set(made_with["settings"]) == {
        *(f"{a}-{b}-{c}" for a in ("ekf", "random_walk") for b in ("paper", "w99-3lane")
          for c in ("paper", "corrected")),
        "open_loop-paper-paper", "open_loop-w99-3lane-paper",
    }  # fmt: skip
    assert "process_noise" in made_with["settings"]["ekf-paper-paper"]
    assert set(own["tuned"]) <= set(made_with["settings"])


def test_a_folder_is_started_and_gone_on_with(own, tmp_path):
    folder = tmp_path / "deep" / "out"
    take_folder(folder, own)
    (folder / "episodes.csv").touch()
    take_folder(folder, own)
    assert json.loads((folder / FILE).read_text()) == own


def test_another_state_of_the_code_is_noted(own, tmp_path):
    take_folder(tmp_path, {**own, "sources": ["before"]})
    assert take_folder(tmp_path, own)["sources"] == ["before", *own["sources"]]
    assert take_folder(tmp_path, own)["sources"] == ["before", *own["sources"]]


def test_other_seeds_and_points_go_on_in_the_same_folder(own, tmp_path):
    take_folder(tmp_path, own)
    take_folder(tmp_path, provenance(dataclasses.replace(DESIGN, seeds=(2000, 2001, 2002))))


def test_settings_of_new_estimators_are_added(own, tmp_path):
    take_folder(tmp_path, own)
    take_folder(tmp_path, provenance(dataclasses.replace(DESIGN, estimators=("ukf",))))
    kept = json.loads((tmp_path / FILE).read_text())["made_with"]["settings"]
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
def test_a_folder_made_otherwise_is_refused_with_both_named(own, path, value, tmp_path):
    before = copy.deepcopy(own)
    place = before["made_with"]
    for key in path[:-1]:
        place = place[key]
    now, place[path[-1]] = place[path[-1]], value
    take_folder(tmp_path, before)
    with pytest.raises(ValueError, match="made with other settings") as refusal:
        take_folder(tmp_path, own)
    for word in (".".join(path), repr(value), repr(now)):
        assert word in str(refusal.value)
    assert json.loads((tmp_path / FILE).read_text()) == before


@pytest.mark.parametrize("text", ["", "{}", '{"made_with": {}}'])
def test_a_damaged_origin_is_named(own, text, tmp_path):
    (tmp_path / FILE).write_text(text)
    with pytest.raises(ValueError, match=r"run\.json is not as this program writes it"):
        take_folder(tmp_path, own)


def test_a_folder_of_something_else_is_refused(own, tmp_path):
    (tmp_path / "thesis.txt").touch()
    with pytest.raises(ValueError, match=r"not empty and has no run\.json"):
        take_folder(tmp_path, own)


def test_values_out_of_range_show_before_anything_is_run():
    with pytest.raises(ValueError, match=r"bandwidth must be in 1\.\.15, got 16"):
        provenance(dataclasses.replace(DESIGN, cv_segments=(5, 6, 16)))
