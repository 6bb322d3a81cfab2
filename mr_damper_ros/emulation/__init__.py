"""An emulated rig: motions, dampers, plants, and faults."""
