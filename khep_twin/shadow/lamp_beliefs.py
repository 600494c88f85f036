"""Beliefs about the lamps of a playpen: a Bayes filter with the states of each lamp.

    any state  -- exp(-9) 1/s --> off                  off, moved -- exp(-5) 1/s --> nominal
    any state  -- exp(-9.5) 1/s, all places --> moved  moved -- exp(-4) 1/s --> another place nearby

There is a hypothesis that all lamps are in the states believed now, and one for each other state of each
lamp. Replies to O weight them by likelihood. Places lie on a grid; where few are probable, finer ones follow.
"""

import math

import numpy as np

from khep_twin.playpen import Playpen
from khep_twin.shadow.light_model import LightModel
from khep_twin.shadow.particles import Floats, resample_indices
from khep_twin.shadow.planes import Twins
from khep_twin.shadow.start import are_inside

NOMINAL, OFF, MOVED = range(3)
"""States of a lamp: as in the playpen, off, or at the place that is believed."""

OFF_LOG_ODDS, MOVED_LOG_ODDS, END_LOG_ODDS, CORRECTION_LOG_ODDS = 9.0, 9.5, 5.0, 4.0
"""Logarithms of the odds in a second against a lamp that goes off, is moved, returns to nominal, and against
another place near that of a moved lamp (assumed)."""

MOVED_DISTANCE = 0.12
"""Standard deviation of half of the moves of lamps, along x and y [m] (assumed); the others end anywhere."""

_MIN_WEIGHT = 1e-9
"""Least sum of the weights of places near a lamp, for a lamp far outside the arena."""

_FIRST_PLACE = 3
"""First state that stands for a place."""

_N_GRID, _MIN_GRID = 96, 24
"""Places of the grid: for all lamps together, and least number for one (assumed)."""

_N_FINE = 32
"""Resampled places of each lamp."""

_SAME_PLACE = 0.05
"""Distance of a move that does not count [m]: poses are known no better."""

_MIN_SPREAD, _MIN_CORRECTION = 0.004, 0.01
"""Least standard deviations of a lamp's place and of its correction [m] (assumed)."""

_DISTANCE_POWER = 2.5
"""Approximate power of the distance by which light decreases."""

_MIN_LIGHT = 3.0
"""Light below which it is not computed [counts]."""

_RESAMPLED_ABOVE = 0.02
"""Probability of another place above which places are resampled."""

_SPREAD_FACTOR = 0.6
"""Factor of the standard deviation of resampled places."""

_MAX_INTERVAL_S = 5.0
"""Longest time for which transitions are counted [s]."""


