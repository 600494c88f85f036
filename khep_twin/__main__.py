"""Entry point of `python -m khep_twin`, the same as `khep-twin`."""

import signal


def main() -> None:
    """Run the command line."""
    # Until the commands are imported, Ctrl-C ends the process without a traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    from khep_twin.cli.streams import check_descriptors, guard_streams
    from khep_twin.process.machine import name_glfw

    guard_streams()
    check_descriptors()
    name_glfw()
    from khep_twin.cli.app import main as run

    run()


if __name__ == "__main__":
    main()
