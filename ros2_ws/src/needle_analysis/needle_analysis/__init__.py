"""What a bag tells: rerun, report, and the figures of a run."""
