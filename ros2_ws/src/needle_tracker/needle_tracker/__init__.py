"""Stereo images to the needle's tip, through the phantom's refracting surface."""
