import dataclasses
import json

import numpy as np
import pytest

from agents.environments import make_config
from agents.evaluation.episodes import run_episodes
from agents.experiments.runner import Workplace, make_batch
from agents.policies import find_policy
from agents.seeds import SUITE
from agents.suite.card import DONE, FAILED, Card
from agents.suite.cells import SUITES, find_suite
from agents.suite.suite import card_name, run_suite
from agents.suite.table import cell_table, score_table
from agents.suite.verifying import verify
from dptse_env.config import TEST_SEEDS
from dptse_env.schedules import make_schedule
from tests.agents.noting import Noting
from tests.agents.policies import save

from .small import SHORT, SMALL

RULES = ("paper", "round-robin", "oracle-error", "tests.agents.suite.small:Raising")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("suite") / "cards"
    run_suite(SMALL, RULES, Workplace(folder, Noting()), progress=False)
    return folder


@pytest.fixture
def cards(folder):
    found = [Card.read(path) for path in folder.iterdir()]
    return {card.name: card for card in found}


def test_each_policy_has_a_card(cards):
    assert set(cards) == {card_name(rule) for rule in RULES}
    for card in cards.values():
        card.check(SMALL, card.name)
        assert list(card.results) == ["plain", "wide", "paced"]
    failing = cards["tests.agents.suite.small-Raising"]
    assert [each.status for each in failing.results.values()] == [DONE, FAILED, DONE]
    paced, plain = cards["paper"].results["paced"], cards["paper"].results["plain"]
    assert (paced.is_guaranteed, plain.is_guaranteed) == (True, False)
    assert plain.percent_refused is None
    assert 0.0 <= paced.percent_refused < 100.0
    assert (plain.queries_a_second, paced.queries_a_second) == (2.0, 2.0)


def test_errors_are_those_of_the_environment(cards):
    cell = SMALL.cells[0]
    seeds = cell.traffic_seeds
    env = make_batch(cell.env, cell.keywords, seeds)
    scores = run_episodes(
        env, make_schedule("round-robin", env), traffic_seeds=seeds,
        seeds=[SUITE.start + seed for seed in seeds],
    )  # fmt: skip
    result = cards["round-robin"].results["plain"]
    assert result.error == tuple(-1000.0 * score.reward for score in scores)
    assert result.density == tuple(score.rmse_density for score in scores)
    assert result.speed == tuple(score.rmse_speed for score in scores)


def test_what_is_done_is_not_run_again_and_what_failed_is(folder, cards):
    engine = Noting()
    run_suite(SMALL, RULES, Workplace(folder, engine), progress=False)
    assert [task.cell.name for task in engine.tasks] == ["wide"]
    kept = cards["paper"]
    del kept.results["paced"]
    kept.write(folder / "paper.json")
    engine = Noting()
    (card,) = run_suite(SMALL, ["paper"], Workplace(folder, engine), progress=False)
    assert [task.cell.name for task in engine.tasks] == ["paced"]
    assert list(card.results) == ["plain", "wide", "paced"]


