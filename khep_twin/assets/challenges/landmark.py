"""Turns until an object with several dark stripes is in the line image, and drives to it."""

from itertools import groupby

from khep_twin import Vision

DARK = 100  # grey value: a white wall has about 180, a black stripe 10
GAP = 14  # largest distance between two dark stripes of the same object [pixels]
NEAR = 38  # distance between its outer stripes at the end [pixels]
MIDDLE_PIXEL = 31.5  # pixel straight ahead

side = -1


def striped(image):
    """Return the middle and the width of the widest striped object in an image [pixels]; None without one."""
    stripes = [[*run] for dark, run in groupby(range(64), lambda pixel: image[pixel] < DARK) if dark]
    groups = []
    for stripe in stripes:
        if groups and stripe[0] - groups[-1][-1][-1] <= GAP:
            groups[-1].append(stripe)
        else:
            groups.append([stripe])
    ends = [(group[0][0], group[-1][-1]) for group in groups if len(group) > 1]
    if not ends:
        return None
    left, right = max(ends, key=lambda end: end[1] - end[0])
    return (left + right) / 2, right - left


def controller(robot):
    global side
    landmark = striped(Vision(robot).image())
    if landmark is None:
        robot.set_speed(2 * side, -2 * side)  # towards its last known side
        return
    middle, width = landmark
    side = 1 if middle > MIDDLE_PIXEL else -1
    if width >= NEAR:
        robot.set_speed(0, 0)
    else:
        forward, turn = (8, 0) if abs(middle - MIDDLE_PIXEL) < 12 else (4, side)
        robot.set_speed(forward + turn, forward - turn)
