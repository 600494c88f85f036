"""Episodes in a plane on an NVIDIA card, one thread for each (extras `cuda12` and `cuda13`)."""
