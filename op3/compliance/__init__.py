"""Compliance of a robot under a policy, measured from its joints, landings, pushes and guidance by hand."""
