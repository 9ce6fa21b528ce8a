"""The package's executables."""

from needle_common.executables import command, node

sim_rig = node("needle_sim.sim_rig_node")
drive_emulator = node("needle_sim.drive_emulator_node")
monte_carlo = command("needle_sim.monte_carlo")
render_images = command("needle_sim.render_images")
