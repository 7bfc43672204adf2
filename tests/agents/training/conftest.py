import functools

import pytest


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """Return a function from learners to finished trainings; leave them alone."""
    pytest.importorskip("sb3_contrib")
    from agents.training.training import Training
    from tests.agents.training.plans import make_plan

    @functools.cache
    def train(learner="plackett-luce"):
        reports = []
        training = Training(
            make_plan(learner), tmp_path_factory.mktemp(learner),
            progress=lambda *report: reports.append(report),
        )  # fmt: skip
        training.run()
        training.reports = reports
        return training

    return train
