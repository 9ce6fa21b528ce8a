"""Safety rules, one by one: a scene in which each counts, and the bug that takes it away."""
