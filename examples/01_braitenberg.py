"""A Braitenberg vehicle with pyserial alone, for a robot, a served twin or khep://.

python examples/01_braitenberg.py /dev/ttyUSB0        a robot
python examples/01_braitenberg.py khep://obstacles    a twin in this process
"""

import sys

import serial

url = sys.argv[1] if len(sys.argv) > 1 else "khep://obstacles"
if url.startswith("khep://"):
    import khep_twin  # noqa: F401  (registers khep:// with pyserial)

WEIGHTS = [(4, -5), (4, -15), (6, -18), (-18, 6), (-15, 4), (-5, 4), (5, 3), (3, 5)]

port = serial.serial_for_url(url, baudrate=9600, stopbits=2, timeout=1)
cycles = int(sys.argv[2]) if len(sys.argv) > 2 else 1000
for _ in range(cycles):
    port.write(b"N\n")
    proximity = [int(count) for count in port.readline().split(b",")[1:]]
    left = sum(w * count for (w, _), count in zip(WEIGHTS, proximity, strict=True)) / 400 + 10
    right = sum(w * count for (_, w), count in zip(WEIGHTS, proximity, strict=True)) / 400 + 10
    port.write(b"D,%d,%d\n" % (round(left), round(right)))
    port.readline()
port.write(b"D,0,0\n")
port.readline()
port.close()
