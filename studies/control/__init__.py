"""Comparison of controllers of the damper on emulated plants (``python -m studies control``)."""
