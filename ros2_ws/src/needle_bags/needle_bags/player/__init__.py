"""Choice, times and names of what is played of a bag."""
