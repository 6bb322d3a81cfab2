"""An emulated test rig: motions, dampers, plants and faults."""
