"""The operators, a person's and the simulation's, and what the launch files share."""
