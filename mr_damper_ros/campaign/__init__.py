"""Campaigns: runs of a test machine are chosen, made and identified until the force is known."""
