"""Processes and threads: the supervised worker, the process pool, the background writer."""
