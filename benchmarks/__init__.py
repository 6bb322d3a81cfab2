"""Figures of the identification against stated bars: ``make bench``."""
