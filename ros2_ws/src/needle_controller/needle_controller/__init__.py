"""Steers a bevel-tip needle into a plane: tip positions to the rotation of each insertion step."""
