import csv
import json
from pathlib import Path

import pytest
from PIL import Image

from scripts.evaluate import Args, main

SHORT = "dptse_env:dptse/ShortHighway-v0"


def test_it_leaves_table_scores_and_figures(tmp_path, capsys):
    main(
        Args(
            env=SHORT, schedules=("round-robin", "none"), estimators=("random_walk",),
            seeds="2000:2002", output=tmp_path / "out", workers=1,
        )
    )  # fmt: skip
    printed = capsys.readouterr().out
    for word in ("random_walk", "round-robin", "none", "paper", "±"):
        assert word in printed
    with (tmp_path / "out" / "episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {(row["schedule"], row["traffic_seed"]) for row in rows} == {
        (name, seed) for name in ("round-robin", "none", "paper") for seed in ("2000", "2001")
    }
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())["rows"]
    by_name = {row["policy"]: row for row in summary}
    scores = [float(row["rmse_density"]) for row in rows if row["schedule"] == "none"]
    assert by_name["none"]["mean"]["rmse_density"]["mean"] == pytest.approx(sum(scores) / 2)
    assert by_name["paper"]["difference"]["rmse_density"]["mean"] == 0.0
    assert (
        by_name["none"]["mean"]["rmse_density"]["mean"]
        > by_name["paper"]["mean"]["rmse_density"]["mean"]
    )
    for name in ("schedules.png", "space_time.png"):
        with Image.open(tmp_path / "out" / name) as image:
            assert min(image.size) > 300


def test_two_runs_agree(tmp_path):
    for name in ("one", "two"):
        main(
            Args(
                env=SHORT, schedules=("random",), estimators=("ekf",), seeds="2000:2002",
                output=tmp_path / name, workers=1,
            )
        )  # fmt: skip
    one, two = ((tmp_path / name / "episodes.csv").read_text() for name in ("one", "two"))
    assert one == two


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"schedules": ("best",)}, "unknown schedule 'best'"),
        ({"estimators": ("kf",)}, "estimator must be one of"),
        ({"seeds": "all"}, "must be 'first:stop' or one seed, got 'all'"),
        ({"privacy": "none"}, r"privacy\.preset must be one of"),
    ],
)
def test_bad_arguments_are_named_and_nothing_is_written(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        main(Args(**{"env": SHORT, "output": Path(tmp_path / "out"), **changes}))
    assert not (tmp_path / "out").exists()
