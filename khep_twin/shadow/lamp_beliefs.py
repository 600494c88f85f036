"""Probabilities of what the lamps of a playpen may be: as told, off, or at one of many places.

The hypotheses are that all lamps are as they are believed, and for each lamp that it alone is in another
state. At any time a lamp may go from one state to another, at a rate; the likelihoods of replies tell which
did. The places lie on a grid; where few are probable, others are drawn from them, closer together.
"""

import math

import numpy as np
from numpy.typing import NDArray

from khep_twin.playpen import Playpen
from khep_twin.shadow.light_model import LightModel
from khep_twin.shadow.particles import drawn
from khep_twin.shadow.planes import Planes
from khep_twin.shadow.start import inside

Floats = NDArray[np.float64]

TOLD, OFF, MOVED = range(3)
"""States of a lamp that is believed: as told, off, or where it was found."""

GOES_OFF, MOVES, ENDS, CORRECTED = 9.0, 9.5, 5.0, 4.0
"""Logarithms of the odds against a lamp that goes off in a second, or is moved, against the end of that, and
against another place nearby of one that was found elsewhere (assumed)."""

MOVED_BY = 0.12
"""Standard deviation by which half of the lamps that are moved are so, along x and y [m] (assumed); the
others may be anywhere."""

_NEVER = 1e-9
"""Least sum of weights of places near a lamp; one far outside the arena has none."""

_GRID = 3
"""First state that is another place of a lamp."""

_PLACES, _LEAST_PLACES = 96, 24
"""Places of the grid, for all lamps together and for one at the least (assumed)."""

_FINE = 32
"""Places that are drawn from others for each lamp."""

_NEAR = 0.05
"""Distance from its own place up to which a lamp is not elsewhere [m]: poses are no better known."""

_FINEST = 0.004
"""Least deviation of a lamp's place [m] (assumed)."""

_NEARBY = 0.01
"""Deviation of places that are nearby, at the least [m] (assumed)."""

_FALLING = 2.5
"""Power of the distance with which light falls, about."""

_LEAST = 3.0
"""Light that is not computed [counts]."""

_PROBABLE = 0.02
"""Probability that a lamp is elsewhere, from which on places are drawn."""

_FINER = 0.6
"""Part of a place's deviation that those drawn from it have."""

_LONGEST_S = 5.0
"""Longest time for which a lamp may have changed unseen [s]."""


