"""Thresholds of the diagnosis, in one place; those without a source were chosen on stand-in robots.

`python -m studies twin-trials` prints the rates of detected faults and false alarms with these thresholds, on
robots, hosts and seeds that were not used to choose them.
"""

import math
from dataclasses import dataclass

from khep_twin.clock import NS_PER_S


@dataclass(frozen=True, slots=True)
class Thresholds:
    """Thresholds of a diagnosis; `pose_watch` defines surprisal and its sum.

    Attributes:
        known_place: Standard deviation of a known position of a robot of a Khepera's size [m] (assumed).
        known_turn: Standard deviation of a known heading [rad] (assumed).
        lamp_place: Largest standard deviation of a position for which lamps are compared [m] (assumed).
        lamp_turn: Largest standard deviation of a heading for which lamps are compared [rad] (assumed).
        usual_surprisal: Surprisal of one reading that is not counted (assumed).
        surprisal_s: Time constant of the decay of summed surprisal [s].
        unsure_above: Sum of one sensor above which a pose is unsure.
        search_above: Sum of one sensor from which a search starts.
        max_search_above: Largest value of `search_above` after searches without a result.
        raise_factor: Factor by which a search without a result raises `search_above`.
        raise_decay_s: Time constant with which `search_above` decays again [s].
        calm_below: Sum of any sensor below which replies are as expected, or a tenth of a later sum.
        search_delay_ns: Time after the onset of unexpected replies before the search [ns].
        max_search_interval_ns: Longest interval of searches while replies are unexpected [ns].
        explained_below: Probability of no change below which changes explain the replies.
        window_ns: Time before the present within which a change may have happened [ns].
        drop_above: Probability of no change above which changes are dropped.
        drop_delay_ns: Least time after a search before changes are dropped [ns].
        relocated_ns: Time of a known pose, without lasting surprisal, after which a search has found it [ns].
        proven_ns: Time after a search has found the pose before which faults are not considered [ns].
        start_proven_ns: The same time after a start at a known pose [ns].
        suspect_above: Probability above which a fault is suspected (assumed), before the next factor.
        suspicion_factor: Factor of a suspicion's probability, for causes that are not considered: of 180
            suspicions with 80 % or more before it, 122 were right (faults, seeds 930 to 959).
        certain_above: Probability of an ambiguity group above which it has an alarm.
        max_sureness: Highest probability that an alarm states.
        name_above: Share of the group's probability from which the alarm names one fault.
        min_replies: Least number of replies before a decision, however long they take.
        alarm_delay_ns: Time for which replies show a fault before an alarm, or are unexpected while a pose
            counts as known [ns].
        hold_ns: Time for which a group is certain before an alarm, and before a pose changes its state [ns].
        name_delay_ns: Time after which an alarm has all names, if no fault has that share [ns].
        settle_delay_ns: Time after an alarm after which the fault is settled, and others may start [ns].
    """

    known_place: float = 0.025
    known_turn: float = math.radians(10)
    lamp_place: float = 0.012
    lamp_turn: float = math.radians(4)
    usual_surprisal: float = 0.15
    surprisal_s: float = 0.7
    unsure_above: float = 3.0
    search_above: float = 2.0
    max_search_above: float = 8.0
    raise_factor: float = 2.0
    raise_decay_s: float = 10.0
    calm_below: float = 0.3
    search_delay_ns: int = 200_000_000
    max_search_interval_ns: int = 2 * NS_PER_S
    explained_below: float = 0.5
    window_ns: int = 6 * NS_PER_S
    drop_above: float = 0.9
    drop_delay_ns: int = 1_500_000_000
    relocated_ns: int = 5 * NS_PER_S
    proven_ns: int = 15 * NS_PER_S
    start_proven_ns: int = 4 * NS_PER_S
    suspect_above: float = 0.2
    suspicion_factor: float = 0.7
    certain_above: float = 0.95
    max_sureness: float = 0.999
    name_above: float = 0.8
    min_replies: int = 3
    alarm_delay_ns: int = NS_PER_S
    hold_ns: int = 400_000_000
    name_delay_ns: int = 1_500_000_000
    settle_delay_ns: int = 5 * NS_PER_S


THRESHOLDS = Thresholds()
"""Thresholds of every shadow."""
