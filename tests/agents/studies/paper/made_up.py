"""Made-up results: errors of each cell and seed as a test wants them."""

import numpy as np

from agents.evaluation.episodes import EpisodeScore
from agents.studies.paper.plan import PaperDesign
from agents.studies.paper.results import PaperResults
from agents.studies.paper.timing import StepTime

DESIGN = PaperDesign(
    seeds="2000:2006",
    cv_segments=(5, 6, 7, 8),
    epsilons=(0.1, 0.5, 2.0),
    deltas=(0.01, 0.1),
    n_timed=3,
)


def score(seed, density=10.0, speed=5.0):
    return EpisodeScore(
        traffic_seed=seed,
        rmse_density=density,
        rmse_speed=speed,
        reward=-0.1,
        n_dropped=0.0,
        n_diverged=0.0,
        n_fallback=0.0,
    )


def make_up(density, speed=None, seconds=None, design=DESIGN):
    """Return results from functions of a cell, each times a factor of the seed, near 1.

    Args:
        density: Density RMSE of a cell.
        speed: Speed RMSE of a cell; half the density's if None.
        seconds: Time of a step by estimator; 1e-3 if None.
        design: The design.
    """
    generator = np.random.default_rng(0)
    speed = speed or (lambda cell: density(cell) / 2.0)
    scores, times = {}, {}
    for cell in design.cells():
        for k, seed in enumerate(design.traffic_seeds):
            # Seeds differ by much, estimators on one seed by little: what pairing is for.
            factor = (1.0 + 0.1 * k) * (1.0 + 1e-4 * generator.standard_normal())
            scores[cell, seed] = score(seed, density(cell) * factor, speed(cell) * factor)
    for k, (cell, seed) in enumerate(design.timed()):
        time = 1e-3 if seconds is None else seconds.get(cell.estimator, 1e-3)
        times[cell, seed] = StepTime(seed, time * (1.0 + 0.001 * (k % 3)))
    return PaperResults(design, scores, times)
