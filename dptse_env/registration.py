"""The environment ids. Entry points are strings, so registering imports nothing heavy."""

from gymnasium.envs.registration import register, registry

ENVIRONMENTS = {
    "dptse/PaperHighway-v0": "paper-highway",
    "dptse/PrivateHighway-v0": "private-highway",
    "dptse/ShortHighway-v0": "short-highway",
}
"""Environment ids and the preset behind each."""


def register_environments() -> None:
    """Register the ids with Gymnasium; calling it twice changes nothing."""
    for env_id, preset in ENVIRONMENTS.items():
        if env_id not in registry:
            register(
                id=env_id,
                entry_point="dptse_env.env:SensorQueryEnv",
                vector_entry_point="dptse_env.vector_env:SensorQueryVectorEnv",
                kwargs={"preset": preset},
            )
