"""What can go wrong in a rig: with the damper, with what is measured, with how it is sent."""
