"""Command-line entry points, one job each. They need the extra ``train``."""

from dptse_env.utils.registry import needed_for

with needed_for("dptse"):
    import rich  # noqa: F401
    import tyro  # noqa: F401
