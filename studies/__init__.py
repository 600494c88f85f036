"""Studies made with the product: fits, fidelity, behaviour, twin trials; each prints what a page shows."""
