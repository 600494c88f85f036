"""The Khepera IV: what is its own. So far what its programs see: device nodes, microcontroller and motors.

Sources, as cited in this package:
    manual      Khepera IV User Manual 3.0, K-Team, 2015
    library     libkhepera 2.1, K-Team, as published: what it reads and writes
    recording   step responses of a real robot, published with the course TP_CN (github.com/melurne)
    assumed     no source
"""
