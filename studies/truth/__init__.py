"""Accuracy of the force laws on recordings and on a benchmark (``python -m studies truth``)."""
