"""The recurrent network as an estimator, trained on simulated traffic.

Files of weights (`read_weights`) have the arrays `Weights`, and a card with the roads and releases
that they were trained on.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from dptse_env.estimators.base import Played, SegmentEstimator
from dptse_env.estimators.recurrent_kernels import (
    FEATURES,
    LONGEST_AGE,
    Memory,
    State,
    Weights,
    make_cells,
    predict,
    restart,
    shapes,
    update,
)
from dptse_env.estimators.settings import EstimatorSettings
from dptse_env.model import ARZModel
from dptse_env.road import Road
from dptse_env.utils.arrays import AnyArray
from dptse_env.utils.files import read_tensors, require_arrays, write_tensors
from dptse_env.utils.kernels import Bundle

LARGEST_WIDTH = 512
FORMAT = "recurrent-3"
"""Name of the features' order and meaning; another one is refused."""

SHIPPED = ("highway", "long-highway", "roads")
"""Pairs that come with the package, each trained on more kinds of roads than those before it."""
CHOSEN_BY = ("flows", "own_parameters", "epsilon")
"""Properties that weights must know beside the road, to be taken on it.

At epsilon 1,000, ``roads`` errs 21.3 +- 3.3 % less than ``highway`` on PrivateHighway-v1. With one
connected vehicle in five it errs 36 +- 14 % more on ShortHighway-v0, though ``highway`` knows no
such share.
"""

_FOLDER, _SUFFIX = Path(__file__).parent / "weights", ".safetensors"


class Recurrent(SegmentEstimator):
    """A gated recurrent unit in every cell of the road (`recurrent_kernels`).

    All cells have the same weights. A cell reads the releases that cover it, the prediction of its
    state, the model's inputs at its ends and the hidden states of its neighbours. The traffic
    model is not used. Deviations are outputs of the network; errors of different cells, and of
    density and speed, count as independent.

    Attributes:
        saved: The weights in force, with their card.
        hidden: Hidden states, shape (n, S, H).
    """

    restart_kernel = staticmethod(restart)
    predict_kernel = staticmethod(predict)
    update_kernel = staticmethod(update)

    def __init__(self, model: ARZModel, n_episodes: int, settings: EstimatorSettings) -> None:
        """See `make_estimator`."""
        super().__init__(model, n_episodes, settings)
        self.saved = weights_of(settings, flows=model.releases_flow)
        S, n = model.n_segments, n_episodes
        memory = Memory(
            inputs=np.zeros((n, model.n_inputs)),
            present=self.present,
            age=np.full((n, S), LONGEST_AGE),
            innovations=self.innovations,
        )
        state = State(
            hidden=np.zeros((n, S, self.saved.weights.width), dtype=np.float32),
            ahead=np.zeros((n, S, 4)),
            priors=self.priors,
            diverged=self.diverged,
        )
        self.hidden = state.hidden
        self.arrays = Bundle(
            model.road, model.channels, make_cells(model), memory,
            self.saved.weights, state,
        )  # fmt: skip

    @property
    def _memory(self) -> tuple[AnyArray, ...]:
        _, _, _, memory, _, state = self.arrays.parts
        return (
            memory.inputs, memory.present, memory.age, state.hidden, state.ahead, state.priors,
        )  # fmt: skip

    @staticmethod
    def check_settings(model: ARZModel, settings: EstimatorSettings) -> None:
        """Refuse weights that are missing or cannot be read."""
        weights_of(settings, flows=model.releases_flow)

    @classmethod
    def in_force(cls, road: Road, played: Played, settings: EstimatorSettings) -> EstimatorSettings:
        """Name the first of `SHIPPED` that know the road, its parameters and the noise, if None."""
        if settings.recurrent.weights is not None:
            return settings
        flows, asked = bool(played["flows"][0]), {name: played[name] for name in CHOSEN_BY}
        members = {name: member_for(name, flows) for name in SHIPPED}
        suited = (
            name
            for name, member in members.items()
            if member in shipped_weights() and not outside(read_weights(member), road, asked)
        )
        own = dataclasses.replace(settings.recurrent, weights=next(suited, SHIPPED[-1]))
        return dataclasses.replace(settings, recurrent=own)

    @classmethod
    def inherits(cls, road: Road, played: Played, settings: EstimatorSettings) -> dict[str, str]:
        """Return the setting of the weights where their card does not name what is played."""
        saved = weights_of(settings, flows=bool(played["flows"][0]))
        beyond = ", ".join(
            f"{name} {where}" for name, where in outside(saved, road, played).items()
        )
        known = f"{saved.source} was trained on {beyond}"
        return {"estimator_settings.recurrent.weights": known} if beyond else {}


