"""Page of the console."""
