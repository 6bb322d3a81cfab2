"""Fits of windows and of many runs, with errors, observability and the design of experiments."""
