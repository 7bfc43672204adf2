import dataclasses
import json
import math
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from optuna.trial import TrialState

from agents.executors import THIS_PROCESS
from agents.search.tuning import BATCH, journal_path, locked_study, scores_of
from agents.search.tuning_task import score_episodes
from dptse_env.estimators import EstimatorSettings
from dptse_env.estimators.settings import load_settings, read_settings
from tests.agents.search.tasks import TASK

MADE_UP = dataclasses.replace(TASK, seeds=f"0:{3 * BATCH}")
BATCHES = [tuple(range(k * BATCH, (k + 1) * BATCH)) for k in range(3)]


def made_up(task, settings, seeds):
    """Best at a process noise of (0.02, 0.005)."""
    distance = (
        math.log(settings.process_noise[0] / 0.02) ** 2
        + math.log(settings.process_noise[1] / 0.005) ** 2
    )
    return [
        {
            "traffic_seed": seed,
            "rmse_density": 10 + distance,
            "rmse_speed": 5 + distance,
            "reward": -0.1 * distance - seed,
            "n_diverged": 1.0,
        }
        for seed in seeds
    ]


class Fake:
    """Scores that are made up, and what was scored."""

    def __init__(self):
        self.calls = []

    def __call__(self, task, settings, seeds):
        self.calls.append((settings, seeds))
        return made_up(task, settings, seeds)


@pytest.fixture
def fake():
    return Fake()


def run(folder, n_trials, task=TASK, score=score_episodes, executor=THIS_PROCESS, **keywords):
    with locked_study(task, folder, score=score) as study:
        study.run(n_trials, executor, **keywords)
    return study


def trials(study):
    return [(t.state, t.params, t.intermediate_values) for t in study.study.get_trials()]


def test_it_beats_the_defaults_on_real_traffic(tmp_path):
    task = dataclasses.replace(TASK, seeds="0:2")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        study = run(tmp_path, 6, task)
    best, defaults = study.best(), study.labelled("defaults")
    assert study.n_finished() == 6
    assert best.value >= defaults.value
    settings = EstimatorSettings(**best.user_attrs["settings"])
    rows = score_episodes(task, settings, (0, 1))
    assert best.value == pytest.approx(np.mean([row["reward"] for row in rows]), rel=1e-12)
    for key in ("rmse_density", "rmse_speed"):
        expected = np.mean([row[key] for row in rows])
        assert best.user_attrs[key] == pytest.approx(expected, rel=1e-12)


def test_it_finds_the_best_settings(tmp_path, fake):
    study = run(tmp_path, 60, MADE_UP, fake)
    path = tmp_path / "x.json"
    study.write(path)
    assert read_settings(path).process_noise == pytest.approx((0.02, 0.005), rel=0.5)
    assert study.study.best_value > scores_of(study.labelled("defaults"))["score"]
    provenance = json.loads(path.read_text())[MADE_UP.name]["provenance"]
    assert provenance["n_trials"] == 60
    assert (provenance["seeds"], provenance["bandwidth"]) == (MADE_UP.seeds, 2)
    assert provenance["at_bounds"] == []
    assert len({tuple(t.params.values()) for t in study.study.get_trials()}) == 60


def test_the_defaults_and_the_present_set_are_tried_first_and_to_the_end(tmp_path, fake):
    run(tmp_path, 2, MADE_UP, fake)
    first = EstimatorSettings(), load_settings("ekf-w99-3lane-paper")
    assert fake.calls == [(settings, seeds) for settings in first for seeds in BATCHES]
    other = Fake()
    run(tmp_path / "open", 1, dataclasses.replace(MADE_UP, privacy="corrected"), other)
    assert other.calls == [(EstimatorSettings(), seeds) for seeds in BATCHES]


def test_bad_trials_stop_early_but_never_the_first_two(tmp_path, fake):
    study = run(tmp_path, 30, MADE_UP, fake)
    pruned = [t for t in study.study.get_trials() if t.state == TrialState.PRUNED]
    assert pruned
    assert all(len(t.intermediate_values) < 3 for t in pruned)
    assert not any("label" in t.user_attrs for t in pruned)


