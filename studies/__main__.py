"""The studies: `python -m studies` lists them, `python -m studies NAME` runs one."""

import sys

from tools.command_table import run

STUDIES = {
    "fidelity": "fidelity",
    "behaviour": "behaviour",
    "infrared-fits": "infrared_fits",
    "khepera2-fits": "khepera2_fits",
    "khepera3-fits": "khepera3_fits",
    "public-programs": "public_programs",
    "khepera4-transfer": "khepera4_transfer",
    "infrared-picture": "infrared_picture",
    "lamp-fits": "lamp_fits",
    "lamp-picture": "lamp_picture",
    "noise-fits": "noise_fits",
    "fit-intervals": "fit_intervals",
    "half-scale": "half_scale",
    "home-test": "home_test",
    "umbmark": "umbmark",
    "screening": "screening",
    "transfer": "transfer",
    "line": "line",
    "twin-trials": "twin_trials",
    "relay-delays": "relay_delays",
    "shadow-fits": "shadow_fits",
}
"""Module of each name."""

if __name__ == "__main__":
    sys.exit(run("studies", STUDIES))
