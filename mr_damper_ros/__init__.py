"""Identify a magnetorheological damper while it runs, and predict its force."""
