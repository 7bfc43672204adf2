"""A road is fitted: what is searched, what is chosen, and what its file says afterwards."""

import dataclasses
import json
import re
import shutil
import tomllib
from itertools import product

import gymnasium as gym
import numpy as np
import polars as pl
import pytest
from scipy import stats

pytest.importorskip("tomlkit")

from agents.executors import this_process
from agents.fitting import parameters as searching
from agents.fitting.budget import NO_NOISE, advice, budget_table
from agents.fitting.choice import ESTIMATORS_TRIED, Choice
from agents.fitting.page import honesty
from agents.fitting.parameters import fit_parameters, start_from
from agents.fitting.road import find_road
from agents.fitting.road_file import copy_of, write_choice
from agents.play import Cell
from agents.seeds import KINDS
from agents.study import Place
from dptse_env.model import load_parameters
from dptse_env.model.parameters import write_parameters
from dptse_env.traffic import RecordLibrary, read_road, write_corridor
from dptse_env.versions import code_version
from scripts.fit import Args, estimators_tried
from tests.scripts.commands import refused, run_command

ID = "dptse_env:dptse/PrivateHighway-v1"
ROAD = """# my road
n_mainline = 4     # segments
lanes = 2
segment_length = 0.1
speed_limit = 90
duration = 90

# how many come
[demand]
mainline = [[0, 2400]]  # veh/h
"""
BRIEF = (
    "--train-seeds", "0:2", "--validation-seeds", "1000:1002", "--test-seeds", "2000:2002",
    "--trials", "4", "--estimators", "ekf", "random_walk",
    "--policies", "round-robin", "oldest-first", "--workers", "1",
)  # fmt: skip


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A road, fitted, and what the command printed."""
    path = tmp_path_factory.mktemp("fit") / "my-road.toml"
    path.write_text(ROAD)
    done = run_command("fit", path, *BRIEF, "--json")
    assert done.returncode == 0, done.stderr
    assert "\nplay 2 options of the policy on validation traffic\n" in done.stderr
    return path, json.loads(done.stdout)


def files_of(folder):
    return {each: each.read_bytes() for each in sorted(folder.rglob("*")) if each.is_file()}


def test_the_dwell_is_that_of_the_traffic_which_is_played(tmp_path):
    (tmp_path / "my-road.toml").write_text(ROAD)
    dense = '{"demand": {"base": {"mainline": [[0, 3600]]}}}'
    plain, other = (road_in(tmp_path, env) for env in (ID, f"{ID} {dense}"))
    library = RecordLibrary()
    assert other.measure_dwell(library) > plain.measure_dwell(library)
    assert other.config.corridor.digest != plain.config.corridor.digest


def test_the_file_has_the_choice_keeps_all_else_and_makes_an_environment(fitted):
    path, found = fitted
    text = path.read_text()
    assert copy_of(path).read_text() == ROAD
    assert [line for line in ROAD.splitlines() if line not in text.splitlines()] == []
    content = tomllib.loads(text)
    assert content["environment"]["estimator"] == found["estimator"]
    assert 3.0 < content["average_dwell"] < 10.0
    # SUMO drew the vehicles: they are nobody's, and the guarantee stands.
    assert "measured" not in content
    own = str(path.parent / "my-road-fit" / "my-road.json")
    with pytest.warns(UserWarning, match="^estimator_settings:"):
        env = gym.make(ID, corridor=str(path), parameters=own).unwrapped
    assert env.guarantee().startswith("2.119-Gaussian")
    assert (env.config.parameters.name, env.config.bandwidth) == ("my-road", 1)
    # Its settings are those of the set that it comes from, and that is said.
    assert env.config.settings_name == f"{found['estimator']}-w99-3lane-paced"
    assert list(env.config.inherited) == ["estimator_settings"]


def test_the_page_shows_what_was_compared_budgets_figures_and_commands(fitted):
    path, found = fitted
    folder = path.parent / "my-road-fit"
    page = (folder / "fit.md").read_text(encoding="utf-8")
    assert all((folder / name).is_file() for name in re.findall(r"!\[.*\]\((.*)\)", page))
    heading = "PrivateHighway-v1, road my-road, parameters "
    assert all(text in page for text in (heading, "dptse train", f"**{found['policy']}**"))
    assert all(note in page for note in found["notes"])
    unwritten = any("fitted parameters are not written" in note for note in found["notes"])
    assert unwritten == (found["parameters"] != "my-road")
    compared = found["validation"]["estimator"]
    assert {(each["estimator"], each["parameters"]) for each in compared} == {
        *product(("ekf", "random_walk"), ("w99-3lane", "my-road"))
    }
    for name in ("ekf", "random_walk"):
        row = re.search(rf"^\| \**{name}\** \|.*", page, re.MULTILINE)[0]
        assert ("| - |" in row) == (name == found["estimator"])
    assert len(found["budgets"]) == 4 * 4
    keys = "parameters", "estimator", "policy"
    (own,) = (each for each in found["test"] if all(each[k] == found[k] for k in keys))
    assert len(own["error"]) == 2
    rows = re.findall(r"^\| (no queries|\d) \| (.*) \|$", page, re.MULTILINE)
    assert [name for name, _ in rows] == ["no queries", "1", "2", "4"]
    at_own = rows[1][1].split(" | ")[2]  # of epsilons 0.5, 1, 5 and no noise
    assert at_own.strip("*").startswith(f"{np.mean(own['error']):.1f} ± ")


def test_the_page_says_where_an_estimator_is_too_sure():
    row = {"estimator": "ekf", "traffic_seed": 0, "version": code_version()}
    rows = pl.DataFrame([{**row, "chi2_density": 2.01, "chi2_speed": 2.0}])
    said = honesty(rows, {"estimator": "ekf"})
    assert said == ["2.01, too sure", "2.00"]


ERRORS = {
    (0, 1.0): [80, 82, 84, 86], (0, 5.0): [80, 82, 84, 86],
    (1, 1.0): [79, 83, 84, 86], (1, 5.0): [60, 61, 62, 63],
    (2, 1.0): [90, 91, 92, 93], (2, 5.0): [50, 51, 52, 53], (4, 5.0): [49, 51, 52, 53],
}  # fmt: skip


def test_advice_says_where_queries_stop_paying_and_what_noise_costs():
    errors = {key: np.array(values, float) for key, values in ERRORS.items()}
    said = advice(errors, 5.0)
    assert "ε = 5 the error is least at bandwidth 4; more than 2 is no" in said
    assert "At ε = 1 queries do not pay" in said
    exact = {**errors, (2, NO_NOISE): np.full(4, 41.0)}
    assert "+102 % at ε = 1, +25 % at ε = 5" in advice(exact, 5.0)
    assert "| no queries | **83.0 ± 4.1** | 83.0 ± 4.1 | - |" in budget_table(exact)
    assert "| 2 | 91.5 ± 2.1, worse than no queries | 51.5 ± 2.1 |" in budget_table(errors)
    assert budget_table(errors).endswith("| 4 | - | **51.2 ± 2.7** |")
    paid = {key: each for key, each in errors.items() if key[1] == 5.0}
    assert "At each of these ε queries pay" in advice(paid, 5.0)
    queried = {key: each for key, each in errors.items() if key[0]}
    assert "No episode without queries can be played" in advice(queried, 5.0)
    same = {(b, e): errors[b, 5.0] for b, _ in errors for e in (1.0, 5.0)}
    assert "Errors do not depend on ε" in advice(same, 1.0)


def test_the_same_command_plays_nothing_again_and_changes_no_file_of_yours(fitted, tmp_path):
    original, found = fitted
    path = shutil.copytree(original.parent, tmp_path / "copy") / original.name
    before = files_of(path.parent)
    done = run_command("fit", path, *BRIEF, "--json")
    assert json.loads(done.stdout)["test"] == found["test"]
    after = files_of(path.parent)
    changed = {each.name for each in after if after[each] != before.get(each)}
    assert changed <= {"fit.md", "speed-density.png", "episode.png", "rows.parquet"}
    line = refused("fit", path, *BRIEF, "--train-seeds", "0:1")
    assert "seeds.training is [0, 1] there and [0] now" in line


def bowl(parameters, v_f=95.0, gamma=0.8):
    """An error that is least at some parameters."""
    found = parameters.free_flow_speed / v_f, parameters.gamma / gamma
    return 50.0 + 100.0 * float(np.sum(np.log(found) ** 2))


@pytest.mark.parametrize(("v_f", "found", "bounds"), [(95.0, 95.0, 0), (10.0, 36.0, 1)])
def test_the_search_finds_the_least_error_says_where_it_ended_at_a_bound_and_tries_nothing_twice(
    v_f, found, bounds, tmp_path, monkeypatch
):
    tried, path = [], tmp_path / "my-road.toml"
    path.write_text(ROAD)
    corridor = read_road(path).corridor

    def error(cell, parameters, library):
        tried.append(str(parameters))
        if len(tried) == 8:
            raise KeyboardInterrupt
        return bowl(parameters, v_f)

    start = start_from(load_parameters("w99-3lane"), corridor, "mine")
    assert (start.lanes, start.derived_from) == (2, "w99-3lane")
    monkeypatch.setattr(searching, "filter_error", error)
    kept = tmp_path / "kept.json"
    arguments = Cell(ID), corridor, start, 100.0, RecordLibrary(tmp_path), 100, kept
    with pytest.raises(KeyboardInterrupt):
        fit_parameters(*arguments)
    fit = fit_parameters(*arguments)
    assert len({*tried}) == len(tried) - 1  # the one that was interrupted
    assert fit.parameters.free_flow_speed == pytest.approx(found, rel=0.05)
    assert fit.parameters.gamma == pytest.approx(0.8, rel=0.05)
    assert fit.error < fit.start
    assert sum("free_flow_speed" in each for each in fit.at_bounds) == bounds
    kept.unlink()
    assert fit_parameters(*arguments) == fit


def test_a_start_is_slowed_down_until_the_time_step_suits_short_segments(tmp_path):
    path = tmp_path / "my-road.toml"
    path.write_text(ROAD.replace("segment_length = 0.1", "segment_length = 0.04"))
    corridor = road_in(tmp_path).corridor
    start = start_from(load_parameters("w99-3lane"), corridor, "mine")
    assert not searching.is_stable(load_parameters("w99-3lane"), corridor)
    assert searching.is_stable(start, corridor)
    assert start.free_flow_speed > 100.0


def road_in(folder, env=ID):
    """Return the road of a folder with the traffic that it is fitted to."""
    seeds = dict(zip(KINDS, ("0", "1000", "2000"), strict=True))
    return find_road(folder / "my-road.toml", env, folder, seeds)


@pytest.fixture
def choice(tmp_path, monkeypatch):
    """A choice that plays nothing; `errors_of` gives it errors by labels."""
    (tmp_path / "my-road.toml").write_text(ROAD)
    monkeypatch.setattr(Choice, "play", lambda self, wanted: wanted)
    place, known = Place(tmp_path, this_process), {"w99-3lane": {}}
    return Choice(road_in(tmp_path), place, known, parameters="w99-3lane")


def errors_of(monkeypatch, found):
    monkeypatch.setattr(Choice, "errors", lambda self, labels: np.array(found(labels), float))


@pytest.mark.parametrize(
    ("means", "chosen"),
    [
        # Under round robin the EKF errs least, under the policy that it likes another one.
        ({"ekf": (50, 40, 60), "ukf": (60, 30, 60)}, ("ukf", "speed-front")),
        # And that one likes a third policy.
        ({"ekf": (50, 40, 60), "ukf": (60, 30, 20)}, ("ukf", "static")),
        # Each policy has an estimator that likes another policy: in the end the estimator decides.
        ({"ekf": (50, 40, 60), "ukf": (10, 30, 60)}, ("ukf", "round-robin")),
        ({"ekf": (50, 50, 50), "ukf": (50, 50, 50)}, ("ekf", "round-robin")),
    ],
)
def test_no_estimator_loses_under_the_policy_that_is_proposed(means, chosen, choice, monkeypatch):
    policies = "round-robin", "speed-front", "static"

    def found(labels):
        mean = means[labels["estimator"]][policies.index(labels["policy"])]
        return [mean - 1.0, mean, mean, mean + 1.0]

    errors_of(monkeypatch, found)
    choice.settle([{"estimator": each} for each in means], [{"policy": each} for each in policies])
    assert (choice.estimator, choice.policy) == chosen
    assert {each["estimator"] for each in choice.compared["policy"]} == {choice.estimator}


@pytest.mark.parametrize(
    ("errors", "chosen"),
    [
        ({"ekf": [50, 60, 70, 80], "ukf": [40, 50, 60, 71]}, "ukf"),
        ({"ekf": [50, 60, 70, 80], "ukf": [20, 63, 73, 83]}, "ekf"),
        # The least mean beats nobody; another one beats what there was.
        ({"ekf": [50, 60, 70, 80], "blend": [49, 59, 69, 79], "ukf": [20, 63, 73, 83]}, "blend"),
        ({"ekf": [50], "ukf": [49]}, "ukf"),
    ],
)
def test_a_choice_changes_where_another_one_is_certainly_better(
    errors, chosen, choice, monkeypatch
):
    errors_of(monkeypatch, lambda labels: errors[labels["estimator"]])
    choice.choose("estimator", [{"estimator": name} for name in errors])
    assert (choice.estimator, choice.policy) == (chosen, "round-robin")


def test_what_the_environment_refuses_for_one_reason_is_noted_once(tmp_path):
    (tmp_path / "my-road.toml").write_text(ROAD)
    road = road_in(tmp_path)
    road.write_played(tmp_path, 5.0)
    choice = Choice(road, Place(tmp_path, this_process), {}, parameters="w99-3lane")
    policies = "static", "round-robin"
    assert choice.play([choice.labels("test", bandwidth=9, policy=p) for p in policies]) == []
    (note,) = choice.notes
    assert note.startswith("refused is parameters w99-3lane")


@pytest.mark.parametrize("kept", [False, True])
def test_what_the_file_has_is_compared_and_stays_unless_it_is_beaten(
    kept, choice, tmp_path, monkeypatch
):
    path = tmp_path / "my-road.toml"
    write_corridor(path, read_road(path).corridor, {"estimator": "asm", "estimator_settings": {}})
    choice.road, choice.sets["my-road"] = road_in(tmp_path), {}
    choice.parameters = ""
    options = estimators_tried(choice, Args(estimators=("ekf", "asm"), keep_fitted=kept), "my-road")
    names = ["my-road"] if kept else ["w99-3lane", "my-road"]
    present = [] if kept else [("present", "asm")]
    own = [(name, estimator) for estimator in ("ekf", "asm") for name in names]
    assert [(each["parameters"], each["estimator"]) for each in options] == [*present, *own]
    errors = {"present": [50.0, 60, 70, 80], "w99-3lane": [51.0, 61, 71, 81], "my-road": [60.0] * 4}
    errors_of(monkeypatch, lambda labels: errors[labels["parameters"]])
    choice.choose("estimator", options)
    assert (choice.parameters, choice.estimator) == (("my-road", "ekf") if kept else present[0])


@pytest.mark.parametrize(
    ("table", "kept"),
    [
        ({"parameters": "published"}, False),
        ({"parameters": "fit/my-road.json"}, False),
        ({"parameters": "mine/my-road.json"}, True),
        ({"parameters": "fit/my-road.json", "estimator_settings": "fit/tuned.json"}, True),
    ],
)
def test_a_choice_of_yours_is_among_what_is_compared(table, kept, tmp_path):
    path = tmp_path / "my-road.toml"
    path.write_text(ROAD)
    write_corridor(path, read_road(path).corridor, table)
    for name in ("fit/my-road.json", "mine/my-road.json"):
        (tmp_path / name).parent.mkdir()
        arz = dataclasses.replace(load_parameters("published"), name="my-road")
        write_parameters(tmp_path / name, arz, {})
    settings = {"estimator": "ekf", "settings": {}, "provenance": {}}
    (tmp_path / "fit" / "tuned.json").write_text(json.dumps({"a": settings}))
    road = find_road(path, ID, tmp_path / "fit", dict.fromkeys(KINDS))
    assert set(road.present) == (set(table) if kept else set())
    assert len(road.all_seeds) == 40


@pytest.mark.parametrize(
    "text",
    [
        '# a\r\nn_mainline = 4  # b\r\n[environment]  # c\r\nparameters = "x.json"  # d\r\n',
        'n_mainline = 4\n[environment.privacy]\npreset = "capped"\n[demand]\nmainline = []\n',
        "n_mainline = 4\nenvironment = { bandwidth = 3, estimator_settings = 'x.json' }\n",
        "[demand]\nmainline = [[0, 1]]",
    ],
)
def test_a_choice_is_written_whatever_the_file_looks_like(text, tmp_path):
    path = tmp_path / "road.toml"
    path.write_bytes(text.encode())
    fusion = {"speed_spread": 9.0, "dwell_factor": 0.0}
    chosen = {"fusion": fusion, "parameters": "fit/a.json", "estimator": "ekf"}
    link = tmp_path / "link.toml"
    link.symlink_to(path)
    assert write_choice(link, chosen, 9.8, of_records=True)
    assert copy_of(link) == tmp_path / "road.before-fit.toml"
    assert copy_of(path).read_bytes() == text.encode()
    new, old = tomllib.loads(path.read_bytes().decode()), tomllib.loads(text)
    assert new.pop("average_dwell") == 9.8
    assert new.pop("measured") == ["average_dwell", *chosen]
    table = old.pop("environment", {})
    table.pop("estimator_settings", None)
    assert new.pop("environment") == {**table, **chosen}
    assert new == old
    assert not write_choice(path, chosen, None, of_records=False)
    assert copy_of(path).read_bytes() == text.encode()
    ukf = {"estimator": "ukf", "estimator_settings": "x.json"}
    assert write_choice(path, ukf, None, of_records=True)
    measured = tomllib.loads(path.read_bytes().decode())["measured"]
    assert measured == ["average_dwell", *chosen, "estimator_settings"]


NO_DEMAND = ROAD.replace("2400", "0")
SHORT = ROAD.replace("segment_length = 0.1", "segment_length = [0.1, 0.1, 0.04, 0.1]").replace(
    "speed_limit = 90", "speed_limit = 140"
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (NO_DEMAND, "my-road.toml: demand.mainline must be above 0 veh/h"),
        (SHORT, "my-road.toml: segment 2 of 0.04 km must be longer than 0.044 km"),
        (ROAD.replace("90\n", "60\n", 2), "my-road.toml: duration must be more than the 60 s"),
    ],
)
def test_a_road_that_cannot_be_fitted_is_told_and_leaves_nothing(text, message, tmp_path):
    path = tmp_path / "my-road.toml"
    path.write_text(text)
    assert message in refused("fit", path)
    assert list(tmp_path.iterdir()) == [path]


def import_field(folder, windows):
    """Import a measured field of some windows of 100 s; return its road file."""
    rng = np.random.default_rng(0)
    density = 40.0 + 30.0 * rng.random((6, 20 * windows))
    np.savetxt(folder / "density.txt", density)
    np.savetxt(folder / "speed.txt", 100.0 - density)
    done = run_command(
        "import", "field", "--density", folder / "density.txt", "--speed", folder / "speed.txt",
        "--cell", "0.1", "--interval", "5", "--segments", "4", "--lanes", "2",
        "--speed-limit", "90", "--duration", "90", "--output", folder / "ring",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder / "ring" / "road.toml"


def test_a_measured_field_with_one_test_window_is_fitted(tmp_path):
    path = import_field(tmp_path, 3)
    words = ["--trials", "2", "--estimators", "ekf", "--policies", "round-robin", "--workers", "1"]
    done = run_command("fit", path, *words)
    assert done.returncode == 0, done.stderr
    assert "release model 'corrected', since a measured field has no vehicles" in done.stdout
    assert tomllib.loads(path.read_text())["environment"]["privacy"] == "corrected"
    page = (path.parent / "road-fit" / "fit.md").read_text(encoding="utf-8")
    assert "There is one test window: its errors have no interval" in page
    with pytest.warns(UserWarning, match="^estimator_settings: "):
        env = gym.make(ID, corridor=str(path))
    assert env.unwrapped.config.inherited == ("estimator_settings",)


def test_recordings_of_one_window_say_what_is_missing(tmp_path):
    path = import_field(tmp_path, 1)
    before = files_of(path.parent)
    line = refused("fit", path)
    assert f"{path}: recordings must have a window of validation traffic" in line
    assert "shorter duration" in line
    assert files_of(path.parent) == before


LORRIES = """n_mainline = 20
lanes = 2
segment_length = 0.15
speed_limit = 120
duration = 240

