"""Stand-ins for real robots: twins with hidden differences, and the hosts that drive them."""
