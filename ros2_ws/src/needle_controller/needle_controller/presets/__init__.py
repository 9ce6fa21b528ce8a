"""The controllers a rig can be run with: an estimator and a law for each preset."""
