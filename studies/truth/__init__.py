"""What the force laws are worth on recordings and a benchmark (``python -m studies truth``)."""
