"""Studies made with the product: fits, fidelity, behaviour, twin trials. Each prints tables of a page."""