def outside(saved: SavedWeights, road: Road, played: Played) -> dict[str, str]:
    """Return the properties of a road, its traffic and releases that weights do not know.

    With each come its range and the first value beyond it. Ranges that a card lacks hold for
    everything.
    """
    found: dict[str, Sequence[float]] = {
        "n_mainline": (road.n_mainline,),
        "segment_length": road.lengths.tolist(),
        "speed_limit": road.limits.tolist(),
        "lanes": road.lanes.tolist(),
        **played,
    }
    return {
        name: f"{low:g} to {high:g}, not {value:g}"
        for name, (low, high) in saved.card["ranges"].items()
        for value in [each for each in found.get(name, ()) if not low <= each <= high][:1]
    }


@dataclass(frozen=True)
class SavedWeights:
    """Weights with their card.

    Attributes:
        weights: The arrays.
        card: ``name``, ``format``, ``channels``, ``ranges``, ``training``, and ``sha256`` of the
            content.
        source: The file, or the name of weights that come with the package.
    """

    weights: Weights
    card: Mapping[str, Any]
    source: str


def weights_of(settings: EstimatorSettings, *, flows: bool) -> SavedWeights:
    """Return the weights of settings, or else those of any road, for releases of flows or speeds.

    Raises:
        ValueError: See `read_weights`.
    """
    return read_weights(member_for(settings.recurrent.weights or SHIPPED[-1], flows))


@cache
def shipped_weights() -> tuple[str, ...]:
    """Return the names of the weights that come with the package."""
    return tuple(sorted(path.stem for path in _FOLDER.glob(f"*{_SUFFIX}")))


def member_for(source: str, flows: bool) -> str:
    """Return the member of a pair of weights that suits releases of flows, or of speeds.

    The names, or files, of a pair are ``<source>-flows`` and ``<source>-speeds``. The name or file
    of a single member is returned as it is.
    """
    member = f"{source}-{'flows' if flows else 'speeds'}"
    if member in shipped_weights():
        return member
    return f"{member}{_SUFFIX}" if Path(f"{member}{_SUFFIX}").is_file() else source


def read_weights(source: str) -> SavedWeights:
    """Read weights, given by name or as a file.

    Raises:
        ValueError: There is no such name or file, or it holds no weights, or is damaged.
    """
    if source in shipped_weights():
        return _shipped(source)
    if not Path(source).is_file():
        names = {name.removesuffix("-flows") for name in shipped_weights()}
        known = ", ".join(sorted(names.union(shipped_weights())))
        raise ValueError(
            f"estimator_settings.recurrent.weights must be a file or one of {known}, got {source!r}"
        )
    return _read(Path(source), source)


@cache
def _shipped(name: str) -> SavedWeights:
    return _read(_FOLDER / f"{name}{_SUFFIX}", name)


def _read(path: Path, source: str) -> SavedWeights:
    card, arrays = read_tensors(path)
    try:
        return SavedWeights(_checked(arrays, card), card, source)
    except ValueError as problem:
        raise ValueError(f"{source} is not a file of weights: {problem!s:.300}") from problem


def write_weights(path: str | os.PathLike[str], weights: Weights, card: Mapping[str, Any]) -> None:
    """Write weights with their card; the same arrays and card give the same bytes.

    Raises:
        ValueError: The arrays or their card have another layout; nothing is written.
        OSError: The file cannot be written; what was there stays.
    """
    arrays = weights._asdict()
    _checked(arrays, card)
    write_tensors(path, arrays, card)


def _checked(arrays: Mapping[str, AnyArray], card: Mapping[str, Any]) -> Weights:
    """Return the weights of a file's arrays and card, or refuse them."""
    channels = card.get("channels")
    if card.get("format") != FORMAT or channels != list(FEATURES):
        raise ValueError(
            f"it has features of format {card.get('format')!r}, this version reads {FORMAT!r}"
        )
    ranges = card.get("ranges")
    if not isinstance(ranges, dict):
        raise ValueError(f"its card must have ranges, got {ranges!r}")
    for name, bounds in ranges.items():
        numbers = isinstance(bounds, list) and len(bounds) == 2
        if not numbers or not all(isinstance(bound, int | float) for bound in bounds):
            raise ValueError(f"its card's range of {name!r} must be two numbers, got {bounds!r}")
    width = len(arrays["hidden"]) if "hidden" in arrays and arrays["hidden"].ndim else 0
    if not 1 <= width <= LARGEST_WIDTH:
        raise ValueError(f"its width must be in 1..{LARGEST_WIDTH}, got {width}")
    require_arrays(arrays, shapes(width), np.float32)
    return Weights(**arrays)
