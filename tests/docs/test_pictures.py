"""The pictures of the pages about the environment: where they are, and that they show the rows."""

import re
import runpy

import pytest

from tests.helpers import ROOT

PAGES = {
    page.stem: page.read_text(encoding="utf-8")
    for page in (ROOT / "docs" / "environment").glob("*.md")
}
pytestmark = pytest.mark.skipif(
    not (ROOT / "results").is_dir(), reason="a source archive has no results"
)


@pytest.fixture(scope="module")
def code():
    return runpy.run_path(str(ROOT / "docs" / "_site" / "environment.py"))


def test_every_picture_is_drawn_and_stands_on_a_page_with_alternative_text(code):
    shown = re.findall(r"!\[([^\]]{60,})\]\(\.\./images/([\w.]+)\)", "".join(PAGES.values()))
    assert {name for _, name in shown} == {*code["PICTURES"]}
    assert all((ROOT / "docs" / "images" / name).is_file() for name in code["PICTURES"])


def test_the_page_says_of_the_estimators_what_their_picture_shows(code):
    texts = {text.get_text() for axis in code["draw_estimators"]().axes for text in axis.texts}
    said = re.search(r"!\[(.*?)\]", PAGES["estimators"], re.DOTALL)[1]
    assert set(re.findall(r"[\d.]+\d(?=\))", said)) <= texts


def test_the_measured_road_has_the_errors_of_its_page(code):
    errors = {name: interval.mean for name, interval in code["on_measured_road"]().items()}
    assert errors.keys() == {"random_walk", "blend", "ukf", "ekf", "enkf", "asm", "recurrent"}
    assert min(errors, key=errors.get) == "recurrent"
