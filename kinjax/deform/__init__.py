"""Deformation of motion to prioritized constraints (Le Callennec and Boulic 2004)."""
