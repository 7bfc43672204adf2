"""Release models with one fault each, which state the guarantee of the model that they change."""

from functools import partial

import numpy as np

from dptse_env.release import Capped, Paced
from dptse_env.release.noise import Noise


class Altered(Noise):
    """Noise whose blocks (seconds, C, 2) of an episode are changed."""

    def reset(self, episodes, generators):
        self.blocks = {}
        super().reset(episodes, generators)

    def _draw(self, row, generator):
        super()._draw(row, generator)
        blocks = self.blocks.setdefault(row, [])
        blocks.append(self._normal[row].copy())
        self._normal[row] = self.altered(blocks)


class SharedByTwo(Altered):
    """One noise for two columns that are neighbours."""

    def altered(self, blocks):
        return blocks[-1][:, np.arange(blocks[-1].shape[1]) // 2 * 2]


class Again(Altered):
    """The first block again from the fourth on."""

    def altered(self, blocks):
        return blocks[0 if len(blocks) > 3 else -1]


class AgainOnce(Altered):
    """The first block once more, in place of the fourth."""

    def altered(self, blocks):
        return blocks[0 if len(blocks) == 4 else -1]


class OneForBoth(Altered):
    """One noise for count and deviation."""

    def altered(self, blocks):
        return blocks[-1][..., [0, 0]]


class SeededAlike(Noise):
    """The same noise in every episode."""

    def reset(self, episodes, generators):
        super().reset(episodes, [np.random.default_rng(0) for _ in generators])


class NoBudget:
    """Ledgers that refuse nothing."""

    def __init__(self, task, traffic):
        super().__init__(task, traffic)
        self.ledgers.terms.budget[:] = np.inf


class TwiceTheBudget:
    """The budget of a replacement is that of an addition."""

    def __init__(self, task, traffic):
        super().__init__(task, traffic)
        self.ledgers.terms.budget[:] *= 2.0


class NewPseudonyms:
    """Vehicles have new ledgers every 20 s."""

    def release(self, request):
        self.ledgers.reset(request.episodes[request.times % 20 == 0])
        return super().release(request)


class Unclipped(Paced):
    """A vehicle adds three times the deviation that it pays for."""

    def collect(self, request, prices, centre, sigma):
        sums, refused = super().collect(request, prices, centre, sigma)
        sums[..., 1] *= 3.0
        return sums, refused


def noisy(base, kind):
    """Return a release model with another noise."""

    class Noisy(base):
        def __init__(self, task, traffic):
            super().__init__(task, traffic)
            self.noise = kind(task.n_episodes, task.n_channels)

    return Noisy


SharedNoise = noisy(Paced, SharedByTwo)


def mixed(fault, base):
    """Return a release model with a fault of its ledgers."""
    return type(fault.__name__, (fault, base), {})


MECHANISMS = {
    f"`{base.__name__.lower()}`, {name}": noisy(base, kind)
    for base in (Capped, Paced)
    for name, kind in {
        "half the noise": partial(Noise, scale=0.5),
        "four fifths of the noise": partial(Noise, scale=0.8),
        "one noise for two channels": SharedByTwo,
        "one noise for counts and deviations": OneForBoth,
        "32 s of noise again and again": Again,
        "32 s of noise once more": AgainOnce,
        "one noise for all episodes": SeededAlike,
    }.items()
} | {
    "`capped`, no cap": mixed(NoBudget, Capped),
    "`capped`, a new pseudonym every 20 s": mixed(NewPseudonyms, Capped),
    "`paced`, no budget": mixed(NoBudget, Paced),
    "`paced`, a new pseudonym every 20 s": mixed(NewPseudonyms, Paced),
    "`paced`, twice the budget": mixed(TwiceTheBudget, Paced),
    "`paced`, three times the deviation": Unclipped,
}
"""Release models whose noise has a fault, and those of which a vehicle gets too much."""
