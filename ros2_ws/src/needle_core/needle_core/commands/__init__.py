"""Command lines: entry points, options, exit codes, one-line errors."""