def test_an_interrupt_keeps_the_cells_that_are_done(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run_suite(SMALL, ["paper"], Workplace(tmp_path, Noting(interrupt_after=2)), progress=False)
    assert len(Card.read(tmp_path / "paper.json").results) == 2


def test_cards_of_other_policies_are_not_mixed(tmp_path):
    place = Workplace(tmp_path, Noting())
    path = save(tmp_path / "runs" / "best.zip", seed=0)
    with pytest.raises(ValueError, match="different names, 'runs-best' is there twice"):
        run_suite(SMALL, [str(path), str(path)], place, progress=False)
    run_suite(SMALL, [str(path)], place, progress=False)
    assert Card.read(tmp_path / "runs-best.json").results["wide"].status == DONE
    save(path, seed=1)
    with pytest.raises(ValueError, match=r"runs-best\.json is the card of another policy"):
        run_suite(SMALL, [str(path)], place, progress=False)


def test_cells_of_other_versions_are_not_mixed(tmp_path):
    place = Workplace(tmp_path, Noting(interrupt_after=1))
    with pytest.raises(KeyboardInterrupt):
        run_suite(SMALL, ["paper"], place, progress=False)
    path = tmp_path / "paper.json"
    card = Card.read(path)
    dataclasses.replace(card, made_with={**card.made_with, "numpy": "1.0"}).write(path)
    with pytest.raises(ValueError, match=r"paper\.json was begun with other versions \(numpy\)"):
        run_suite(SMALL, ["paper"], Workplace(tmp_path, Noting()), progress=False)


def test_a_policy_that_is_not_there_ends_before_anything_runs(tmp_path):
    place = Workplace(tmp_path / "out", Noting())
    with pytest.raises(FileNotFoundError, match=r"none\.zip"):
        run_suite(SMALL, ["paper", "none.zip"], place, progress=False)
    assert not (tmp_path / "out").exists()


def test_tables_hold_scores_and_failures(cards):
    table = score_table(list(cards.values()), cards["paper"], cards["oracle-error"], SMALL)
    lines = {line.split("|")[1].strip(" `"): line.split("|")[2:-1] for line in table.splitlines()}
    assert [float(cell.split("±")[0]) for cell in lines["paper"]] == [0.0] * 4
    assert [float(cell.split("±")[0]) for cell in lines["oracle-error"]] == [1.0] * 4
    assert [cell.strip() for cell in lines["tests.agents.suite.small-Raising"]][::2] == [
        "-", "failed",
    ]  # fmt: skip
    errors = cell_table(list(cards.values()), "wide")
    assert errors.splitlines()[2].startswith("| `oracle-error`")
    assert "raised KeyError: 'no third segment'" in errors


def test_a_card_that_was_made_up_is_found_by_a_run(cards):
    card = cards["round-robin"]
    for draw in range(6):
        found = verify(card, SMALL, find_policy("round-robin"), None, draw)
        assert found.is_same
        assert found.largest < 1e-9
    flattered = {
        name: dataclasses.replace(each, error=tuple(0.9 * value for value in each.error))
        for name, each in card.results.items()
    }
    found = verify(
        dataclasses.replace(card, results=flattered), SMALL, find_policy("round-robin"), None
    )
    assert not found.is_same
    assert found.means[0] == pytest.approx(0.9 * found.means[1])
    one = {**card.results, "wide": dataclasses.replace(card.results["wide"], speed=(1.0, 2.0, 3.0))}
    forged = dataclasses.replace(card, results=one)
    draws = [verify(forged, SMALL, find_policy("round-robin"), None, draw) for draw in range(8)]
    assert {each.cell for each in draws if not each.is_same} == {"wide"}


def test_a_card_is_verified_with_its_own_policy(cards):
    with pytest.raises(ValueError, match="'paper' is not the policy of the card, 'round-robin'"):
        verify(cards["round-robin"], SMALL, find_policy("paper"), None)
    empty = dataclasses.replace(cards["paper"], results={})
    with pytest.raises(ValueError, match="the card of 'paper' has no cell that is done"):
        verify(empty, SMALL, find_policy("paper"), None)


@pytest.mark.parametrize("name", sorted(SUITES))
def test_suites_are_of_test_traffic_that_no_study_uses(name):
    suite = find_suite(name)
    assert 0 < len(suite.cells) <= 13
    assert len({cell.name for cell in suite.cells}) == len(suite.cells)
    for cell in suite.cells:
        assert set(cell.traffic_seeds) <= set(TEST_SEEDS[200:])
        assert set(cell.noise_seeds) <= set(SUITE)
        assert cell.config.bandwidth < cell.config.corridor.n_mainline
    with pytest.raises(ValueError, match=r"suite must be one of .*-v1, query-suite-v2, got 'v9'"):
        find_suite("v9")


def test_a_model_of_stable_baselines3_has_a_card(tmp_path):
    sb3 = pytest.importorskip("stable_baselines3")
    import gymnasium as gym

    env = gym.make(SHORT, **SMALL.cells[0].keywords)
    sb3.PPO("MlpPolicy", env, n_steps=8, batch_size=8, seed=0, device="cpu").save(
        tmp_path / "ppo.zip"
    )
    source = f"stable_baselines3:PPO={tmp_path}/ppo.zip"
    (card,) = run_suite(SMALL, [source], Workplace(tmp_path / "out", Noting()), progress=False)
    assert card.name == f"{tmp_path.name}-ppo"
    assert card.results["plain"].status == DONE
    # A release of flows has other blocks in the observation.
    assert card.results["paced"].reason.startswith("raised ValueError: ")
    assert "has the observation_space" in card.results["paced"].reason
    content = json.loads((tmp_path / "out" / f"{card.name}.json").read_text())
    assert len(content["identity"]) == 64
    assert np.isfinite(content["results"]["plain"]["error"]).all()
    config = make_config(SHORT, SMALL.cells[0].keywords)
    assert config.bandwidth == 2
