"""Untrained policies for the short road, saved as trained ones are."""

from dptse_env.config import resolve

SHORT = "dptse_env:dptse/ShortHighway-v0"


def save(path, seed=0, **keywords):
    """Save a Plackett-Luce policy with weights of `seed` for an environment of these keywords."""
    import torch

    from dptse_env.sb3 import PlackettLucePolicy, save_policy

    keywords = {"bandwidth": 2, **keywords}
    config = resolve("short-highway", {**keywords, "action": "slots"})
    torch.manual_seed(seed)
    policy = PlackettLucePolicy.from_config(config, width=8)
    with torch.no_grad():
        for weights in policy.parameters():  # fresh ones leave the rule as it is
            weights.add_(0.05 * torch.randn_like(weights))
    path.parent.mkdir(parents=True, exist_ok=True)
    save_policy(
        path, policy, config, env=SHORT, keywords=keywords,
        training={"learner": "plackett-luce", "seed": seed}, figures={},
    )  # fmt: skip
    return path
