"""The node sim_rig beside scripted partners."""
