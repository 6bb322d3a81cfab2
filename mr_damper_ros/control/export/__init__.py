"""An identified set as code for other machines: C, an FMU, M-code."""
