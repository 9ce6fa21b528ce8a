"""The rig's own nodes on a virtual middleware, clock and bus."""
