"""Models of robots: the contract that all packages ask, the registry, and a folder for each family."""
