"""The Khepera IV: microcontroller, motors, sensors and battery, and the programs that are compiled for it.

Sources, as cited in this package:
    manual      Khepera IV User Manual 3.0, K-Team, 2015
    library     libkhepera 2.1, K-Team, as published
    recording   step responses of a real robot, published with the course TP_CN (github.com/melurne)
    assumed     no source
"""
