"""The latest epochs together, where single ones are too poor for a fix."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sonofix.locate.fix import fix
from sonofix.records import Fix, RangeEpoch
from sonofix.site import Site
from sonofix.track.belief import Belief

GATHER_S = 5.0
"""How long ranges are gathered."""


class Recent:
    """Epochs of the last `GATHER_S`."""

    def __init__(self, site: Site) -> None:
        self._site = site
        self._epochs: list[RangeEpoch] = []
        self._since_s = np.inf

    def take(self, epoch: RangeEpoch) -> None:
        """Take in an epoch; one without ranges is no news."""
        if len(epoch):
            self._since_s = min(self._since_s, epoch.sync_s)
            self._epochs = [e for e in self._epochs if epoch.sync_s - e.sync_s < GATHER_S] + [epoch]

    def __len__(self) -> int:
        """Return how many epochs there are."""
        return len(self._epochs)

    @property
    def pairs(self) -> int:
        """How many pairs were heard in them."""
        return len({pair for epoch in self._epochs for pair in zip(epoch.emitter, epoch.receiver, strict=True)})

    @property
    def early(self) -> bool:
        """Whether it has not been gathered for `GATHER_S` yet."""
        return self._epochs[-1].sync_s < self._since_s + GATHER_S

    def fix(self, vehicle: str, belief: Belief) -> Fix:
        """Return a vehicle's fix from the latest range of each pair.

        Where a belief follows the errors of stated ranges, these are taken off and doubted as it does.
        """
        latest: dict[tuple[str, str], tuple[RangeEpoch, int]] = {}
        for epoch in self._epochs:
            for i, pair in enumerate(zip(epoch.emitter, epoch.receiver, strict=True)):
                latest[pair] = (epoch, i)
        chosen = list(latest.values())
        merged = replace(
            self._epochs[-1],
            emitter=tuple(pair[0] for pair in latest),
            receiver=tuple(pair[1] for pair in latest),
            time_s=np.array([e.time_s[i] for e, i in chosen]),
            range_m=np.array([e.range_m[i] for e, i in chosen]),
            covariance_m2=np.diag([e.covariance_m2[i, i] for e, i in chosen]),
            range_rate_mps=None,
            range_rate_sd_mps=None,
            snr_db=None,
        )
        inputs = belief.inputs
        if inputs is not None and inputs.range_slot >= 0:
            scale, bias_m = belief.mean[inputs.range_slot :][:2]
            merged = replace(merged, range_m=(merged.range_m - bias_m) / (1.0 + scale))
            if belief.trust is not None:
                numbers = np.array([inputs.pairs[pair] for pair in latest])
                own_m2 = belief.trust.extra(numbers) + belief.trust.variance[:, numbers].sum(axis=0)
                merged = replace(merged, covariance_m2=merged.covariance_m2 + np.diag(own_m2))
        return fix(merged, self._site, vehicle)
