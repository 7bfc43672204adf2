"""Finds out by playing it what a query policy reads, whatever the policy says of itself."""

from __future__ import annotations

from typing import Any, Literal

from agents.environments import make_vector, quietly
from agents.play import Cell, record
from agents.policies import find_policy
from dptse_env.evaluation import evaluate
from dptse_env.traffic import Records

Access = Literal["observations", "process", "truth"]
"""Objects that a policy reads: observations alone; the state of the process, such as the covariance
of the estimator; the true traffic. The last of several counts."""

HARMLESS = {"interface", "config", "n_episodes"}
"""Attributes of a process that tell nothing of its state."""


def access_of(cell: Cell, records: Records = None) -> Access:
    """Return what the policy of a cell reads, found in the episode of its first traffic seed.

    A saved policy is given observations alone.

    Raises:
        ValueError, RecordingError: See `agents.play.play`.
    """
    if not find_policy(cell.policy).is_schedule:
        return "observations"
    assert cell.seeds is not None
    seeds, saw, acting = cell.seeds[:1], set[Access](), False
    given = {**cell.all_keywords, "traffic_seeds": list(seeds), "records": records, "threads": 1}
    with quietly():
        env = make_vector(cell.env, 1, given)
    record(env.config.corridor, seeds, records)

    def watch(watched: Any, what: Access, harmless: set[str]) -> None:
        class Watched(type(watched)):  # type: ignore[misc]
            """An object that tells who looks at it."""

            def __getattribute__(self, name: str) -> Any:
                if acting and name not in harmless and not name.startswith("__"):
                    saw.add(what)
                return super().__getattribute__(name)

        object.__setattr__(watched, "__class__", Watched)

    # The release model and copies of the process have the same traffic.
    watch(env.process.traffic, "truth", set())
    watch(env.process, "process", HARMLESS)

    def acted(act: Any, *arguments: Any, **keywords: Any) -> Any:
        nonlocal acting
        acting = True
        try:
            return act(*arguments, **keywords)
        finally:
            acting = False

    policy = acted(cell.load_policy, env)

    class Witness:
        """The policy; what is read while it acts is known."""

        def predict(self, *arguments: Any, **keywords: Any) -> Any:
            """Act."""
            return acted(policy.predict, *arguments, **keywords)

    evaluate(env, Witness(), seeds, cell.noise_seed)
    if getattr(policy, "uses_truth", False) or "truth" in saw:
        return "truth"
    return "process" if saw else "observations"
