"""Safety rules, one by one: a scene that the rule protects, and the bug that disables it."""
