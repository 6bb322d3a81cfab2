"""The control study: controllers side by side on emulated plants; see ``make control``."""
