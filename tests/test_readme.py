"""The README's Python runs as it stands."""

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"


def test_it_can_be_read_in_three_minutes():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 150


@pytest.mark.slow
def test_its_examples_run_one_after_the_other(capsys):
    pytest.importorskip("stable_baselines3")
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    names = {}
    for block in blocks:
        exec(block, names)
    assert len(blocks) == 3
    assert "mean error 0." in capsys.readouterr().out
    assert names["schedule"].predict(names["env"].reset(seed=0)[0])[0].shape == (2,)
