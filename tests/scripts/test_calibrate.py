import json

import pytest

from dptse_env.model.parameters import read_parameters
from scripts.calibrate import Args, main
from scripts.cli import Environment

PAPER, SHORT = "dptse_env:dptse/PaperHighway-v0", "dptse_env:dptse/ShortHighway-v0"


def test_it_fits_on_some_seeds_and_reports_on_others(tmp_path, capsys):
    main(
        Args(
            env=SHORT, train="0:2", held_out="1000:1001", max_evaluations=20,
            workers=1, output=tmp_path,
        )
    )  # fmt: skip
    printed = capsys.readouterr().out
    parameters = read_parameters(tmp_path / "fitted.json")
    assert (parameters.lanes, parameters.derived_from) == (2, "w99-3lane")
    provenance = json.loads((tmp_path / "fitted.json").read_text())["provenance"]
    errors = provenance["held_out_errors"]
    for name in ("persistence", "paper", "w99-3lane", "fitted"):
        assert name in printed
        assert len(errors[name]["density"]) == len(errors[name]["horizons"])
    assert errors["fitted"]["density"][-1] < errors["persistence"]["density"][-1]
    assert provenance["train"] == "0:2"


def test_a_road_is_recorded_whose_segments_are_too_short_for_the_default_parameters():
    for length in (0.05, 0.04):
        road = Environment(f'{PAPER} {{"corridor": {{"segment_length": {length}}}}}').corridor()
        assert road.segment_lengths[0] == length


def test_a_corridor_of_other_fields_is_calibrated(tmp_path):
    main(
        Args(
            env=f'{SHORT} {{"corridor": {{"name": "slow-road", "speed_limit": 80.0, "duration": 120}}}}', train="0:1", held_out="1000:1001",
            max_evaluations=5, workers=1, name="slow", output=tmp_path / "deep" / "out",
        )
    )  # fmt: skip
    content = json.loads((tmp_path / "deep" / "out" / "slow.json").read_text())
    assert content["provenance"]["corridor"] == "slow-road"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"held_out": "1:3"}, r"held_out must not share seeds with train, both have \[1\]"),
        ({"env": f'{PAPER} {{"corridor": {{"length": 1}}}}'}, r"corridor\.length"),
        ({"train": "x"}, "train must be 'first:stop' or one seed, got 'x'"),
    ],
)
def test_bad_arguments_are_named(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        main(Args(**{"train": "0:2", "output": tmp_path / "out", **changes}))
    assert not (tmp_path / "out").exists()
