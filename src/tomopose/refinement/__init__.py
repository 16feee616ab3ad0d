"""Refinement: the scan's own images correct the geometry of each view."""
