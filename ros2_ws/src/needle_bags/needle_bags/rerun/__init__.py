"""A bag's inputs through today's code, beside what was recorded."""
