"""Mutants: random one-line faults in the product, which its tests must see."""
