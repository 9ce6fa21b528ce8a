"""The needle found, followed and believed, in both views."""
