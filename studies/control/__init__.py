"""Controllers of the damper side by side on emulated plants (``python -m studies control``)."""
