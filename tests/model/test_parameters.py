import json
import re
from dataclasses import asdict, replace

import pytest

from dptse_env.model import ARZModel
from dptse_env.model.parameters import (
    ARZParameters,
    available_parameters,
    load_parameters,
    read_parameters,
    write_parameters,
)
from dptse_env.utils.validation import from_mapping
from tests.helpers import UNEVEN

from .oracle import HIGHWAY, PUBLISHED

GOOD = {
    "name": "x",
    "free_flow_speed": 100.0,
    "jam_density": 300.0,
    "gamma": 0.4,  # as fits of real traffic may have
    "relaxation_time": 30.0,
}


def test_named_sets_hold_their_published_values():
    assert available_parameters() == ("published", "w99-3lane")
    assert load_parameters("published") == ARZParameters("published", 102.0, 333.0, 2.0, 60.0, 3)
    assert load_parameters("w99-3lane") == ARZParameters("w99-3lane", 140.0, 400.0, 0.45, 50.0, 3)
    with pytest.raises(ValueError, match="must be one of published, w99-3lane, got 'paper'"):
        load_parameters("paper")


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("free_flow_speed", 0.0, r"free_flow_speed must be .*, got 0\.0"),
        ("jam_density", float("nan"), r"jam_density must be .*, got nan"),
        ("gamma", -2.0, r"gamma must be a number in \[0\.01, 100\], got -2\.0"),
        ("relaxation_time", "60", r"relaxation_time must be .*, got '60'"),
        ("lanes", 1.5, r"lanes must be an integer in 1\.\.16, got 1\.5"),
        ("v_f", 1.0, r"v_f is unknown; allowed: name, free_flow_speed"),
    ],
)
def test_bad_value_is_named(field, value, message):
    with pytest.raises(ValueError, match=rf"^parameters\.{message}"):
        from_mapping(ARZParameters, {**GOOD, field: value}, "parameters")


def test_written_set_reads_back_with_its_provenance(tmp_path):
    parameters = ARZParameters(**GOOD)
    path = tmp_path / "x.json"
    write_parameters(path, parameters, {"source": "a test"})
    assert read_parameters(path) == parameters
    content = json.loads(path.read_text())
    assert content == {"parameters": asdict(parameters), "provenance": {"source": "a test"}}
    del content["parameters"]["gamma"]
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=rf"^{re.escape(str(path))}: parameters\.gamma is missing"):
        read_parameters(path)
    path.write_text("[]")
    with pytest.raises(
        ValueError, match=rf"^{re.escape(str(path))} must be a mapping with the keys parameters"
    ):
        read_parameters(path)


@pytest.mark.parametrize("time_step", [1.77, 0.0, -1.0, float("nan")])
def test_a_step_too_long_names_the_longest_admissible(time_step):
    model = ARZModel(HIGHWAY.road, PUBLISHED, time_step)
    with pytest.raises(ValueError, match=r"CFL condition needs a time step > 0 and at most 1.76 s"):
        model.dynamics  # noqa: B018
    assert ARZModel(HIGHWAY.road, PUBLISHED, 1.76).dynamics[1].relaxation > 0


def test_strong_relaxation_a_large_gamma_and_the_shortest_segment_bound_the_step_too():
    for parameters, road, message in (
        (replace(PUBLISHED, relaxation_time=0.5), HIGHWAY, r"must be longer .* at most 0.43 s"),
        (replace(PUBLISHED, gamma=4.0), HIGHWAY, r"at most 0.88 s"),
        (PUBLISHED, UNEVEN, r"at least (0\.\d+) km .*, got 0\.08 km"),
    ):
        with pytest.raises(ValueError, match=message) as refused:
            ARZModel(road.road, parameters, 1.6).require_time_step()
    # The shortest segment that is named is admissible, and none that is shorter.
    least = float(re.findall(r"at least (0\.\d+) km", str(refused.value))[0])
    assert PUBLISHED.largest_time_step(least - 1e-4) < 1.6 <= PUBLISHED.largest_time_step(least)
