import base64
import dataclasses
import json
import re
import shutil
import subprocess
import zlib

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("plotly")

from agents.environments import unwrap
from agents.evaluation import page
from agents.evaluation.episodes import EpisodeScore, run_episode
from agents.evaluation.page import packed, page_data, write_page
from agents.evaluation.report import Report
from agents.evaluation.watched import Watched
from dptse_env.rendering import History
from dptse_env.schedules import make_schedule
from scripts.evaluate import Args, main

SHORT = "dptse_env:dptse/ShortHighway-v0"
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


def watched(name):
    env = gym.make(SHORT, horizon=80, estimator="random_walk")
    process = unwrap(env).process
    episode = Watched(name, process.config.corridor, 0, History.empty(process))
    run_episode(
        env, make_schedule(name, env), traffic_seed=0, seed=0,
        on_second=lambda: episode.append(process),
    )  # fmt: skip
    return episode


@pytest.fixture(scope="module")
def episodes():
    return [watched("paper"), watched("round-robin")]


@pytest.fixture(scope="module")
def report():
    def scores(shift):
        return [EpisodeScore(seed, 10.0 + shift + seed, 5.0, -0.1, 0, 0, 0) for seed in (0, 1)]

    cells = {("random_walk", "paper"): scores(0.0), ("random_walk", "round-robin"): scores(1.0)}
    return Report(cells, "paper", "A title with <script>")


def unpacked(content):
    levels = np.frombuffer(zlib.decompress(base64.b64decode(content["bytes"])), np.uint8)
    return levels.reshape(content["shape"]) * content["step"]


def test_maps_keep_their_values_to_a_step():
    values = list(np.random.default_rng(0).uniform(0, 300, (50, 7)))
    content = packed(values, 300.0)
    assert np.abs(unpacked(content) - values).max() <= 0.5 * content["step"] + 1e-9


def test_the_page_has_what_happened(report, episodes):
    data = json.loads(json.dumps(page_data(report, episodes)))
    first = episodes[0]
    assert data["seconds"] == list(range(81))
    assert np.abs(unpacked(data["truth"]) - first.history.truth).max() <= data["truth"]["step"]
    paper, other = data["policies"]
    assert paper["error"] == pytest.approx(first.history.rmse, abs=1e-3)
    assert unpacked(paper["queried"]).astype(bool).tolist() == [
        q.tolist() for q in first.history.queried
    ]
    assert paper["queried"] != other["queried"]
    corridor = first.corridor
    assert data["road"]["edges"][-1] == pytest.approx(sum(corridor.segment_lengths[:6]))
    assert data["road"]["incidents"][0]["segment"] == first.incidents[0].segment
    assert [row["policy"] for row in data["ladder"]] == ["paper", "round-robin"]
    assert data["ladder"][0]["rmse_density"][0] == pytest.approx(10.5)


def test_seconds_are_left_out_of_a_page_that_would_be_too_large(
    report, episodes, tmp_path, monkeypatch
):
    whole = len(page.render(report, episodes, 1).encode())
    monkeypatch.setattr(page, "LARGEST_PAGE", whole - 1)
    write_page(tmp_path / "page.html", report, episodes)
    text = (tmp_path / "page.html").read_text()
    assert len(text.encode()) < whole
    found = re.search(r'application/json">(.*?)</script>', text, re.DOTALL)
    assert json.loads(found[1])["seconds"][:3] == [0, 2, 4]
    monkeypatch.setattr(page, "LARGEST_PAGE", 1000)
    with pytest.raises(ValueError, match="would be larger than 1000 bytes"):
        write_page(tmp_path / "other.html", report, episodes)
    assert not (tmp_path / "other.html").exists()


def test_a_page_without_episodes_is_refused(report, tmp_path):
    with pytest.raises(ValueError, match="a page needs one watched episode"):
        write_page(tmp_path / "page.html", report, [])


