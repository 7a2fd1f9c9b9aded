"""Compliance of a robot under a policy, measured on its joints, landings, pushes and pulls."""
