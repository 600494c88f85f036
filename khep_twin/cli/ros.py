"""`khep-twin ros`: robots and twins as nodes of ROS 2."""

from typing import Annotated

import typer

from khep_twin.cli.completion import ports as complete_ports
from khep_twin.cli.option_groups import with_help
from khep_twin.cli.options import notify, usage
from khep_twin.cli.serve import speed_factor
from khep_twin.process.signals import stopping


@with_help
def ros(
    ports: Annotated[
        list[str],
        typer.Argument(
            help="Ports of robots or twins, such as /dev/ttyUSB0 or khep://obstacles.",
            autocompletion=complete_ports,
        ),
    ],
    *,
    router: Annotated[str | None, typer.Option(metavar="HOST:PORT")] = None,
    be_router: bool = False,
    peer: bool = False,
    domain: Annotated[int | None, typer.Option(min=0, max=232)] = None,
    namespace: list[str] | None = None,
    rate: Annotated[float, typer.Option(min=0.1, max=200)] = 20.0,
    timeout: Annotated[float, typer.Option(min=0.05)] = 0.5,
    speed: str = "1",
    paused: bool = False,
) -> None:
    """Show robots and twins as nodes of ROS 2.

    They publish readings as standard messages, and drive by velocity commands. The nodes join the network of
    RMW_IMPLEMENTATION=rmw_zenoh_cpp; no installation of ROS is needed here.

    A robot stops without commands, at errors and at the end. Standard output has one line per node.

    Args:
        router: Router of the Zenoh network; by default localhost:7447, that of ROS.
        be_router: Be the router, at 127.0.0.1:7447 or at the address of --router.
        peer: Join like a node of ROS, which starts without a router, and listens on the loopback interface.
        domain: Domain of ROS; by default ROS_DOMAIN_ID, or 0.
        namespace: Name of a node, and namespace of its topics; repeatable, for each port. By default
            khepera0, khepera1 and so on.
        rate: Cycles per second, if the robot's line is fast enough.
        timeout: Time without a velocity command after which a robot stops [s].
        speed: Simulated seconds per real second of twins at khep://: a number, or max.
        paused: Let time at khep:// pass in steps of one cycle only, by the service step.
    """
    from khep_twin.robots.model import robot_name
    from khep_twin.ros.fleet import Fleet, NodeSettings
    from khep_twin.ros.graph import Graph
    from khep_twin.ros.session import SessionMode
    from khep_twin.ros.wire import NodeName

    names = [str(NodeName.of(name)) for name in namespace or map(robot_name, range(len(ports)))]
    if len(names) != len(ports) or len({*names}) < len(names):
        text = f"--namespace: {', '.join(names)} for {len(ports)} ports"
        raise usage(f"{text}; expected another one for each port, or none")
    if be_router and peer:
        raise usage("--peer: has no effect with --be-router; expected one of them")
    if not any(port.startswith("khep://") for port in ports) and (paused or speed != "1"):
        raise usage(f"--{'paused' if paused else 'speed'} is for twins at khep://; expected such a port")
    if paused and speed != "1":
        raise usage("--speed: has no effect with --paused; expected one of them")
    settings = NodeSettings(rate, timeout, speed_factor(speed), paused)
    mode = SessionMode.ROUTER if be_router else SessionMode.PEER if peer else SessionMode.CLIENT
    with (
        stopping() as stop,
        Graph(router, domain, mode=mode, report=notify) as graph,
        Fleet(graph, ports, names, settings) as fleet,
    ):
        for title, port, node in zip(fleet.titles, ports, fleet.nodes, strict=True):
            typer.echo(f"{node.name}  {title} at {port}")
        n_failures = fleet.run(stop)
        is_stopped = stop()
    if n_failures or is_stopped:
        raise typer.Exit(1 if n_failures else 130)
