"""Measured figures of the package and the bars that they must reach: ``make bench``."""
