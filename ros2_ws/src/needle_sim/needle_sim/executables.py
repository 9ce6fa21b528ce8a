"""The package's executables."""

from needle_core.commands.executables import command, node

sim_rig = node("needle_sim.ros.sim_rig")
drive_emulator = node("needle_sim.ros.drive_emulator")
# needle_bringup passes the controller under test to the studies of this package.
monte_carlo = command("needle_bringup.studies.monte_carlo")
render_images = command("needle_sim.sequences.render_images")
