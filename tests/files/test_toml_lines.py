"""Line numbers of tables and keys in a TOML file."""

import pytest

from khep_twin.errors import Location
from khep_twin.files.toml_lines import LineNumbers

TEXT = """# a comment = 3
name = "p"   # [not.a.table]
text = '''
[block]
x = 1
'''
list = [
  1, # ]
  [2, "]"],
]
[arena]
width = 3
"quoted key" = 4
dotted.key = 5
[[block]]
x = 1
points = [[1, 2],
          [3, 4]]
[[block]]
  y = 2
[[block.part]]
z = 1
[surfaces.card]
rgb = [1]
lamp = [{x = 1}]
"""


@pytest.mark.parametrize(
    ("location", "line"),
    [
        (("name",), 2),
        (("text",), 3),
        (("list", 1), 7),
        (("arena",), 11),
        (("arena", "width"), 12),
        (("arena", "quoted key"), 13),
        (("arena", "dotted", "key"), 14),
        (("arena", "missing"), 11),
        (("block", 0), 15),
        (("block", 0, "x"), 16),
        (("block", 0, "points", 1, 0), 17),
        (("block", 1, "y"), 20),
        (("block", 1, "part", 0, "z"), 22),
        (("surfaces", "card", "rgb", 0), 24),
        (("surfaces", "card", "lamp", 0, "x"), 25),
        (("nowhere",), None),
        ((), None),
    ],
)
def test_each_location_has_its_line(location: Location, line: int | None) -> None:
    assert LineNumbers(TEXT).find(location) == line
