"""The configuration of an environment, presets, and the keywords that change them."""

from dptse_env.config.env_config import (
    MOST_SEEDS,
    PRESETS,
    TEST_SEEDS,
    TIME_STEP,
    TRAINING_SEEDS,
    VALIDATION_SEEDS,
    EnvConfig,
)
from dptse_env.config.keywords import UnknownKeywordError, parse_seeds, resolve

__all__ = [
    "MOST_SEEDS",
    "PRESETS",
    "TEST_SEEDS",
    "TIME_STEP",
    "TRAINING_SEEDS",
    "VALIDATION_SEEDS",
    "EnvConfig",
    "UnknownKeywordError",
    "parse_seeds",
    "resolve",
]
