"""Every command that takes time, killed: the same command goes on from what is done to its end."""

import hashlib
import json
import signal
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import optuna
import pytest

pytest.importorskip("sb3_contrib")
pytest.importorskip("tyro")

from agents.search.tuning import n_finished
from agents.study import read_rows
from agents.training.run_files import read_progress
from tests.agents.training.plans import SMALL, STEPS, without_time
from tests.helpers import SHORT, run_killed
from tests.scripts import test_train_estimator
from tests.scripts.commands import ROAD

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform == "win32", reason="Windows kills otherwise"),
]

UPDATED = "dptse_env.utils.progress:tqdm", "update"
KEPT = "agents.training.run_files:TrainingFolder", "keep"
TRAIN = ["train", "--env", f'{SHORT} {{"horizon": 64}}', "--train-seeds", "0:2"]
TRAIN += ["--validation-seeds", "1000:1001", "--output", "out", "--algorithm"]


class Killed(NamedTuple):
    """A command, and how it is killed.

    Attributes:
        words: Its words, with results in the folder ``out``.
        owner: Who has the function that is counted.
        function: Its name.
        calls: After so many the command is killed.
        done: Returns what is done, one by one.
    """

    words: list[str]
    owner: str
    function: str
    calls: int
    done: Callable[[Path], list[Any]]


def rows_of(study, folder):
    return read_rows(study, folder).sort("cell", "traffic_seed").rows()


def curve_of(run, folder):
    return without_time(read_progress(folder / run))


def updates_of(folder):
    return [row["update"] for row in read_progress(folder)]


def records_of(folder):
    files = folder.rglob("0*.safetensors")
    return sorted((path.name, hashlib.sha256(path.read_bytes()).hexdigest()) for path in files)


def tried_of(folder):
    return json.loads((folder / "my-road-fit" / "stages" / "search.json").read_text())


def trials_of(folder):
    """Return the numbers of trials that were completed or stopped early."""
    backend = optuna.storages.journal.JournalFileBackend(str(folder / "trials.journal"))
    storage = optuna.storages.JournalStorage(backend)
    (name,) = optuna.get_all_study_names(storage)
    return [*range(n_finished(optuna.load_study(study_name=name, storage=storage)))]


COMMANDS = {
    "record": Killed(
        ["record", "--env", SHORT, "--train-seeds", "0:4", "--workers", "1", "--records", "out"],
        *UPDATED, 2, records_of,
    ),
    "evaluate": Killed(
        ["evaluate", "--env", f'{SHORT} {{"horizon": 80}}', "--test-seeds", "2000:2002",
         "--policies", "none", "oldest-first", "shift-ahead", "--estimators", "random_walk",
         "--workers", "1", "--output", "out"],
        *UPDATED, 2, partial(rows_of, "evaluation"),
    ),
    "study": Killed(
        ["study", "examples.my_study:STUDY", "--test-seeds", "2000:2002", "--workers", "1",
         "--output", "out"],
        *UPDATED, 3, partial(rows_of, "my-study"),
    ),
    "train plackett-luce": Killed(
        [*TRAIN, f"plackett-luce {json.dumps(SMALL['plackett-luce'])}"],
        *KEPT, 1, partial(curve_of, "."),
    ),
    "train ppo": Killed(
        [*TRAIN, f"ppo {json.dumps(SMALL['ppo'])}", "--steps", str(STEPS)], *KEPT, 1, updates_of,
    ),
    "train-estimator": Killed(
        ["train-estimator", *test_train_estimator.SMALL, "--seed", "0", "--kinds", "flows",
         "--output", "out"],
        *KEPT, 1, partial(curve_of, "flows-0"),
    ),
    "fit": Killed(
        ["fit", "out/my-road.toml", "--train-seeds", "0:2", "--validation-seeds", "1000:1002",
         "--test-seeds", "2000:2002", "--trials", "20", "--estimators", "ekf", "random_walk",
         "--policies", "round-robin", "oldest-first", "--workers", "1"],
        "agents.fitting.parameters", "write_json", 7, tried_of,
    ),
    "fit --tune": Killed(
        ["fit", "--tune", "--env", SHORT, "--estimators", "ekf", "--train-seeds", "0:2",
         "--trials", "8", "--workers", "2", "--output", "out"],
        *UPDATED, 4, trials_of,
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "how"),
    [*((name, 9) for name in COMMANDS), ("train ppo", signal.SIGINT)],
)
def test_a_command_that_is_ended_goes_on(name, how, tmp_path):
    command = COMMANDS[name]

    def run(folder, calls):
        (tmp_path / folder).mkdir(exist_ok=True)
        road = tmp_path / folder / "my-road.toml"
        if name == "fit" and not road.exists():
            road.write_text(ROAD)
        words = [
            word.replace("out", str(tmp_path / folder), 1) if word.startswith("out") else word
            for word in command.words
        ]
        where = command.owner, command.function, calls
        return run_killed(*where, "scripts.dptse", *words, how=how)

    done = run("whole", 10_000)
    assert done.returncode == 0, done.stderr
    end = command.done(tmp_path / "whole")
    done = run("killed", command.calls)  # its records are there
    assert done.returncode == (130 if how == signal.SIGINT else -how), done.stderr
    assert how == 9 or "the same command goes on" in done.stderr
    kept = command.done(tmp_path / "killed")
    assert 0 < len(kept) < len(end)
    done = run("killed", 10_000)
    assert done.returncode == 0, done.stderr
    assert command.done(tmp_path / "killed") == end
    assert all(each in end for each in kept)
