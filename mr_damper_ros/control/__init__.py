"""Inverse force laws, force control, semi-active controllers, export."""
