"""Policies for tests, before and after they are saved."""

from dptse_env.config import resolve
from dptse_env.parts import make_interface

SHORT = "dptse_env:dptse/ShortHighway-v0"
ABOUT = {
    "env": SHORT,
    "keywords": {"estimator": "ekf"},
    "training": {"learner": "plackett-luce", "seed": 3, "steps": 100},
    "figures": {"error": 0.1234567890123},
}


def make_policy(action="slots", preset="short-highway", net_arch=(16,), **keywords):
    """An untrained policy of the class that goes with an action encoding, and its configuration."""
    import torch
    from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
    from stable_baselines3.common.policies import ActorCriticPolicy

    from dptse_env.sb3 import PlackettLucePolicy

    config = resolve(preset, {"action": action, **keywords})
    torch.manual_seed(0)
    if action == "slots":
        return PlackettLucePolicy.from_config(config, width=8), config
    interface = make_interface(config)
    spaces = interface.observations.space, interface.actions.space
    kind = MaskableActorCriticPolicy if action == "sequential" else ActorCriticPolicy
    net_arch = net_arch if isinstance(net_arch, dict) else list(net_arch)
    return kind(*spaces, lambda _: 1.0, net_arch=net_arch), config


def save(path, action="slots", **keywords):
    """Save an untrained policy; return its file."""
    from dptse_env.sb3 import save_policy

    save_policy(path, *make_policy(action, **keywords), **ABOUT)
    return path
