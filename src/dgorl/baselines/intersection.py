"""Filters that fuse readings to peers' broadcast estimates: naively, and by covariance intersection. METHOD §7.

At each keyframe that has readings the robots involved broadcast their predicted estimate and their readings, without
loss; then each fuses what involves it, all at once. Both ends use a reading. Only the own pose is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dgorl import se2
from dgorl.baselines.beliefs import Belief, advanced, told
from dgorl.baselines.filters import FilterTeam
from dgorl.baselines.fusion import bound, fused, shares
from dgorl.baselines.readings import Readings, gathered, linearized, trust
from dgorl.baselines.sightings import Sighting
from dgorl.se2 import Array

ITERATIONS = 1
"""How often readings are linearised in one fusion; more gained nothing where it was tried."""


class NaiveTeam(FilterTeam):
    """Takes peers' estimates for independent of the own one, which after the first exchange they are not."""

    def _exchange(self, keyframe: int, sightings: Sequence[Sighting]) -> None:
        names = sorted({track.key.robot for s in sightings for track in (s.a, s.b)})
        said = {name: advanced(self._beliefs[name], keyframe) for name in names}
        readings = gathered([_moved(s, said) for s in sightings], names)
        for own, name in enumerate(names):
            self._beliefs[name] = self._fused(own, list(said.values()), readings.of(own))

    def _fused(self, own: int, said: Sequence[Belief], readings: Readings) -> Belief:
        """An iterated extended Kalman update on the bound; robust weights and shares stay those of the first round."""
        involved = np.unique([readings.a, readings.b])
        if len(involved) == 0:
            return told(said[own])
        radio = self.configuration.radio
        beliefs = [said[k] for k in involved]
        readings = replace(readings, a=np.searchsorted(involved, readings.a), b=np.searchsorted(involved, readings.b))
        me = int(np.searchsorted(involved, own))
        predicted = np.array([belief.pose for belief in beliefs])
        dependent, independent = self._parts(beliefs)
        residual, jacobian = linearized(readings, predicted, radio)
        noise = readings.sigma**2
        spread = np.einsum("mki,kij,mkj->m", jacobian, dependent + independent, jacobian) + noise
        noise = noise / trust(readings, residual, spread)
        joint = bound(dependent, independent, self._shares(dependent, independent, jacobian, noise, me))
        correction, covariance = fused(joint, jacobian, noise, residual, me)
        for _ in range(ITERATIONS - 1):
            residual, jacobian = linearized(readings, se2.compose(predicted, se2.exp(correction)), radio)
            residual = residual + np.einsum("mki,ki->m", jacobian, correction)
            correction, covariance = fused(joint, jacobian, noise, residual, me)
        pose = se2.compose(predicted[me], se2.exp(correction[me]))
        return replace(said[own], pose=pose, dependent=covariance, independent=np.zeros((3, 3)))

    def _parts(self, beliefs: Sequence[Belief]) -> tuple[Array, Array]:
        """Dependent and independent covariances (n, 3, 3)."""
        return np.array([b.dependent for b in beliefs]), np.array([b.independent for b in beliefs])

    def _shares(self, dependent: Array, independent: Array, jacobian: Array, noise: Array, own: int) -> Array:
        """ω (n,) of the robots."""
        return np.ones(len(dependent))


class SplitIntersectionTeam(NaiveTeam):
    """Split covariance intersection: a robot's odometry noise since its last broadcast is nobody else's."""

    bounded = True

    def _shares(self, dependent: Array, independent: Array, jacobian: Array, noise: Array, own: int) -> Array:
        return shares(dependent, independent, jacobian, noise, own)


class IntersectionTeam(SplitIntersectionTeam):
    """Plain covariance intersection: anything may depend on anything."""

    def _parts(self, beliefs: Sequence[Belief]) -> tuple[Array, Array]:
        dependent = np.array([b.covariance for b in beliefs])
        return dependent, np.zeros_like(dependent)


def _moved(s: Sighting, said: dict[str, Belief]) -> Sighting:
    """A reading that comes late, in the frames of the keyframes at which the beliefs stand."""
    a, b = said[s.a.key.robot], said[s.b.key.robot]
    if a.keyframe == s.keyframe_a and b.keyframe == s.keyframe_b:
        return s
    at_a = se2.compose(_back(a, s.keyframe_a), s.at_a)
    at_b = se2.compose(_back(b, s.keyframe_b), s.at_b)
    return replace(s, at_a=at_a, at_b=at_b)


def _back(belief: Belief, keyframe: int) -> Array:
    """Pose (3,) at an earlier keyframe in the frame of the belief's."""
    then = replace(belief, keyframe=min(keyframe, belief.keyframe), pose=np.zeros(3))
    return se2.inverse(advanced(then, belief.keyframe).pose)
