"""Optional packages are named with their extra."""

import pickle
import re
import sys
import tomllib
from pathlib import Path

import pytest

from dptse_env.utils.extras import EXTRAS, MissingExtraError, needed_for

PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))
BROUGHT_BY = {"sumo": "eclipse_sumo"}


@pytest.mark.parametrize("extra", EXTRAS)
def test_each_extra_brings_its_modules_and_no_others(extra):
    requirements = PROJECT["project"]["optional-dependencies"][extra]
    brought = {re.split(r"[^\w-]", each)[0].replace("-", "_") for each in requirements}
    assert {BROUGHT_BY.get(module, module) for module in EXTRAS[extra]} == brought


@pytest.mark.parametrize(
    ("extra", "module"), [(extra, module) for extra in EXTRAS for module in EXTRAS[extra]]
)
def test_a_missing_module_names_its_extra(extra, module, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    expected = f"a page needs {module}, which is not installed: pip install 'dptse-env[{extra}]'"
    exact = f"^{re.escape(expected)}$"
    with pytest.raises(MissingExtraError, match=exact) as refused, needed_for("a page"):
        __import__(module)
    assert str(pickle.loads(pickle.dumps(refused.value))) == expected


@pytest.mark.parametrize("code", ["import no_such_module", "from json import no_such_name"])
def test_another_failed_import_keeps_its_error(code):
    with pytest.raises(ImportError, match="no_such") as refused, needed_for("a page"):
        exec(code)
    assert not isinstance(refused.value, MissingExtraError)


def test_what_names_the_extra_is_closest_to_the_import(monkeypatch):
    monkeypatch.setitem(sys.modules, "ijson", None)
    expected = pytest.raises(MissingExtraError, match=r"^JSON needs ijson")
    with expected, needed_for("dptse"), needed_for("JSON"):
        __import__("ijson")
