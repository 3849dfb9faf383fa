"""From camera frames to logs: sources of frames, segmentation, fits, tracks; and what the papers do for the same."""
