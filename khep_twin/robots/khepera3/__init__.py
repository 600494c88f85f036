"""The Khepera III: a dsPIC with infrared and ultrasonic sensors, and two motor controllers, on one I2C bus.

Sources, as cited in this package:
    manual      Khepera III User Manual 3.5, K-Team, 2013
    library     libkorebot 1.16 with its programs khepera3_test and kh3server 1.0, as published
    toolbox     Khepera III Toolbox, 2006 to 2009, and its recordings of infrared sensors
    webots      model Khepera3 of Webots
    assumed     no source
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.robots.khepera3.host import Khepera3 as Khepera3
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__)