class LampBeliefs:
    """Probabilities of the states of a playpen's lamps.

    Args:
        playpen: Playpen.
        twins: Twins of its robot.

    Attributes:
        state: State in which each lamp is believed (n_lamps,).
        probability: Probability that all of them are.
    """

    def __init__(self, playpen: Playpen, twins: Twins) -> None:
        self._nominal_places: Floats = np.array(twins.lamps.positions)
        places, spacing = _grid_places(playpen, max(_N_GRID // len(self._nominal_places), _MIN_GRID))
        shape = len(self._nominal_places), _FIRST_PLACE + len(places) + _N_FINE
        self.state = np.full(shape[0], NOMINAL)
        self.probability = 1.0
        self._weights: Floats = np.zeros(shape)
        """Probability that one lamp is in another state, by state (n_lamps, n_states)."""
        self._places: Floats = np.repeat(self._nominal_places[:, None], shape[1], axis=1)
        self._places[:, _FIRST_PLACE:-_N_FINE, :2] = places
        self._spread: Floats = np.zeros(shape)
        self._spread[:, _FIRST_PLACE:-_N_FINE] = spacing / math.sqrt(12)
        self._rates: Floats = np.zeros(shape)
        self._rates[:, :_FIRST_PLACE] = np.exp([-END_LOG_ODDS, -OFF_LOG_ODDS, -CORRECTION_LOG_ODDS])
        for rates, place in zip(self._rates[:, _FIRST_PLACE:-_N_FINE], self._nominal_places, strict=True):
            distances = _distances(places, place)
            weights = np.exp(-np.square(distances / MOVED_DISTANCE) / 2)
            shares = (weights / max(weights.sum(), _MIN_WEIGHT) + 1 / len(places)) / 2
            rates[:] = math.exp(-MOVED_LOG_ODDS) * (distances > _SAME_PLACE) * shares

    @property
    def probabilities(self) -> tuple[Floats, Floats]:
        """Probabilities that each lamp has changed to nominal, off or moved, and is so (n_lamps, 3)."""
        changed = np.add.reduceat(self._weights, [NOMINAL, OFF, MOVED], axis=1)
        lamps = np.arange(len(changed))
        marginal = changed.copy()
        marginal[lamps, self.state] += np.maximum(1 - changed.sum(axis=1), 0)
        return changed, marginal

    def light(self, twins: Twins, model: LightModel) -> tuple[Floats, Floats]:
        """Return the light of all lamps with its slope (2, n, s, m + 1), and its variance (n, s, m + 1).

        In each of the first m, one lamp is in another state with that variance; the last is as believed.
        """
        is_used = (self._weights > 0) | (self._rates > 0)
        is_used[:, :_FIRST_PLACE] = False
        is_used[:, MOVED] = self.state == MOVED
        lamps, states = np.nonzero(is_used)
        places, powers = self._places[lamps, states], twins.powers[lamps]
        lamplight = np.zeros((2, len(twins), twins.n_sensors, *is_used.shape))
        for light, turns in zip(lamplight, model.turns, strict=True):
            light[..., NOMINAL] = twins.lamplight(_MIN_LIGHT, turns)
            light[:, :, lamps, states] = twins.lamplight_from(places, powers, _MIN_LIGHT, turns)
        lamp_light = model.light(*lamplight)
        believed = lamp_light[..., np.arange(len(self.state)), self.state]
        total = believed.sum(axis=3)
        square_distances = np.square(self._places - (*twins.poses[:, :2].mean(axis=0), 0)).sum(axis=2)
        variance = np.square(_DISTANCE_POWER * self._spread) / square_distances * np.square(lamp_light[0])
        alternatives = (total[..., None, None] - believed[..., None] + lamp_light).reshape(*total.shape, -1)
        all_light = np.concatenate([alternatives, total[..., None]], axis=3)
        return all_light, np.pad(variance.reshape(*total.shape[1:], -1), ((0, 0), (0, 0), (0, 1)))

    def update(self, passed_s: float, likelihoods: Floats) -> None:
        """Update by the likelihoods of the m other states, then of the belief (m + 1,), after a time [s]."""
        self._predict(min(passed_s, _MAX_INTERVAL_S))
        self.probability *= float(likelihoods[-1])
        self._weights *= likelihoods[:-1].reshape(self._weights.shape)
        norm = self.probability + float(self._weights.sum())
        self.probability /= norm
        self._weights /= norm
        self._resample()

    def set_belief(self, lamp: int, state: int) -> None:
        """Set the believed state of a lamp: NOMINAL, OFF, or MOVED to the mean of its probable places."""
        self._rates[lamp, -_N_FINE:] = 0
        if state == MOVED:
            weights, places = self._weights[lamp, _FIRST_PLACE:], self._places[lamp, _FIRST_PLACE:, :2]
            weights = weights / weights.sum()
            place = weights @ places
            variances = np.square(places - place).sum(axis=1) / 2 + self._spread[lamp, _FIRST_PLACE:] ** 2
            spread = math.sqrt(float(weights @ variances))
            self._places[lamp, MOVED, :2], self._spread[lamp, MOVED] = place, spread
            self._places[lamp, -_N_FINE:, :2] = place + max(2 * spread, _MIN_CORRECTION) * _OFFSETS
            self._spread[lamp, -_N_FINE:] = max(spread / 2, _MIN_SPREAD)
            self._rates[lamp, -_N_FINE:] = math.exp(-CORRECTION_LOG_ODDS) / _N_FINE
        self.state[lamp] = state
        self._weights[:] = 0
        self.probability = 1.0

    def _predict(self, passed_s: float) -> None:
        """Apply the transitions of a time [s]."""
        lamps = np.arange(len(self.state))
        lamp_weights = self._weights.sum(axis=1)
        rates = self._rates.copy()
        return_rates = rates[lamps, self.state]
        rates[:, MOVED] = rates[lamps, self.state] = 0
        leave_rates = rates.sum(axis=1)
        self._weights *= np.exp(-(leave_rates + return_rates) * passed_s)[:, None]
        self._weights += (self.probability + lamp_weights)[:, None] * rates * passed_s
        self.probability *= math.exp(-float(leave_rates.sum()) * passed_s)
        self.probability += float(lamp_weights @ return_rates) * passed_s

    def _resample(self) -> None:
        """Resample the places of lamps that are probably moved, where few places count."""
        for lamp, weights in enumerate(self._weights[:, _FIRST_PLACE:]):
            total = float(weights.sum())
            if total < _RESAMPLED_ABOVE or total * total > _N_FINE / 2 * float(weights @ weights):
                continue
            rows = _FIRST_PLACE + resample_indices(weights, _N_FINE, 0.5)
            spread = self._spread[lamp, rows]
            finer_spread = np.maximum(spread * _SPREAD_FACTOR, _MIN_SPREAD)
            jitter = np.sqrt(np.maximum(spread**2 - finer_spread**2, (_MIN_SPREAD / 2) ** 2))
            places = self._places[lamp, rows, :2] + jitter[:, None] * _OFFSETS
            self._places[lamp, -_N_FINE:, :2], self._spread[lamp, -_N_FINE:] = places, finer_spread
            is_elsewhere = _distances(places, self._nominal_places[lamp]) > _SAME_PLACE
            weights[:] = 0
            weights[-_N_FINE:] = is_elsewhere * total / _N_FINE


def _distances(places: Floats, place: Floats) -> Floats:
    """Return the distances of places (n, 2) from another [m]."""
    return np.hypot(*(places - place[:2]).T)


def normal_offsets(count: int) -> Floats:
    """Return a low-discrepancy sequence of standard normal offsets x, y (count, 2)."""
    radii = np.sqrt(-2 * np.log((np.arange(count) * 0.618034 + 0.31) % 1))
    angles = np.arange(count) * 2.4
    points = np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1)
    return (points - points.mean(axis=0)) / points.std(axis=0)


_OFFSETS = normal_offsets(_N_FINE)


def _grid_places(playpen: Playpen, count: int) -> tuple[Floats, float]:
    """Return about this number of places on a grid within the arena (n, 2), and their distance [m]."""
    corners = np.array(playpen.arena.corners) * 1e-3
    low: Floats = corners.min(axis=0)
    size: Floats = corners.max(axis=0) - low
    spacing = math.sqrt(float(size.prod()) / count)
    columns, rows = np.ceil(size / spacing).astype(int).tolist()
    fractions = [((i + 0.5) / columns, (j + 0.5) / rows) for i in range(columns) for j in range(rows)]
    places: Floats = low + np.array(fractions) * size
    return places[are_inside(corners, places)], spacing
