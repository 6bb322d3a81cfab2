"""Fits of windows and runs, with standard errors, observability and experiment design."""
