import dataclasses

import pytest

from agents.evaluation.episodes import EpisodeScore
from agents.experiments.ledger import Ledger
from agents.seeds import STUDY_TEST
from agents.studies.policies.freezing import choose, draft, write_draft
from agents.studies.policies.manifest import (
    CellChoice,
    Manifest,
    find_checkpoints,
    read_tuned,
)
from agents.studies.policies.plan import (
    Entry,
)
from agents.studies.policies.running import make_task
from dptse_env.estimators.tuned_settings import write_settings
from tests.agents.policies import save
from tests.agents.studies.policies.worlds import SMALL, checkpoints, score


def test_policies_are_found_and_their_digests_kept(runs):
    found = checkpoints(runs)
    assert [(each.cell, each.recipe, each.training_seed) for each in found] == [
        ("primary", "plackett-luce", 0),
        ("primary", "plackett-luce", 1),
        ("other", "plackett-luce", 0),
    ]
    assert len({each.sha256 for each in found}) == 3
    single = find_checkpoints((f"primary={runs}/primary/pl-0/best.zip",), SMALL)
    assert single == found[:1]
    given = (f"primary={runs}/primary", f"primary:longer={runs}/primary/pl-0")
    assert [each.recipe for each in find_checkpoints(given, SMALL)] == [
        "plackett-luce", "plackett-luce", "longer",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        (("pl-0",), ValueError, "must be cell=path, got 'pl-0'"),
        (("nowhere={runs}",), ValueError, "cell must be one of primary, other, moved"),
        (("primary={runs}/empty",), FileNotFoundError, "no best.zip in"),
        (("primary={runs}/primary", "primary={runs}/primary/pl-1"), ValueError, "training seed 1"),
    ],
)
def test_policies_that_cannot_be_found_are_named(given, error, message, runs):
    with pytest.raises(error, match=message):
        find_checkpoints([text.format(runs=runs) for text in given], SMALL)


def test_a_policy_that_was_changed_after_freezing_is_refused(tmp_path):
    path = save(tmp_path / "best.zip", seed=0)
    (frozen,) = find_checkpoints((f"primary={path}",), SMALL)
    assert frozen.saved().sha256 == frozen.sha256
    save(path, seed=1)
    with pytest.raises(ValueError, match="not the policy that was frozen"):
        frozen.saved()


def test_a_draft_says_who_suits_and_tries_every_policy(runs):
    manifest = draft(SMALL, checkpoints(runs), (), "command")
    assert manifest.ladder["primary"] == ("paper", "oldest-first")
    assert "no plan 'optimised-plan' ships for" in manifest.unsuited["primary"]["optimised-plan"]
    assert manifest.bounds == {"primary": ("oracle-error",), "other": (), "moved": ()}
    other = find_checkpoints((f"primary={runs}/other",), SMALL)
    with pytest.raises(ValueError, match="bandwidth is 3 for the policy and 2"):
        draft(SMALL, other, (), "command")


def test_a_cell_goes_without_what_costs_too_much(runs):
    cell = dataclasses.replace(SMALL.cells[1], without=("oldest-first",))
    design = dataclasses.replace(SMALL, cells=(SMALL.cells[0], cell))
    manifest = draft(design, checkpoints(runs), (), "command")
    assert manifest.ladder == {"primary": ("paper", "oldest-first"), "other": ("paper",)}
    assert manifest.unsuited["other"]["oldest-first"] == "left out for its cost"


def test_policies_move_to_another_bandwidth(runs):
    cell = dataclasses.replace(SMALL.cells[1], transfers=("primary",))
    design = dataclasses.replace(SMALL, cells=(SMALL.cells[0], cell))
    manifest = draft(design, checkpoints(runs), (), "command")
    chosen = CellChoice("paper", {"primary": ("plackett-luce", "deterministic")}, {})
    manifest = dataclasses.replace(manifest, choices={"primary": chosen})
    moved = [each for each in manifest.entries(design) if each.trained_in not in ("", each.cell)]
    assert [(each.cell, each.training_seed) for each in moved] == [("other", 0), ("other", 1)]
    env, policy = make_task(moved[0], design, manifest, seeds=(1000,), noise=0).make()
    observation, _ = env.reset(seed=0)
    assert policy.predict(observation)[0].shape == (1, 3)


