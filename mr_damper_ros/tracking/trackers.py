"""The trackers by name: a new one is one file and one line here."""

from __future__ import annotations

from mr_damper_ros.tracking.scale_tracker import EachWindow, ScaleTracker
from mr_damper_ros.tracking.unscented_tracker import UnscentedTracker

TRACKERS: dict[str, ScaleTracker] = {
    tracker.name: tracker for tracker in (EachWindow(), UnscentedTracker())
}
"""How the scales are followed."""