[demand]
mainline = [[0, 1800]]

[[vehicle_classes]]
name = "car"
share = 0.75

[[vehicle_classes]]
name = "lorry"
share = 0.25
length = 12.0
largest_speed = 85.0
"""


@pytest.mark.slow
def test_no_estimator_is_proposed_that_loses_to_another_one_where_lorries_share_a_road(tmp_path):
    path = tmp_path / "lorries.toml"
    path.write_text(LORRIES)
    words = (
        "--trials", "12", "--train-seeds", "0:3", "--validation-seeds", "1000:1008",
        "--test-seeds", "2000:2002", "--policies", "round-robin", "expected-reduction",
    )  # fmt: skip
    done = run_command("fit", path, *words, "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    compared = found["validation"]["estimator"]
    assert {each["estimator"] for each in compared} == set(ESTIMATORS_TRIED)
    assert {each["policy"] for each in compared} == {found["policy"]}
    keys = "parameters", "estimator"
    (own,) = (each for each in compared if all(each[key] == found[key] for key in keys))
    for each in compared:
        gain = np.subtract(own["error"], each["error"])
        spread = stats.sem(gain)
        assert each is own or gain.mean() <= stats.t.ppf(0.975, len(gain) - 1) * spread, each
    least = {
        name: min(np.mean(each["error"]) for each in compared if each["estimator"] == name)
        for name in ESTIMATORS_TRIED
    }
    assert least["recurrent"] < 1.1 * least[found["estimator"]], (found["estimator"], least)
