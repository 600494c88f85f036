"""Simulation of the whole system under one seed: processes, terminals, sockets, disk and clock, with faults.

The product's code runs on it: the serving loops, the ports, the recorder and the host library of khep_twin,
and pyserial. Only the operating system below them is simulated.
"""
