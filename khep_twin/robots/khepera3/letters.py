from khep_twin.robots.khepera3.model import KHEPERA_3
from khep_twin.robots.line_server import LineServer


class Letters(LineServer):
    program = "stub"

    def __init__(self, bus, vehicle, rom):
        super().__init__(KHEPERA_3.dialect, lambda r: b"$\n\r")
        self.powered_ = lambda: bus.dspic.is_powered

    def tick(self):
        pass