def test_entries_are_everyone_in_every_cell(runs):
    manifest = draft(SMALL, checkpoints(runs), (), "command")
    before = manifest.entries(SMALL, bounds=False)
    assert Entry("primary", "learned", "plackett-luce", "primary", 1, "stochastic") in before
    assert not [each for each in before if each.kind == "bound"]
    # Who moves is known once validation has chosen.
    assert not [each for each in before if each.cell == "moved" and each.kind == "learned"]
    choices = {name: CellChoice("paper", {}, {}) for name in ("other", "moved")}
    choices["primary"] = CellChoice("paper", {"primary": ("plackett-luce", "stochastic")}, {})
    entries = dataclasses.replace(manifest, choices=choices).entries(SMALL)
    assert len(entries) == len(set(entries)) == 2 + 1 + 4 + 2 + 2 + 2 + 2
    assert [each for each in entries if each.cell == "moved" and each.kind == "learned"] == [
        Entry("moved", "learned", "plackett-luce", "primary", seed, "stochastic")
        for seed in range(2)
    ]


def test_validation_traffic_chooses(runs, tmp_path):
    manifest = draft(SMALL, checkpoints(runs), (), "command")
    ledger = Ledger(tmp_path / "validation.csv", Entry, EpisodeScore)
    errors = {"paper": 0.3, "oldest-first": 0.2}
    for entry in manifest.entries(SMALL, bounds=False):
        error = errors.get(entry.policy, 0.25)
        # The seeds of one mode differ; the other mode's mean is less.
        if entry.kind == "learned":
            error = (0.1, 0.5)[entry.training_seed] if entry.mode == "deterministic" else 0.28
        ledger.append(entry, [score(seed, error) for seed in SMALL.validation_seeds])
    frozen = choose(SMALL, manifest, ledger)
    assert frozen.frozen
    assert frozen.choices["primary"].baseline == "oldest-first"
    assert frozen.choices["primary"].learners == {"primary": ("plackett-luce", "stochastic")}
    assert frozen.choices["other"].learners == {"other": ("plackett-luce", "deterministic")}
    assert frozen.choices["moved"].learners == {}
    assert frozen.choices["primary"].errors["plackett-luce, deterministic"] == pytest.approx(0.3)
    frozen.write(tmp_path)
    assert Manifest.read(tmp_path).digest == frozen.digest


def test_a_folder_keeps_to_one_manifest(runs, tmp_path):
    manifest = draft(SMALL, checkpoints(runs), (), "command")
    write_draft(tmp_path, manifest)
    assert write_draft(tmp_path, manifest).digest == manifest.digest
    other = draft(SMALL, checkpoints(runs)[:1], (), "command")
    with pytest.raises(ValueError, match="manifest of other policies"):
        write_draft(tmp_path, other)
    (tmp_path / "manifest.json").write_text("{}")
    with pytest.raises(ValueError, match="not as this program writes it"):
        Manifest.read(tmp_path)


def test_tuned_settings_reach_their_policy_alone(runs, tmp_path):
    path = tmp_path / "tuned.json"
    write_settings(
        path, estimator="random_walk", parameters="paper", privacy="paper",
        settings={"walk_noise": [0.5, 0.5]}, provenance={},
    )  # fmt: skip
    tuned = read_tuned((f"plackett-luce={path}",))
    manifest = draft(SMALL, checkpoints(runs), tuned, "command")
    entries = {each.policy: each for each in manifest.entries(SMALL, bounds=False)}
    tasks = {
        name: make_task(entry, SMALL, manifest, seeds=(2000, 2001), noise=STUDY_TEST.start)
        for name, entry in entries.items()
    }
    assert tasks["plackett-luce"].make()[0].config.settings().walk_noise == (0.5, 0.5)
    assert tasks["paper"].make()[0].config.settings().walk_noise != (0.5, 0.5)
    with pytest.raises(ValueError, match="'nobody', which is not run"):
        draft(SMALL, (), read_tuned((f"nobody={path}",)), "command")
    astray = dataclasses.replace(tuned[0], estimator="ekf")
    with pytest.raises(ValueError, match="no cell is that"):
        draft(SMALL, checkpoints(runs), (astray,), "command")
    with pytest.raises(ValueError, match="given twice"):
        read_tuned((f"paper={path}", f"paper={path}"))
    with pytest.raises(ValueError, match="must be policy=file"):
        read_tuned((str(path),))
