"""Functions of the Khepera Toolbox for Matlab, for programs ported from it.

    from khep_twin.toolbox import *

    btmap1 = open_default()
    while True:
        sim_sms(2, 1, 1)
        a = sim_rps(2)
        if any(a > 900):
            sim_sms(2, -1, 1)
        kheprom(btmap1)

Without `sim_` and without the lines that use `btmap1` it is a program for a robot.
`khep_twin.toolbox.serial_commands` has the commands alone, without the simulator. docs/toolbox.md lists the
state of each function and window of the toolbox.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.toolbox.figures import datameta as datameta
    from khep_twin.toolbox.figures import dataprnt as dataprnt
    from khep_twin.toolbox.figures import ddl as ddl
    from khep_twin.toolbox.figures import ddlg as ddlg
    from khep_twin.toolbox.figures import ddr as ddr
    from khep_twin.toolbox.figures import ddrg as ddrg
    from khep_twin.toolbox.figures import disonel as disonel
    from khep_twin.toolbox.lamps import lamp_control as lamp_control
    from khep_twin.toolbox.lamps import move_lamp as move_lamp
    from khep_twin.toolbox.lamps import place_lamp as place_lamp
    from khep_twin.toolbox.lamps import remove_lamp as remove_lamp
    from khep_twin.toolbox.places import checkobj as checkobj
    from khep_twin.toolbox.places import cvrtang as cvrtang
    from khep_twin.toolbox.places import movekhep as movekhep
    from khep_twin.toolbox.places import putkhep as putkhep
    from khep_twin.toolbox.places import rotkhep as rotkhep
    from khep_twin.toolbox.roborunner import getstat as getstat
    from khep_twin.toolbox.roborunner import play_pen as play_pen
    from khep_twin.toolbox.roborunner import plotrun as plotrun
    from khep_twin.toolbox.roborunner import roborun2 as roborun2
    from khep_twin.toolbox.roborunner import template as template
    from khep_twin.toolbox.roborunner import user1 as user1
    from khep_twin.toolbox.robot_view import khepbase as khepbase
    from khep_twin.toolbox.sense import lasttest as lasttest
    from khep_twin.toolbox.sense import simsense as simsense
    from khep_twin.toolbox.sense import tstsense as tstsense
    from khep_twin.toolbox.serial_commands import cls as cls
    from khep_twin.toolbox.serial_commands import con as con
    from khep_twin.toolbox.serial_commands import cpid as cpid
    from khep_twin.toolbox.serial_commands import cspc as cspc
    from khep_twin.toolbox.serial_commands import kturret as kturret
    from khep_twin.toolbox.serial_commands import ports as ports
    from khep_twin.toolbox.serial_commands import rad as rad
    from khep_twin.toolbox.serial_commands import rls as rls
    from khep_twin.toolbox.serial_commands import rmc as rmc
    from khep_twin.toolbox.serial_commands import rms as rms
    from khep_twin.toolbox.serial_commands import robot_at as robot_at
    from khep_twin.toolbox.serial_commands import rpc as rpc
    from khep_twin.toolbox.serial_commands import rps as rps
    from khep_twin.toolbox.serial_commands import skp as skp
    from khep_twin.toolbox.serial_commands import sms as sms
    from khep_twin.toolbox.serial_commands import spc as spc
    from khep_twin.toolbox.simulator import close_playpen as close_playpen
    from khep_twin.toolbox.simulator import kheprom as kheprom
    from khep_twin.toolbox.simulator import open_custom as open_custom
    from khep_twin.toolbox.simulator import open_default as open_default
    from khep_twin.toolbox.simulator import sim_rls as sim_rls
    from khep_twin.toolbox.simulator import sim_rmc as sim_rmc
    from khep_twin.toolbox.simulator import sim_rms as sim_rms
    from khep_twin.toolbox.simulator import sim_rpc as sim_rpc
    from khep_twin.toolbox.simulator import sim_rps as sim_rps
    from khep_twin.toolbox.simulator import sim_skp as sim_skp
    from khep_twin.toolbox.simulator import sim_sms as sim_sms
    from khep_twin.toolbox.simulator import sim_spc as sim_spc
    from khep_twin.toolbox.simulator import ulsv as ulsv
    from khep_twin.toolbox.simulator import upsv as upsv
    from khep_twin.toolbox.simulator import userdata as userdata
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__)
