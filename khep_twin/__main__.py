"""`python -m khep_twin` is `khep-twin`."""

from khep_twin.cli import main

main()
