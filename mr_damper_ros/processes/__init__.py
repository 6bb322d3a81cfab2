"""Other processes and threads: the supervised worker, the pool, the background writer."""
