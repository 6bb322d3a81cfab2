"""The rig: sources of samples, data acquisition, supplies, and commands."""
