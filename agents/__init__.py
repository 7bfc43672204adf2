"""Evaluation, training, search and studies on top of dptse_env. They need the extra ``train``."""

from dptse_env.utils.registry import needed_for

with needed_for("agents"):
    import rich  # noqa: F401
