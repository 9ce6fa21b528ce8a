"""Measurement of the needle's tip in stereo images, through the phantom's refracting surface."""
