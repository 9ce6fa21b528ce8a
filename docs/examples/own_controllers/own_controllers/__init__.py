"""An estimator, a law and a planner for plane_controller, as an example."""
