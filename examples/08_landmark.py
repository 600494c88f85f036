"""A robot that looks for a striped mast among plain ones with its vision turret K213, and drives to it.

python examples/08_landmark.py /dev/ttyUSB0      a robot with a K213
python examples/08_landmark.py khep://landmark   a twin in this process
"""

import sys
from collections.abc import Sequence
from itertools import groupby

from khep_twin import Khepera, Vision

DARK = 100  # greys: a white wall has some 180, a black stripe 10
GAP = 14  # pixels between two dark stripes of the same mast, at most
NEAR = 38  # pixels between its outer stripes at the end, some 15 cm before it
CENTRE = 31.5  # pixel straight ahead


def striped(image: Sequence[int]) -> tuple[float, int] | None:
    """Return the middle and the width of the widest striped mast in an image [pixels]; None without one."""
    stripes = [[*run] for dark, run in groupby(range(64), lambda pixel: image[pixel] < DARK) if dark]
    groups: list[list[list[int]]] = []
    for stripe in stripes:
        if groups and stripe[0] - groups[-1][-1][-1] <= GAP:
            groups[-1].append(stripe)
        else:
            groups.append([stripe])
    # A plain dark mast is a single stripe.
    ends = [(group[0][0], group[-1][-1]) for group in groups if len(group) > 1]
    if not ends:
        return None
    left, right = max(ends, key=lambda pair: pair[1] - pair[0])
    return (left + right) / 2, right - left


url = sys.argv[1] if len(sys.argv) > 1 else "khep://landmark"
with Khepera(url) as robot:
    vision = Vision(robot)
    start, images, side = robot.time, 0, -1
    while True:
        images += 1
        mast = striped(vision.image())
        if mast is None:
            robot.set_speed(side, -side)  # slowly, to where it was last: an image takes half a second
            continue
        middle, width = mast
        if width >= NEAR:
            break
        side = 1 if middle > CENTRE else -1
        forward, turn = (4, 0) if abs(middle - CENTRE) < 12 else (2, side)
        robot.set_speed(forward + turn, forward - turn)
    robot.set_speed(0, 0)
    print(f"before the striped mast after {robot.time - start:.0f} s and {images} images")
