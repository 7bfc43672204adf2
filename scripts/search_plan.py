"""Search an open-loop query plan on training traffic: a static set, or a period of sets.

python scripts/search_plan.py --kind offline --period 12 --rounds 200

The plan is left in <output>/<name>.json after every round. After an interruption, or a kill, the
same command goes on where it stopped, and with more --rounds it searches on. The file is used
like any other schedule by its path. To ship it, copy it to dptse_env/schedules/plans/.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from agents.experiments.files import replacing
from agents.search.plans import PlanSearch, PlanTask, validation_scores
from dptse_env.schedules.plans import Plan, read_plan, write_plan
from dptse_env.traffic import RecordLibrary
from dptse_env.validation import integer
from scripts.cli import records_argument, resumable, run


@dataclass(frozen=True)
class Args:
    """Search an open-loop query plan."""

    env: str = "dptse_env:dptse/PrivateHighway-v0"
    """Environment id."""
    kind: str = "offline"
    """Kind of plan: 'offline', a period of sets, or 'best-static', one set."""
    period: int = 12
    """Sets in the period; a static set has one."""
    estimator: str = "ekf"
    """State estimator."""
    parameters: str | None = None
    """Name of the ARZ parameters; the environment's own if not given."""
    bandwidth: int | None = None
    """Segments to query a second; the environment's own if not given."""
    seeds: str = "0:64"
    """Traffic seeds, first:stop; training seeds only."""
    rounds: int = 100
    """Rounds of exchanges, those of earlier runs included."""
    neighbours: int = 31
    """Neighbours that a round tries; four times as many episodes run at once."""
    search_seed: int = 0
    """Seeds the search."""
    records: Path | None = None
    """Folder of the record cache; the user's cache if not given."""
    output: Path = Path("results/schedules")
    """Folder for the plan."""


def make_task(args: Args) -> PlanTask:
    """Return the task, checked.

    Raises:
        ValueError: An argument is out of range.
    """
    integer("rounds", args.rounds, 1)
    return PlanTask(
        env=args.env,
        kind=args.kind,
        period=1 if args.kind == "best-static" else args.period,
        estimator=args.estimator,
        parameters=args.parameters,
        bandwidth=args.bandwidth,
        seeds=args.seeds,
        neighbours=args.neighbours,
        seed=args.search_seed,
        records=records_argument(args.records),
    )


def resumed(search: PlanSearch, path: Path) -> bool:
    """Resume the search of the plan in a file; return whether there is one.

    Raises:
        ValueError: The file is of another search.
    """
    if not path.exists():
        return False
    found = read_plan(path)
    task = found.provenance.get("task", {})
    differences = [
        f"{key} is {task.get(key)!r} there and {value!r} now"
        for key, value in search.plan().provenance["task"].items()
        if task.get(key) != value
    ]
    if differences:
        raise ValueError(
            f"{path} is of another search: {'; '.join(differences)}. Choose another --output"
        )
    search.resume(found)
    return True


def save(path: Path, plan: Plan) -> None:
    """Write a plan in one piece."""
    with replacing(path) as temporary:
        write_plan(temporary, plan)


@resumable()
def main(args: Args) -> None:
    """Record what is missing, search, and leave the plan."""
    task = make_task(args)
    search = PlanSearch(task)
    path = args.output / f"{search.plan().name}.json"
    corridor = task.make(1, task.traffic_seeds).config.corridor
    RecordLibrary(args.records).ensure(corridor, task.traffic_seeds, progress=True)
    args.output.mkdir(parents=True, exist_ok=True)
    if not resumed(search, path):
        search.begin()
        save(path, search.plan())
    done = search.n_rounds
    with tqdm(total=max(args.rounds, done), initial=done, desc=path.stem, unit="round") as bar:

        def on_round() -> None:
            save(path, search.plan())
            bar.set_postfix_str(f"{search.n_adopted} adopted", refresh=False)
            bar.update()

        search.go_on(args.rounds, on_round)
    plan = search.plan()
    scores = validation_scores(task, plan)
    save(path, dataclasses.replace(plan, provenance={**plan.provenance, "validation": scores}))
    print(f"mean reward on validation traffic: {scores}\nthe plan is in {path}")


if __name__ == "__main__":
    run(main, Args, __doc__)