class LampBeliefs:
    """Probabilities of the states of a playpen's lamps.

    Args:
        playpen: Playpen.
        planes: Twins of its robot.

    Attributes:
        state: State in which each lamp is believed (n_lamps,).
        sure: Probability that all of them are.
    """

    def __init__(self, playpen: Playpen, planes: Planes) -> None:
        self._told: Floats = np.array(planes.lamps.positions)
        places, spacing = _grid(playpen, max(_PLACES // len(self._told), _LEAST_PLACES))
        shape = len(self._told), _GRID + len(places) + _FINE
        self.state = np.full(shape[0], TOLD)
        self.sure = 1.0
        self._weights: Floats = np.zeros(shape)
        """Probability of each other state of one lamp."""
        self._places: Floats = np.repeat(self._told[:, None], shape[1], axis=1)
        self._places[:, _GRID:-_FINE, :2] = places
        self._spread: Floats = np.zeros(shape)
        self._spread[:, _GRID:-_FINE] = spacing / math.sqrt(12)
        self._rates: Floats = np.zeros(shape)
        self._rates[:, :_GRID] = np.exp([-ENDS, -GOES_OFF, -CORRECTED])
        for rates, place in zip(self._rates[:, _GRID:-_FINE], self._told, strict=True):
            away = _away(places, place)
            near = np.exp(-np.square(away / MOVED_BY) / 2)
            shares = (near / max(near.sum(), _NEVER) + 1 / len(places)) / 2
            rates[:] = math.exp(-MOVES) * (away > _NEAR) * shares

    @property
    def probabilities(self) -> tuple[Floats, Floats]:
        """Probabilities that each lamp alone, or any, is as told, off or elsewhere (n_lamps, 3)."""
        alone = np.add.reduceat(self._weights, [TOLD, OFF, MOVED], axis=1)
        lamps = np.arange(len(alone))
        every = alone.copy()
        every[lamps, self.state] += np.maximum(1 - alone.sum(axis=1), 0)
        return alone, every

    def light(self, planes: Planes, model: LightModel) -> tuple[Floats, Floats]:
        """Return the light of all lamps, with its slope (2, n, 8, m + 1), and its variance (n, 8, m + 1).

        Each of the first m is with another state of one lamp, of whose place the variance is; the last is as
        believed.
        """
        used = (self._weights > 0) | (self._rates > 0)
        used[:, :_GRID] = False
        used[:, MOVED] = self.state == MOVED
        lamps, states = np.nonzero(used)
        places, powers = self._places[lamps, states], planes.powers[lamps]
        found = np.zeros((2, len(planes), 8, *used.shape))
        for light, turns in zip(found, model.turns, strict=True):
            light[..., TOLD] = planes.lamplight(_LEAST, turns)
            light[:, :, lamps, states] = planes.lamplight_from(places, powers, _LEAST, turns)
        each = model.light(*found)
        own = each[..., np.arange(len(self.state)), self.state]
        whole = own.sum(axis=3)
        away = np.square(self._places - (*planes.poses[:, :2].mean(axis=0), 0)).sum(axis=2)
        vague = np.square(_FALLING * self._spread) / away * np.square(each[0])
        others = (whole[..., None, None] - own[..., None] + each).reshape(*whole.shape, -1)
        every = np.concatenate([others, whole[..., None]], axis=3)
        return every, np.pad(vague.reshape(*whole.shape[1:], -1), ((0, 0), (0, 0), (0, 1)))

    def take(self, passed_s: float, told: Floats) -> None:
        """Take likelihoods of the m other states and of what is believed, a time after the last ones [s]."""
        self._mix(min(passed_s, _LONGEST_S))
        self.sure *= float(told[-1])
        self._weights *= told[:-1].reshape(self._weights.shape)
        norm = self.sure + float(self._weights.sum())
        self.sure /= norm
        self._weights /= norm
        self._draw()

    def believe(self, lamp: int, state: int) -> None:
        """Believe a lamp in a state from now on: as told, off, or where it probably is."""
        self._rates[lamp, -_FINE:] = 0
        if state == MOVED:
            weights, places = self._weights[lamp, _GRID:], self._places[lamp, _GRID:, :2]
            weights = weights / weights.sum()
            place = weights @ places
            apart = np.square(places - place).sum(axis=1) / 2 + self._spread[lamp, _GRID:] ** 2
            spread = math.sqrt(float(weights @ apart))
            self._places[lamp, MOVED, :2], self._spread[lamp, MOVED] = place, spread
            self._places[lamp, -_FINE:, :2] = place + max(2 * spread, _NEARBY) * _OFFSETS
            self._spread[lamp, -_FINE:] = max(spread / 2, _FINEST)
            self._rates[lamp, -_FINE:] = math.exp(-CORRECTED) / _FINE
        self.state[lamp] = state
        self._weights[:] = 0
        self.sure = 1.0

    def _mix(self, passed_s: float) -> None:
        """Let lamps change with the time that has passed [s]."""
        lamps = np.arange(len(self.state))
        own = self._weights.sum(axis=1)
        rates = self._rates.copy()
        back = rates[lamps, self.state]
        rates[:, MOVED] = rates[lamps, self.state] = 0
        leaving = rates.sum(axis=1)
        self._weights *= np.exp(-(leaving + back) * passed_s)[:, None]
        self._weights += (self.sure + own)[:, None] * rates * passed_s
        self.sure *= math.exp(-float(leaving.sum()) * passed_s)
        self.sure += float(own @ back) * passed_s

    def _draw(self) -> None:
        """Draw places from those of lamps that are probably elsewhere, where few count."""
        for lamp, weights in enumerate(self._weights[:, _GRID:]):
            whole = float(weights.sum())
            if whole < _PROBABLE or whole * whole > _FINE / 2 * float(weights @ weights):
                continue
            rows = _GRID + drawn(weights, _FINE, 0.5)
            spread = self._spread[lamp, rows]
            finer = np.maximum(spread * _FINER, _FINEST)
            moved = np.sqrt(np.maximum(spread**2 - finer**2, (_FINEST / 2) ** 2))
            places = self._places[lamp, rows, :2] + moved[:, None] * _OFFSETS
            self._places[lamp, -_FINE:, :2], self._spread[lamp, -_FINE:] = places, finer
            apart = _away(places, self._told[lamp]) > _NEAR
            weights[:] = 0
            weights[-_FINE:] = apart * whole / _FINE


def _away(places: Floats, place: Floats) -> Floats:
    """Return the distances of places (n, 2) from another [m]."""
    off = places - place[:2]
    return np.hypot(off[:, 0], off[:, 1])


def offsets(count: int) -> Floats:
    """Return offsets in a plane that are about normally distributed, also any few in a row (count, 2)."""
    radii = np.sqrt(-2 * np.log((np.arange(count) * 0.618034 + 0.31) % 1))
    turns = np.arange(count) * 2.4
    found = np.stack([radii * np.cos(turns), radii * np.sin(turns)], axis=1)
    return (found - found.mean(axis=0)) / found.std(axis=0)


_OFFSETS = offsets(_FINE)


def _grid(playpen: Playpen, count: int) -> tuple[Floats, float]:
    """Return about so many places on a grid within the arena (n, 2), and their distance [m]."""
    corners = np.array(playpen.arena.corners) * 1e-3
    low: Floats = corners.min(axis=0)
    size: Floats = corners.max(axis=0) - low
    spacing = math.sqrt(float(size.prod()) / count)
    columns, rows = np.ceil(size / spacing).astype(int).tolist()
    parts = [((i + 0.5) / columns, (j + 0.5) / rows) for i in range(columns) for j in range(rows)]
    places: Floats = low + np.array(parts) * size
    return places[inside(corners, places)], spacing
