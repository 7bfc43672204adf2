"""Policy files for tests, and changes to them."""

import io
import json
import zipfile

from dptse_env.config import resolve
from dptse_env.parts import make_interface

SHORT = "dptse_env:dptse/ShortHighway-v0"
ABOUT = {
    "env": SHORT,
    "keywords": {"estimator": "ekf"},
    "training": {"learner": "plackett-luce", "seed": 3, "steps": 100},
    "figures": {"error": 0.1234567890123},
}


def make_policy(action="slots", preset="short-highway", **keywords):
    """An untrained policy of the class that goes with an action encoding, and its configuration."""
    import torch
    from stable_baselines3.common.policies import ActorCriticPolicy

    from dptse_env.sb3 import PlackettLucePolicy, RoadChannels

    config = resolve(preset, {"action": action, **keywords})
    interface = make_interface(config)
    spaces = interface.observations.space, interface.actions.space
    torch.manual_seed(0)
    if action == "slots":
        return PlackettLucePolicy(*spaces, road=RoadChannels.from_config(config), width=8), config
    if action == "sequential":
        from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy

        return MaskableActorCriticPolicy(*spaces, lambda _: 1.0, net_arch=[16]), config
    return ActorCriticPolicy(*spaces, lambda _: 1.0, net_arch=[16]), config


def entries_of(path):
    """The content of every entry of a zip archive."""
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def write_entries(path, entries):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)


def rewrite(path, **changes):
    """Replace some entries of a policy file."""
    write_entries(path, {**entries_of(path), **changes})


def edit_card(path, change):
    """Let ``change`` edit the card of a policy file."""
    card = json.loads(entries_of(path)["card.json"])
    change(card)
    rewrite(path, **{"card.json": json.dumps(card)})


def edit_weights(path, change):
    """Let ``change`` edit the weights of a policy file, tensors by name."""
    import torch

    weights = torch.load(io.BytesIO(entries_of(path)["weights.pt"]), weights_only=True)
    change(weights)
    buffer = io.BytesIO()
    torch.save(weights, buffer)
    rewrite(path, **{"weights.pt": buffer.getvalue()})