def test_a_page_without_data_is_refused(report, episodes, tmp_path):
    empty = dataclasses.replace(episodes[0])
    empty.history = dataclasses.replace(empty.history, truth=[])
    with pytest.raises(ValueError, match="of a second at least"):
        write_page(tmp_path / "page.html", report, [episodes[0], empty])
    assert list(tmp_path.iterdir()) == []


def test_the_extra_is_named_where_plotly_is_missing(report, episodes, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "plotly.offline", None)
    with pytest.raises(ImportError, match=r"pip install 'dptse-env\[train\]'"):
        write_page(tmp_path / "page.html", report, episodes)


def test_a_title_cannot_break_the_page(report, episodes, tmp_path):
    write_page(tmp_path / "page.html", report, episodes)
    text = (tmp_path / "page.html").read_text()
    assert "title with <script>" not in text
    assert "http://" not in text.split("<script>")[0]
    assert len(text.encode()) <= 5_000_000


def test_evaluate_leaves_a_page_and_says_where(tmp_path, capsys):
    main(
        Args(
            env=SHORT, schedules=("round-robin",), estimators=("random_walk",), seeds="2000:2002",
            html=True, workers=1, output=tmp_path,
        )
    )  # fmt: skip
    text = (tmp_path / "page.html").read_text()
    assert '"name":"round-robin"' in text
    assert str(tmp_path / "page.html") in capsys.readouterr().out


PROBE = """
<script>
window.addEventListener("error", (event) => { document.title = "failed: " + event.message; });
const waiting = setInterval(() => {
  if (document.body.dataset.ready !== "yes") return;
  clearInterval(waiting);
  const slider = document.getElementById("slider");
  slider.value = 40; slider.dispatchEvent(new Event("input"));
  Plotly.Fx.hover("truth", { xval: 40, yval: 0.25 });
  setTimeout(look, 500);
}, 50);
function look() {
  const hovered = document.querySelectorAll("#truth .hoverlayer text").length;
  document.getElementById("dark").click();
  const all = (selector) => [...document.querySelectorAll(selector)];
  const wide = all("body *").filter((each) => !each.closest("svg")
    && each.getBoundingClientRect().right > innerWidth + 2);
  document.body.dataset.found = JSON.stringify({
    clock: document.getElementById("clock").textContent,
    hover: hovered,
    maps: all(".heatmaplayer image").length,
    dark: document.documentElement.className,
    wide: wide.length,
  });
}
</script>
"""


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
@pytest.mark.parametrize("width", [390, 1280])
def test_a_browser_shows_it_without_an_error(report, episodes, tmp_path, width):
    path = tmp_path / "page.html"
    write_page(path, report, episodes)
    path.write_text(path.read_text().replace("</body>", f"{PROBE}</body>"))
    # A window has a least width, a frame has none.
    frame = tmp_path / "frame.html"
    frame.write_text(
        f'<body><iframe id="f" src="page.html" style="width:{width}px;height:900px"></iframe>'
        '<script>setInterval(() => { const inner = document.getElementById("f").contentDocument;'
        "document.body.dataset.found = inner?.body?.dataset.found ?? '';"
        "document.body.dataset.title = inner?.title ?? ''; }, 50);</script></body>"
    )
    done = subprocess.run(
        [
            CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr",
            "--allow-file-access-from-files", "--virtual-time-budget=20000",
            "--window-size=1400,1000", "--dump-dom", frame.as_uri(),
        ],
        capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert "CONSOLE" not in done.stderr
    found = re.search(r'data-found="([^"]+)"', done.stdout)
    assert found, done.stdout[-2000:]
    seen = json.loads(found[1].replace("&quot;", '"'))
    assert seen["clock"] == "Second 40 of 80"
    assert seen["hover"] > 0
    assert seen["maps"] == 7
    assert seen["dark"] == "dark"
    assert seen["wide"] == 0
    assert "failed" not in done.stdout
