"""Analysis of bags: rerun, report, and the figures of a run."""
