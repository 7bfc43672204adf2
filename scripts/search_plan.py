"""Search an open-loop query plan on training traffic: a static set, or a period of sets.

python scripts/search_plan.py --kind optimised-plan --period 12 --rounds 200

The plan is left in <output>/<name>.json after every round. After an interruption, or a kill, the
same command goes on where it stopped, and with more --rounds it searches on. The file is used
like any other schedule by its path. To ship it, copy it to dptse_env/schedules/plans/.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro
from tqdm import tqdm

from agents.files import replacing
from agents.search.plan_scores import PlanScorer, PlanTask
from agents.search.plans import PlanSearch, validation_scores
from dptse_env.schedules.plans import Plan, read_plan, write_plan
from dptse_env.utils.validation import integer
from scripts.cli import Machines, resumable, run


@dataclass(frozen=True)
class Args(Machines):
    """Search an open-loop query plan."""

    task: tyro.conf.OmitArgPrefixes[PlanTask] = field(default_factory=PlanTask)
    """The search."""
    rounds: int = 100
    """Rounds of exchanges, those of earlier runs included."""
    output: Path = Path("results/schedules")
    """Folder for the plan."""


def resumed(search: PlanSearch, path: Path) -> bool:
    """Resume the search of the plan in a file; return whether there is one.

    Raises:
        ValueError: The file is of another search or version.
    """
    if not path.exists():
        return False
    found = read_plan(path)
    now, there = identity(search.plan()), identity(found)
    differences = [
        f"{key} is {there.get(key)!r} there and {value!r} now"
        for key, value in now.items()
        if there.get(key) != value
    ]
    if differences:
        raise ValueError(
            f"{path} is of another search: {'; '.join(differences)}. Choose another --output"
        )
    search.resume(found)
    return True


def identity(plan: Plan) -> dict[str, Any]:
    """Return what two searches must share for one to go on with the other's plan."""
    task, versions = (plan.provenance.get(key, {}) for key in ("task", "versions"))
    return {**task, **{name: versions.get(name) for name in ("dptse-env", "libsumo")}}


def save(path: Path, plan: Plan) -> None:
    """Write a plan in one piece."""
    with replacing(path) as temporary:
        write_plan(temporary, plan)


@resumable()
def main(args: Args) -> None:
    """Record what is missing, search, and leave the plan."""
    integer("rounds", args.rounds, 1)
    task = args.task
    if task.kind == "best-static":
        task = dataclasses.replace(task, period=1)
    place = args.workplace(args.output)
    corridor = task.make(1, task.traffic_seeds).config.corridor
    search = PlanSearch(task)  # its errors show before anything is recorded
    path = args.output / f"{search.plan().name}.json"
    place.record(corridor, task.traffic_seeds)
    args.output.mkdir(parents=True, exist_ok=True)
    with place.engine.open() as workers:
        shared = workers if place.engine.is_parallel else None
        scorer = PlanScorer(
            task, task.traffic_seeds, task.batch, records=place.records, workers=shared
        )
        search = PlanSearch(task, scorer)
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
    scores = validation_scores(task, plan, records=place.records)
    save(path, dataclasses.replace(plan, provenance={**plan.provenance, "validation": scores}))
    print(f"mean reward on validation traffic: {scores}\nthe plan is in {path}")


if __name__ == "__main__":
    run(main, Args, __doc__)