def test_an_interrupted_study_comes_out_as_one_that_was_not(tmp_path, fake):
    complete = run(tmp_path / "complete", 20, MADE_UP, fake)
    first = trials(run(tmp_path / "parts", 13, MADE_UP, fake))
    path = journal_path(TASK, tmp_path / "parts")
    lines = path.read_bytes().splitlines(keepends=True)
    # Cut inside trial 12, as a kill in the middle of a write does, the lock still there.
    started = max(i for i, line in enumerate(lines) if json.loads(line)["op_code"] == 4)
    path.write_bytes(b"".join(lines[: started + 2]) + b'{"op_co')
    (tmp_path / "parts" / f"{path.name}.lock").touch()
    resumed = run(tmp_path / "parts", 20, MADE_UP, fake)
    kept = [trial for trial in trials(resumed) if trial[0] != TrialState.FAIL]
    assert len(trials(resumed)) == 21
    assert first[:12] == kept[:12]
    assert kept == trials(complete)
    assert resumed.n_finished() == 20


def test_a_finished_study_does_nothing_more(tmp_path, fake):
    run(tmp_path, 5, score=fake)
    again = Fake()
    study = run(tmp_path, 5, score=again)
    study.write(tmp_path / "x.json")
    assert again.calls == []
    assert read_settings(tmp_path / "x.json") == EstimatorSettings(
        **study.best().user_attrs["settings"]
    )


def test_a_stale_first_trial_is_run_again(tmp_path):
    def fail(task, settings, seeds):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, 5, score=fail)
    study = run(tmp_path, 5, score=made_up)
    assert study.n_finished() == 5
    assert study.labelled("defaults").intermediate_values
    assert study.labelled("shipped").intermediate_values
    states = [t.state.name for t in study.study.get_trials()]
    assert states.count("FAIL") == 1
    assert not {"RUNNING", "WAITING"} & set(states)


def test_several_trials_at_once_make_the_number_wanted(tmp_path, fake):
    finished = []
    with ThreadPoolExecutor(3) as threads:
        study = run(
            tmp_path,
            10,
            score=fake,
            executor=threads,
            n_parallel=3,
            on_trial=lambda: finished.append(1),
        )
    assert study.n_finished() == len(study.study.get_trials()) == len(finished) == 10


def test_a_score_that_is_not_finite_is_never_the_best(tmp_path):
    def without_reward(task, settings, seeds):
        first, *rest = made_up(task, settings, seeds)
        return [{**first, "reward": math.nan}, *rest]

    def score(task, settings, seeds):
        bad = settings.process_noise[0] > EstimatorSettings().process_noise[0]
        return (without_reward if bad else made_up)(task, settings, seeds)

    study = run(tmp_path, 20, score=score)
    refused = [trial.user_attrs.get("not_finite") for trial in study.study.get_trials()]
    assert [0] in refused
    assert study.best().params["process_noise.0"] <= 0.01
    study = run(tmp_path / "nothing", 3, score=without_reward)
    with pytest.raises(ValueError, match="ekf-w99-3lane-paper: no trial ran to its end"):
        study.write(tmp_path / "x.json")


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"seeds": "0:2"}, "seeds is '0:3' there and '0:2' now"),
        ({"keywords": {"bandwidth": 3}}, "keywords.bandwidth is 2 there and 3 now"),
    ],
)
def test_a_study_of_other_arguments_is_refused(changes, named, tmp_path, fake):
    run(tmp_path, 2, score=fake)
    with pytest.raises(
        ValueError, match=f"ekf-w99-3lane-paper.journal has .* another search: {named}"
    ):
        run(tmp_path, 2, dataclasses.replace(TASK, **changes), fake)
    with (
        pytest.raises(ValueError, match="sampler_seed"),
        locked_study(TASK, tmp_path, seed=1),
    ):
        pass


def test_two_runs_do_not_write_one_journal(tmp_path):
    with (
        locked_study(TASK, tmp_path),
        pytest.raises(BlockingIOError, match=r"another run is writing .*\.journal"),
        locked_study(TASK, tmp_path),
    ):
        pass
