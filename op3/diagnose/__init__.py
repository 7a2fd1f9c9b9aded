"""Locate where simulation and logs disagree, name the missing effect, add it, show the gap shrink."""
