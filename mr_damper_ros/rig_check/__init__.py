"""Check of the signals of a rig."""
