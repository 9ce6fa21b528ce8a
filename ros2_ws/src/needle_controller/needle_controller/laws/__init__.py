"""From an estimate to the rotation of the next step."""
