"""Tracking of a changing damper: window fits, acceptance test, force prediction, saved state."""
