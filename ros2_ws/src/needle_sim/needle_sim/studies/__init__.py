"""Monte Carlo studies: thousands of simulated needles at a time."""
