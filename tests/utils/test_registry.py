"""Optional packages are named with their extra."""

import pickle
import re
import sys
import tomllib
from pathlib import Path

import pytest

from dptse_env import versions
from dptse_env.utils.registry import EXTRAS, MissingExtraError, needed_for

PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))
BROUGHT_BY = {"sumo": "eclipse_sumo", "pygame": "pygame_ce"}


def test_each_extra_brings_its_modules_and_no_others():
    for extra, modules in EXTRAS.items():
        requirements = PROJECT["project"]["optional-dependencies"][extra]
        names = {re.split(r"[^\w-]", each)[0] for each in requirements} - {"dptse-env"}
        brought = {name.replace("-", "_") for name in names}
        assert {BROUGHT_BY.get(module, module) for module in modules} == brought


def test_each_package_has_one_range_of_versions():
    project = PROJECT["project"]
    every = sum(project["optional-dependencies"].values(), project["dependencies"])
    ranges = {(re.split(r"[^\w-]", each)[0], each) for each in every if "dptse-env" not in each}
    assert len(ranges) == len({name for name, _ in ranges})
    tested = versions.TESTED_SUMO
    assert {f"{each}>={tested}" for each in ("eclipse-sumo", "libsumo", "sumolib")} < set(every)


def test_a_missing_module_names_its_extra(monkeypatch):
    for extra, module in [(extra, each) for extra, found in EXTRAS.items() for each in found]:
        monkeypatch.setitem(sys.modules, module, None)
        named = rf"a page needs {module}, .* pip install .*'dptse-env\[{extra}\]'"
        with pytest.raises(MissingExtraError, match=named) as refused, needed_for("a page"):
            __import__(module)
        assert str(pickle.loads(pickle.dumps(refused.value))) == str(refused.value)


@pytest.mark.parametrize("code", ["import no_such_module", "from json import no_such_name"])
def test_another_failed_import_keeps_its_error(code):
    with pytest.raises(ImportError, match="no_such") as refused, needed_for("a page"):
        exec(code)
    assert not isinstance(refused.value, MissingExtraError)


def test_what_names_the_extra_is_closest_to_the_import(monkeypatch):
    monkeypatch.setitem(sys.modules, "polars", None)
    expected = pytest.raises(MissingExtraError, match=r"^JSON needs polars")
    with expected, needed_for("dptse"), needed_for("JSON"):
        __import__("polars")
