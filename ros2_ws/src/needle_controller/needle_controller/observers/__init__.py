"""Estimators of the needle's state, and what an estimator is to the rest."""
