"""The damper that changes: followed window by window, judged, predicted, kept on disk."""
