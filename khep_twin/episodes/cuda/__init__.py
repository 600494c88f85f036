"""Episodes in a plane on an NVIDIA GPU, one thread per episode (extras `cuda12` and `cuda13`)."""
