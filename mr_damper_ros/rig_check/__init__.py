"""The check of a rig: what is wrong with its signals."""
