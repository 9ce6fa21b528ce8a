"""Filter over time: candidate tips in, the accepted tip out."""
