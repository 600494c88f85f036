"""`python -m khep_twin` is `khep-twin`."""

import signal


def main() -> None:
    """Runs the command line."""
    # Until the commands are there, which takes a moment, Ctrl-C ends the process without a trace.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    from khep_twin.cli.streams import check_descriptors, guard

    guard()
    check_descriptors()
    from khep_twin.cli.app import main as run

    run()


if __name__ == "__main__":
    main()
