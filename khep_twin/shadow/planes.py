"""Many planar twins of one robot: their bodies, and the light at their sensors."""

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar.planar_world import PlanarForms
from khep_twin.randomness import stream
from khep_twin.sensing.buffers import as_records
from khep_twin.sensing.lamps import Lamps
from khep_twin.sensing.light import Bulb, HiddenSector
from khep_twin.shadow.planar_bodies import TICK_NS, Booleans, Floats, PlanarBodies

REACH = 1.5
"""Reach of the twins' sensors, as a multiple of the calibration's (assumed): that of a robot with a ratio of
gain to threshold that is larger by 2.9 standard deviations."""


class SensorLaw(NamedTuple):
    """Constants of the likelihood of all sensors' readings; see `sensor_model`.

    Attributes:
        threshold: Thresholds (s,) [counts].
        noise: Variances of the noise (s,) [counts^2].
        min_variances: Least variances of the traits (3,).
        limit: Highest reading [counts].
        quiet: Highest reading with nothing in reach [counts].
        full: Lowest reading that may be clipped at the limit, which lamps lower [counts].
        model_deviation: Relative standard deviation of readings from the twin's.
        outliers: Part of the readings that are outliers.
    """

    threshold: Floats
    noise: Floats
    min_variances: Floats
    limit: int
    quiet: float
    full: float
    model_deviation: float
    outliers: float


class Twins(PlanarBodies):
    """Planar twins of one robot, without noise.

    Args:
        setup: Playpen with the robot, prepared for the plane.
        count: Number of twins.

    Attributes:
        n_sensors: Number of infrared sensors around the robot, s in the shapes of arrays.
        lamps: Lamps of the playpen.
        has_other_robots: Whether other robots, which the twins lack, drive in the playpen.
    """

    def __init__(self, setup: EpisodeSetup, count: int) -> None:
        if setup.planar_scene is None:
            raise ValueError("the setup is not planar; expected EpisodeSetup(playpen, planar=True)")
        forms = PlanarForms(setup.scene_model, setup.planar_scene)
        forms.place_robot(None)
        super().__init__(setup, forms, count)
        self.n_sensors = len(setup.entry.body.sensor_positions)
        sensors = forms.robot_states()[0].sensors
        self._sensors: Any = as_records([sensors], sensors)
        self._sensors["proximity"]["reach"] *= REACH
        self.robots["sensor_range"] *= REACH
        self.lamps = Lamps(setup.playpen, partial(stream, 0, "lamps"))
        light = forms.light(self.lamps, setup.playpen.lighting)
        self._light = (
            as_records([light.law], light.law),
            as_records(light.bulbs, Bulb()),
            as_records(light.sectors, HiddenSector()),
        )
        self.has_other_robots = False

    @property
    def lamps_are_unknown(self) -> bool:
        """True if the line does not show which lamps are on."""
        return self.lamps.lit_index is not None

    @property
    def ambient(self) -> Any:
        """Record of `robot_sensors.Ambient`, which all twins share."""
        return self._sensors[0]["ambient"]

    @property
    def proximity(self) -> Any:
        """Record of `robot_sensors.Proximity`, which all twins share."""
        return self._sensors[0]["proximity"]

    def illuminate(self, turns: Floats) -> tuple[Floats, Floats]:
        """Return the light at each sensor at the start of the last step, and its slope as the sensor turns.

        Both are (n, s) [counts, counts/rad], with the gains of the calibration. The sensors are turned to the
        left from their headings there (n, s) [rad].
        """
        light, slope = np.zeros((2, len(self), self.n_sensors))
        self._compiled.illuminate(*self._scene_arrays, self._sensors, turns, light, slope)
        return light, slope

    def observe(
        self,
        traits: Floats,
        covariances: Floats,
        law: SensorLaw,
        usable_range: Floats,
        readings: NDArray[np.int64],
        is_used: Booleans,
        novelty: float,
    ) -> tuple[Floats, Floats, Floats]:
        """Return expected counts, their deviations and the likelihoods of readings (n, s); update the traits.

        Args:
            traits: Traits of the sensors (n, s, 3), changed in place.
            covariances: Their covariances (n, s, 3, 3), changed in place.
            law: Constants of all sensors.
            usable_range: Part of each sensor's range that the lamps leave (n, s).
            readings: Proximity (s,) [counts].
            is_used: Whether to update the traits of each sensor (s,).
            novelty: Novelty of the readings.
        """
        light, slope = self.illuminate(traits[:, :, 1])
        counts, deviations, likelihoods = np.zeros((3, len(self), self.n_sensors))
        inputs = light, slope, usable_range, readings, is_used, novelty
        self._compiled.observe(*inputs, law, traits, covariances, counts, deviations, likelihoods)
        return counts, deviations, likelihoods

    def lamplight(self, min_count: float, turns: Floats | float = 0.0) -> Floats:
        """Return the light of each lamp at each sensor, below the dark level (n, s, n_lamps) [counts].

        It holds at the start of the last step; of alternating lamps, each may be the one that is on. Light
        that cannot reach `min_count` [counts] is 0. Sensors are turned left from their headings (s,) [rad].
        """
        return self._lamplight(self._light, self.powers, min_count, turns)

    def lamplight_from(self, places: Floats, powers: Floats, min_count: float, turns: Floats) -> Floats:
        """Return what `lamplight` does, for lamps of these powers (m,) [W] at places x, y, z (m, 3) [m]."""
        law, known_bulbs, hidden = self._light
        bulbs = np.zeros(len(places), known_bulbs.dtype)
        bulbs["x"], bulbs["y"], bulbs["z"] = places.T
        law = law.copy()
        law["is_static"] = False  # Any obstacle may hide them.
        return self._lamplight((law, bulbs, hidden), powers, min_count, turns)

    @property
    def powers(self) -> Floats:
        """Powers of the lamps (m,) [W]; of alternating ones as if each were on."""
        time_ns, lamps = self.ticks * TICK_NS, self.lamps
        if not (self.lamps_are_unknown or lamps.are_constant):
            lamps.update(time_ns, ())
        return np.array(lamps.possible_powers(time_ns) if self.lamps_are_unknown else lamps.powers)

    def _lamplight(
        self, light: tuple[Any, Any, Any], powers: Floats, min_count: float, turns: Floats | float
    ) -> Floats:
        lamplight = np.zeros((len(self), self.n_sensors, len(powers)))
        sensors = self._sensors
        if np.any(turns):
            sensors = sensors.copy()
            ambient = sensors["ambient"]
            axes = (ambient["cosine"] + 1j * ambient["sine"]) * np.exp(1j * np.asarray(turns))
            ambient["cosine"], ambient["sine"] = axes.real, axes.imag
        if powers.any():
            self._compiled.lamplight(*self._scene_arrays, sensors, *light, powers, min_count, lamplight)
        return lamplight
