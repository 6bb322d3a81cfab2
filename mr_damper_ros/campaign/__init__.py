"""Campaigns: plan, make and identify runs of a test machine until the force is known."""
