"""Compliant balancing and walking for humanoids with gear-driven servos, from simulation to reality."""
