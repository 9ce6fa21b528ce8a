"""Hold to run over a WebSocket."""
