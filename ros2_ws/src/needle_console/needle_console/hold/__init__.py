"""Hold to run over a WebSocket of its own."""
