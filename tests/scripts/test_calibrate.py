import json

import pytest

from dptse_env.model.parameters import read_parameters
from scripts.calibrate import Args, main
from tests.helpers import SHORT

QUICK = {"env": SHORT, "train": "0:2", "held_out": "1000:1001", "workers": 1}


def test_it_fits_on_some_seeds_and_reports_on_others(tmp_path, capsys):
    main(Args(**QUICK, max_evaluations=20, output=tmp_path))
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
    with pytest.raises(FileExistsError, match=r"fitted\.json"):
        main(Args(**QUICK, output=tmp_path))


def test_a_road_is_calibrated_whose_segments_are_too_short_for_the_default_parameters(
    tmp_path, capsys
):
    """The parameters that ship are left out where they are not stable."""
    road = {"name": "fine-road", "speed_limit": 80.0, "segment_length": 0.04, "duration": 90}
    env = f"{SHORT} {json.dumps({'corridor': road})}"
    given = {**QUICK, "env": env, "train": "0:1"}
    main(Args(**given, max_evaluations=5, name="fine", output=tmp_path / "deep", json=True))
    content = json.loads(capsys.readouterr().out)
    assert content == json.loads((tmp_path / "deep" / "fine.json").read_text())
    assert content["provenance"]["corridor"] == "fine-road"
    assert "paper" not in content["provenance"]["held_out_errors"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"held_out": "1:3"}, r"held_out must not share seeds with train, both have \[1\]"),
        ({"env": f'{SHORT} {{"corridor": {{"length": 1}}}}'}, r"corridor\.length"),
        ({"train": "x"}, "train must be 'first:stop' or one seed, got 'x'"),
    ],
)
def test_bad_arguments_are_named(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        main(Args(**{**QUICK, "output": tmp_path / "out", **changes}))
    assert not (tmp_path / "out").exists()
