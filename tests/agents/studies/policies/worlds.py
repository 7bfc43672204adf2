"""Designs on the short road, and scores that are made up."""

import numpy as np

from agents.evaluation.episodes import EpisodeScore
from agents.studies.policies.curves import Curve
from agents.studies.policies.manifest import (
    CellChoice,
    Checkpoint,
    Manifest,
    Tuned,
    find_checkpoints,
)
from agents.studies.policies.plan import (
    PolicyCell,
    PolicyDesign,
)
from agents.studies.policies.queries import QueryCounts
from agents.studies.policies.results import PolicyResults
from tests.agents.policies import SHORT

WALK = {"estimator": "random_walk", "bandwidth": 2}
SMALL = PolicyDesign(
    cells=(
        PolicyCell("primary", "a short road", SHORT, WALK, bounds=("oracle-error",)),
        PolicyCell("other", "three a second", SHORT, {**WALK, "bandwidth": 3}, bounds=()),
        PolicyCell("moved", "no incident", SHORT, {**WALK, "incident": "none"}, ("primary",), ()),
    ),
    baselines=("paper", "oldest-first", "optimised-plan"),
    validation_seeds=(1000, 1001),
    test_seeds=(2000, 2001),
)


def checkpoints(runs):
    return find_checkpoints((f"primary={runs}/primary", f"other={runs}/other"), SMALL)


def score(seed, error, **fields):
    numbers = {"rmse_density": 100 * error, "rmse_speed": 50 * error, "reward": -error}
    kept = {"n_dropped": 0.0, "n_diverged": 0.0, "n_fallback": 0.0}
    return EpisodeScore(traffic_seed=seed, **{**numbers, **kept, **fields})


def queries(seed):
    return QueryCounts(seed, 3, 60.0, "60 100 80", "1 2 3 4 5 6", "6 5 4 3 2 1", "0 0 9 9 0 0",
                 " ".join(["7"] * 12))  # fmt: skip


def made_up(runs_below=(10.0,) * 5, n_seeds=64, *, spread=0.0, elsewhere=12.0, counts_queries=True):
    """Scores in which learned policies lie so many percent below the best baseline."""
    design = PolicyDesign(
        cells=(
            PolicyCell("primary", "made up", SHORT, WALK, bounds=("oracle-error",)),
            PolicyCell("other", "made up too", SHORT, WALK, (), ()),
            PolicyCell("moved", "and moved", SHORT, WALK, ("primary",), ()),
        ),
        baselines=("paper", "oldest-first"),
        test_seeds=tuple(range(2000, 2000 + n_seeds)),
    )
    ladder = dict.fromkeys(("primary", "other", "moved"), ("paper", "oldest-first"))
    chosen = ("plackett-luce", "deterministic")
    files = [
        Checkpoint(cell, "plackett-luce", seed, "slots", f"{cell}-{seed}.zip", "0" * 64)
        for cell in ("primary", "other")
        for seed in range(len(runs_below))
    ]
    errors = {"paper": 0.12, "oldest-first": 0.1}
    manifest = Manifest(
        design.to_json(), "python scripts/study.py policies freeze", tuple(files),
        (Tuned("paper", "ekf", "paper", "paper", {}),), ladder,
        {"primary": ("oracle-error",), "other": (), "moved": ()},
        {"primary": {"optimised-plan": "no plan"}},
        {
            "primary": CellChoice("oldest-first", {"primary": chosen}, errors),
            "other": CellChoice("oldest-first", {"other": chosen}, errors),
            "moved": CellChoice("oldest-first", {}, errors),
        },
        "2026-01-01T00:00:00+00:00",
    )  # fmt: skip
    generator = np.random.default_rng(0)
    traffic = 0.1 * np.exp(0.3 * generator.standard_normal(n_seeds))
    scores = {}
    for entry in manifest.entries(design):
        below = {"paper": -20.0, "oldest-first": 0.0, "oracle-error": 20.0}.get(entry.policy)
        if entry.kind == "learned":
            below = runs_below[entry.training_seed] if entry.cell == "primary" else elsewhere
            below -= 3.0 * (entry.mode == "stochastic")
        noise = 1.0 + spread * generator.standard_normal(n_seeds) * (entry.kind == "learned")
        for seed, error in zip(design.test_seeds, traffic * (1 - below / 100) * noise, strict=True):
            scores[entry, seed] = score(seed, error)
    counted = {
        key: queries(key[1])
        for key in scores
        if counts_queries and key[0].cell == "primary" and key[0].mode == "deterministic"
    }
    curves = [Curve("plackett-luce", seed, (0, 10), (120.0, 90.0 + seed)) for seed in range(2)]
    return PolicyResults(design, manifest, scores, counted, curves, n_resamples=400)
