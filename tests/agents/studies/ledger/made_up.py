"""A small design, and made-up results of it: errors and payments as a test wants them."""

from agents.evaluation.contributions import LENGTHS, LedgerScore, TripSums
from agents.studies.ledger.cell import FilterSets
from agents.studies.ledger.plan import LedgerDesign
from agents.studies.ledger.results import LedgerResults

SHORT = "dptse_env:dptse/ShortHighway-v0"
DEFAULTS = FilterSets(*([""] * 9))
"""The settings that the environment takes by default, for every filter."""
DESIGN = LedgerDesign(
    env=SHORT,
    seeds="2000:2003",
    bandwidth=2,
    epsilons=(1.0, 10.0),
    paces=(1.0,),
    clips=(25.0,),
    pace=0.8,
    clip=51.0,
    ratios=(0.5,),
    schedules=("round-robin", "largest-variance"),
    sets=DEFAULTS,
    single_only=True,
)
N_MAINLINE = 6


def score(seed, density, speed=5.0, n_refused=0):
    return LedgerScore(
        traffic_seed=seed,
        rmse_density=density,
        rmse_speed=speed,
        reward=-0.1,
        n_dropped=0.0,
        n_diverged=0.0,
        n_fallback=0.0,
        n_met=1000,
        n_refused=n_refused,
        n_vehicles=200,
        n_exhausted=20,
    )


def trip_sums(seed, refused=10, last=0):
    """Return payments of 200 vehicles, ``last`` of them with the longest trips."""
    n = len(LENGTHS)
    by_length = [200 - last, *([0] * (n - 2)), last]
    return TripSums(
        traffic_seed=seed,
        quantiles="0.1 0.2 0.5 0.7 0.9",
        met=" ".join(["100"] * N_MAINLINE),
        refused=" ".join(["0"] * (N_MAINLINE - 1) + [str(refused)]),
        vehicles=" ".join(map(str, by_length)),
        spent=" ".join(str(0.5 * number) for number in by_length),
        met_of=" ".join(str(5 * number) for number in by_length),
        refused_of=" ".join(str(number // 10) for number in by_length),
    )


def make_up(density, design=DESIGN, n_refused=0, trips=trip_sums):
    """Return results from a function of a cell; seeds differ by much, cells on one by little."""
    seeds = design.traffic_seeds
    scores = {
        (cell, seed): score(seed, density(cell) + 5.0 * k + 0.01 * k**2, n_refused=n_refused)
        for cell in design.cells()
        for k, seed in enumerate(seeds)
    }
    payments = {(each.cell, seed): trips(seed) for each in design.watched for seed in seeds}
    return LedgerResults(design, scores, payments)
