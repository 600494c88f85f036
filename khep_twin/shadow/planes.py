"""Planar twins of one robot, side by side: their bodies, and what their sensors see."""

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar.planar_world import PlanarForms
from khep_twin.randomness import stream
from khep_twin.sensing.buffers import as_records
from khep_twin.sensing.lamps import Lamps
from khep_twin.sensing.light import Bulb, Hidden
from khep_twin.shadow.planar_bodies import TICK_NS, PlanarBodies
from khep_twin.units import N_SENSORS

Floats = NDArray[np.float64]


class SensorLaw(NamedTuple):
    """Constants of the likelihood of all sensors' readings; see `sensor_model`.

    Attributes:
        threshold: Thresholds (8,) [counts].
        noise: Variances of the noise (8,) [counts^2].
        least: Variances below which no trait is taken for known (3,).
        limit: Highest reading [counts].
        quiet: Highest reading with nothing in reach [counts].
        full: Lowest reading that may be at the limit, which lamps lower [counts].
        model: Relative deviation of readings from the twin's.
        outliers: Part of the readings that the twins cannot explain.
    """

    threshold: Floats
    noise: Floats
    least: Floats
    limit: int
    quiet: float
    full: float
    model: float
    outliers: float


class Planes(PlanarBodies):
    """Planar twins of one robot, without noise.

    Args:
        setup: Playpen with the robot, prepared for the plane.
        count: Number of twins.

    Attributes:
        lamps: Lamps of the playpen.
        others: Whether other robots drive there, which the twins do not have.
    """

    def __init__(self, setup: EpisodeSetup, count: int) -> None:
        if setup.planar_scene is None:
            raise ValueError("the setup is not planar; expected EpisodeSetup(playpen, planar=True)")
        forms = PlanarForms(setup.scene_model, setup.planar_scene)
        forms.put(None)
        super().__init__(setup, forms, count)
        sensors = forms.robot_states()[0].sensors
        self._sensors: Any = as_records([sensors], sensors)
        self.lamps = Lamps(setup.playpen, partial(stream, 0, "lamps"))
        light = forms.light(self.lamps, setup.playpen.lighting)
        self._light = (
            as_records([light.law], light.law),
            as_records(light.bulbs, Bulb()),
            as_records(light.hidden, Hidden()),
        )
        self.others = False

    @property
    def lamps_are_unknown(self) -> bool:
        """True if nothing on the line tells which lamps are on."""
        return self.lamps.lit is not None

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

        Both are (n, 8) [counts, counts/rad], with the gains of the calibration. The sensors are turned to the
        left from their headings there (n, 8) [rad].
        """
        light, slope = np.zeros((2, len(self), N_SENSORS))
        self._code.illuminate(*self._scenes, self._sensors, turns, light, slope)
        return light, slope

    def explain(
        self,
        traits: Floats,
        covariances: Floats,
        law: SensorLaw,
        range_left: Floats,
        readings: NDArray[np.int64],
        use: NDArray[np.bool_],
        new: float,
    ) -> tuple[Floats, Floats, Floats]:
        """Return expected counts, their deviations and readings' probabilities (n, 8); learn the traits.

        Args:
            traits: Traits of the sensors (n, 8, 3), changed in place.
            covariances: Their covariances (n, 8, 3, 3), changed in place.
            law: Constants of all sensors.
            range_left: Part of each sensor's range that the lamps leave (n, 8).
            readings: Proximity (8,) [counts].
            use: Sensors that may be learned from (8,).
            new: Part of the readings that is new.
        """
        light, slope = self.illuminate(traits[:, :, 1])
        counts, deviations, chances = np.zeros((3, len(self), N_SENSORS))
        given = light, slope, range_left, readings, use, new
        self._code.explain(*given, law, traits, covariances, counts, deviations, chances)
        return counts, deviations, chances

    def lamplight(self, least: float, turns: Floats | float = 0.0) -> Floats:
        """Return the light of each lamp at each sensor, below the dark level (n, 8, n_lamps) [counts].

        It holds at the start of the last step; of lamps that shine in turns each may be the one that is on.
        What cannot reach `least` counts as 0 [counts]. The sensors are turned to the left from their headings
        (8,) [rad].
        """
        return self._lamplight(self._light, self.powers, least, turns)

    def lamplight_from(self, places: Floats, powers: Floats, least: float, turns: Floats | float) -> Floats:
        """Return the same of lamps of these powers (m,) [W] at places x, y, z (m, 3) [m]."""
        law, known, hidden = self._light
        bulbs = np.zeros(len(places), known.dtype)
        bulbs["x"], bulbs["y"], bulbs["z"] = places.T
        law = law.copy()
        law["known"] = False  # Nothing is known of what may hide them.
        return self._lamplight((law, bulbs, hidden), powers, least, turns)

    @property
    def powers(self) -> Floats:
        """Powers of the lamps; of those that shine in turns as if each were the one that is on (m,) [W]."""
        time_ns, lamps = self.ticks * TICK_NS, self.lamps
        if not (self.lamps_are_unknown or lamps.steady):
            lamps.update(time_ns, ())
        return np.array(lamps.possible_powers(time_ns) if self.lamps_are_unknown else lamps.powers)

    def _lamplight(
        self, light: tuple[Any, Any, Any], powers: Floats, least: float, turns: Floats | float
    ) -> Floats:
        found = np.zeros((len(self), N_SENSORS, len(powers)))
        sensors = self._sensors
        if np.any(turns):
            sensors = sensors.copy()
            ambient = sensors["ambient"]
            axes = (ambient["ahead"] + 1j * ambient["left"]) * np.exp(1j * np.asarray(turns))
            ambient["ahead"], ambient["left"] = axes.real, axes.imag
        if powers.any():
            self._code.lamplight(*self._scenes, sensors, *light, powers, least, found)
        return found
