import json
import re
from dataclasses import asdict

import pytest

from dptse_env.model.parameters import (
    ARZParameters,
    available_parameters,
    load_parameters,
    read_parameters,
    write_parameters,
)

GOOD = {
    "name": "x",
    "free_flow_speed": 100.0,
    "jam_density": 300.0,
    "gamma": 1.0,
    "relaxation_time": 30.0,
}


def test_named_sets_hold_their_published_values():
    assert available_parameters() == ("paper", "w99-3lane")
    assert load_parameters("paper") == ARZParameters("paper", 102.0, 333.0, 2.0, 60.0, 3)
    assert load_parameters("w99-3lane") == ARZParameters("w99-3lane", 140.0, 400.0, 0.45, 50.0, 3)


def test_unknown_set_names_those_there_are():
    with pytest.raises(ValueError, match="must be one of paper, w99-3lane, got 'papers'"):
        load_parameters("papers")


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("free_flow_speed", 0.0, r"parameters\.free_flow_speed must be .*, got 0\.0"),
        ("jam_density", float("nan"), r"parameters\.jam_density must be .*, got nan"),
        ("jam_density", float("inf"), r"parameters\.jam_density must be .*, got inf"),
        ("gamma", -2.0, r"parameters\.gamma must be a number in \[0\.01, 100\], got -2\.0"),
        ("relaxation_time", "60", r"parameters\.relaxation_time must be .*, got '60'"),
        ("lanes", 1.5, r"parameters\.lanes must be an integer in 1\.\.16, got 1\.5"),
    ],
)
def test_bad_value_is_named(field, value, message):
    with pytest.raises(ValueError, match=message):
        ARZParameters(**{**GOOD, field: value})


def test_gamma_is_not_confined_to_one_and_two():
    assert ARZParameters(**{**GOOD, "gamma": 0.4}).gamma == 0.4


def test_mapping_refuses_unknown_and_missing_keys():
    with pytest.raises(
        ValueError, match=r"parameters\.v_f is unknown; allowed: name, free_flow_speed"
    ):
        ARZParameters.from_mapping({**GOOD, "v_f": 1.0})
    with pytest.raises(ValueError, match=r"parameters\.gamma is missing"):
        ARZParameters.from_mapping({k: v for k, v in GOOD.items() if k != "gamma"})


def test_written_set_reads_back_with_its_provenance(tmp_path):
    parameters = ARZParameters(**GOOD)
    path = tmp_path / "x.json"
    write_parameters(path, parameters, {"source": "a test"})
    assert read_parameters(path) == parameters
    assert json.loads(path.read_text())["provenance"] == {"source": "a test"}
    assert json.loads(path.read_text())["parameters"] == asdict(parameters)


def test_file_without_parameters_is_refused(tmp_path):
    path = tmp_path / "x.json"
    path.write_text("[]")
    message = rf"^{re.escape(str(path))} must be a mapping with the keys parameters, provenance"
    with pytest.raises(ValueError, match=message):
        read_parameters(path)
